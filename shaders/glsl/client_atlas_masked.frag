#version 460
#extension GL_GOOGLE_include_directive : require
// As client_atlas.frag, of patches that may not cover all of their block.
#include "client_atlas.glsl"

layout(std430, binding = 6) readonly buffer Coverage {
    uint width_texels;
    uint covered[];
};
layout(location = 3) flat in uint is_masked;
#include "coverage.glsl"

void main() {
    vec4 footprint = pixel_footprint();
    vec2 at = inside_block(atlas_texel, block);
    if (is_masked != 0 && !is_covered(at)) discard;
    color = is_stored() ? stored_color(footprint) : linear_color(at);
}
