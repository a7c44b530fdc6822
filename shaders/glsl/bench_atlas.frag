#version 460
#extension GL_GOOGLE_include_directive : require
// As client_atlas.frag without a store: what its choice is measured against, and not chosen.
#include "client_atlas.glsl"

void main() {
    color = linear_color(inside_block(atlas_texel, block));
}
