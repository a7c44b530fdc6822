// Coverage of the C and C++ for libFuzzer. gcc calls a function at each branch; libFuzzer reads counters.
#include <stdint.h>

// libFuzzer adds what lies in this section to the coverage of the Rust code.
__attribute__((section("__libfuzzer_extra_counters"))) static uint8_t counters[1 << 16];

// The linker's --wrap puts it in the place of __sanitizer_cov_trace_pc.
void __wrap___sanitizer_cov_trace_pc(void) {
  // Addresses of calls are at least 5 bytes apart.
  uintptr_t place = (uintptr_t)__builtin_return_address(0) >> 2;
  uint8_t *counter = &counters[(place ^ place >> 16) & 0xffff];
  if (*counter < 255) ++*counter;
}

// gcc also reports comparisons of floats. libFuzzer takes none.
void __sanitizer_cov_trace_cmpf(float a, float b) { (void)a, (void)b; }
void __sanitizer_cov_trace_cmpd(double a, double b) { (void)a, (void)b; }
