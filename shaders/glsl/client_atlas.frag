#version 460
#extension GL_GOOGLE_include_directive : require
// Samples the atlas, all planes linearly.
#include "client_atlas.glsl"

void main() {
    vec2 uv = inside_block(atlas_texel, block) / vec2(textureSize(luma_plane, 0));
    color = color_of(texture(luma_plane, uv).r, uv);
}
