#version 460
#extension GL_GOOGLE_include_directive : require
// Samples the atlas, luma with a cubic filter.
#include "client_atlas.glsl"

void main() {
    vec2 at = inside_block(atlas_texel, block);
    color = color_of(cubic_lookup(luma_plane, at, block), at / vec2(textureSize(luma_plane, 0)));
}
