#version 460
#extension GL_GOOGLE_include_directive : require
// Copies blocks of a picture of three planes to the store. Twin: twin/settle.rs.
layout(local_size_x = 64) in;
#include "client_settle_picture.glsl"

layout(binding = 2) uniform sampler2D luma_plane;
layout(binding = 3) uniform sampler2D cb_plane;
layout(binding = 4) uniform sampler2D cr_plane;

vec3 picture_rgb(vec2 at, vec2 chroma_at) {
    vec2 scale = 1.0 / vec2(textureSize(luma_plane, 0)), uv = chroma_at * scale;
    float luma = textureLod(luma_plane, at * scale, 0.0).r;
    return rgb_from_ycbcr(vec3(luma, textureLod(cb_plane, uv, 0.0).r, textureLod(cr_plane, uv, 0.0).r));
}
