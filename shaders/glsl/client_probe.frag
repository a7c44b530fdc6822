#version 460
#extension GL_GOOGLE_include_directive : require
// What is where in the client's picture: instance and distance along the view axis, one sample a pixel.
#include "atlas_lookup.glsl"

layout(std430, binding = 3) readonly buffer Coverage {
    uint width_texels;
    uint covered[];
};
layout(location = 0) flat in uint instance;
layout(location = 1) flat in uint is_masked;
layout(location = 2) in vec2 atlas_texel;
layout(location = 3) flat in vec4 block; // left, top, right, bottom in texels
layout(location = 0) out uint id; // FIRST_ID and up; 0 is background
layout(location = 1) out float distance_m;
#include "coverage.glsl"

void main() {
    if (is_masked != 0 && !is_covered(inside_block(atlas_texel, block))) discard;
    id = FIRST_ID + instance;
    distance_m = 1.0 / gl_FragCoord.w;
}
