// A picture of which one lookup gives red, green and blue: the layout's own sampler converts, in a straight line between texels.
#include "environment.glsl"
#include "atlas_lookup.glsl"

layout(binding = 3) uniform sampler2D picture;
layout(location = 0) in vec2 atlas_texel;
layout(location = 1) flat in vec4 block; // left, top, right, bottom in texels
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

// The image may be larger than the picture in its corner.
vec3 rgb_at(vec2 at) {
    return texture(picture, at / vec2(textureSize(picture, 0))).rgb;
}

vec4 color_at(vec2 at) {
    return vec4(linear_from_srgb(clamp(rgb_at(at), 0.0, 1.0)), 1.0);
}

// Luma of one lookup, chroma of another, half a luma texel before: the colour's other half is what it differs in from its luma.
vec4 color_of_two(vec2 at) {
    vec3 luma = vec3(0.2126, 0.7152, 0.0722), rgb = rgb_at(at - 0.5);
    rgb += dot(rgb_at(at), luma) - dot(rgb, luma);
    return vec4(linear_from_srgb(clamp(rgb, 0.0, 1.0)), 1.0);
}
