#version 460
#extension GL_GOOGLE_include_directive : require
// Samples the atlas, luma with a cubic filter.
#include "client_atlas.glsl"

void main() {
    vec4 footprint = pixel_footprint();
    color = is_stored() ? stored_cubic_color(footprint) : cubic_color(inside_block(atlas_texel, block));
}
