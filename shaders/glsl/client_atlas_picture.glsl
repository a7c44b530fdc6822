// A picture of which one lookup gives red, green and blue: the layout's own sampler converts, in a straight line between texels.
#include "client_stored.glsl"

layout(binding = 3) uniform sampler2D picture;
layout(binding = 13) uniform sampler2D picture_before;

// The image may be larger than the picture in its corner.
vec3 rgb_at(vec2 at) {
    vec3 newest = textureLod(picture, at / vec2(textureSize(picture, 0)), 0.0).rgb;
    if (newest_part() == 1.0) return newest;
    return mix(textureLod(picture_before, at / vec2(textureSize(picture_before, 0)), 0.0).rgb, newest, newest_part());
}

// Beside the block's border chroma comes from a lookup farther inside.
vec4 color_at(vec2 at) {
    vec2 of_chroma = inside_chroma(at, block);
    vec3 rgb = rgb_at(at);
    return displayed(of_chroma == at ? rgb : rgb_of_two(rgb, rgb_at(of_chroma)));
}

// Luma of one lookup, chroma of another, half a luma texel before.
vec4 color_of_two(vec2 at) {
    return displayed(rgb_of_two(rgb_at(at), rgb_at(inside_chroma(at, block) - 0.5)));
}
