// What the fragment shaders of both reconstructions share: the planes, and a colour of their values. Chroma is sited in the
// middle of its four luma texels, so that the same normalised coordinate serves all three planes.
#include "client_stored.glsl"

layout(binding = 3) uniform sampler2D luma_plane;
layout(binding = 4) uniform sampler2D cb_plane;
layout(binding = 5) uniform sampler2D cr_plane;

layout(binding = 13) uniform sampler2D luma_before;
layout(binding = 14) uniform sampler2D cb_before;
layout(binding = 15) uniform sampler2D cr_before;

// Of luma in both pictures.
vec4 color_of(float luma, float before, vec2 at) {
    vec2 uv = inside_chroma(at, block) / vec2(textureSize(luma_plane, 0));
    vec3 ycbcr = vec3(luma, textureLod(cb_plane, uv, 0.0).r, textureLod(cr_plane, uv, 0.0).r);
    if (newest_part() < 1.0) {
        vec3 of_before = vec3(before, textureLod(cb_before, uv, 0.0).r, textureLod(cr_before, uv, 0.0).r);
        ycbcr = mix(of_before, ycbcr, newest_part());
    }
    return displayed(rgb_from_ycbcr(ycbcr));
}

vec4 linear_color(vec2 at) {
    vec2 uv = at / vec2(textureSize(luma_plane, 0));
    float before = newest_part() < 1.0 ? textureLod(luma_before, uv, 0.0).r : 0.0;
    return color_of(textureLod(luma_plane, uv, 0.0).r, before, at);
}

vec4 cubic_color(vec2 at) {
    ivec2 texels = textureSize(luma_plane, 0);
    float before = newest_part() < 1.0 ? cubic_lookup(luma_before, textureSize(luma_before, 0), at, block) : 0.0;
    return color_of(cubic_lookup(luma_plane, texels, at, block), before, at);
}
