#version 460
#extension GL_GOOGLE_include_directive : require
// As client_atlas.frag, of a picture that the platform decoded into one image: its sampler makes the colour.
#include "client_atlas_picture.glsl"

void main() {
    vec4 footprint = pixel_footprint();
    color = is_stored() ? stored_color(footprint) : color_at(inside_block(atlas_texel, block));
}
