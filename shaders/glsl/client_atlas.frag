#version 460
#extension GL_GOOGLE_include_directive : require
// Samples the atlas, all planes linearly.
#include "client_atlas.glsl"

void main() {
    vec4 footprint = pixel_footprint();
    color = is_stored() ? stored_color(footprint) : linear_color(inside_block(atlas_texel, block));
}
