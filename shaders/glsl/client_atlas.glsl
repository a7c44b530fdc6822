// What the fragment shaders of both reconstructions share: the planes, and a colour of their values. Chroma is sited in the
// middle of its four luma texels, so that the same normalised coordinate serves all three planes.
#include "client_stored.glsl"

layout(binding = 3) uniform sampler2D luma_plane;
layout(binding = 4) uniform sampler2D cb_plane;
layout(binding = 5) uniform sampler2D cr_plane;

vec4 color_of(float luma, vec2 uv) {
    vec3 ycbcr = vec3(luma, textureLod(cb_plane, uv, 0.0).r, textureLod(cr_plane, uv, 0.0).r);
    return displayed(rgb_from_ycbcr(ycbcr));
}

vec4 linear_color(vec2 at) {
    vec2 uv = at / vec2(textureSize(luma_plane, 0));
    return color_of(textureLod(luma_plane, uv, 0.0).r, uv);
}

vec4 cubic_color(vec2 at) {
    return color_of(cubic_lookup(luma_plane, at, block), at / vec2(textureSize(luma_plane, 0)));
}
