#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// As shading.frag, with textures filtered for a texel of the block whatever a pixel of the display covers: for measurements.
#define FOOTPRINT_IS_TEXEL
#include "shading.glsl"

void main() {
    color = shaded(middle_texel);
}
