// A planted bug: see targets/overread.rs.
#include <stddef.h>
#include <stdint.h>

uint8_t shadecast_overread(const uint8_t *bytes, size_t count) { return bytes[count]; }
