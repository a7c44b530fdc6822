#version 460
#extension GL_GOOGLE_include_directive : require
// As client_atlas_picture.frag, where the device takes chroma for sited beside the first of its luma texels.
#include "client_atlas_picture.glsl"

void main() {
    vec4 footprint = pixel_footprint();
    color = is_stored() ? stored_color(footprint) : color_of_two(inside_block(atlas_texel, block));
}
