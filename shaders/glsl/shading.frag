#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Shades a patch in object space: each texel of its block at its middle.
#include "shading.glsl"

void main() {
    color = shaded(middle_texel);
}
