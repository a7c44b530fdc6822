// What the fragments of the ID buffer share: the alpha test. Included after the descriptor indexing extension was asked for.
#ifndef ID_BUFFER_FRAGMENT_GLSL
#define ID_BUFFER_FRAGMENT_GLSL
#include "id_buffer.glsl"

layout(binding = 5) uniform sampler2D textures[];
#include "alpha.glsl"
layout(location = 0) in vec3 lookup;
layout(location = 0) out uint id;

void cut_out() {
    if (is_cut_out(materials[material], lookup)) discard;
}

#endif
