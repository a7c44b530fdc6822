#version 460
#extension GL_GOOGLE_include_directive : require
// As client_settle.comp, of a picture that the platform decoded into one image: its sampler makes the colour.
layout(local_size_x = 64) in;
#include "client_settle_picture.glsl"

layout(binding = 2) uniform sampler2D picture;

vec3 picture_rgb(vec2 at, vec2 chroma_at) {
    vec2 scale = 1.0 / vec2(textureSize(picture, 0));
    vec3 of_luma = textureLod(picture, at * scale, 0.0).rgb;
    return rgb_of_two(of_luma, textureLod(picture, (chroma_at) * scale, 0.0).rgb);
}
