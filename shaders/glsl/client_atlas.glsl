// What the fragment shaders of both reconstructions share: the planes, and a colour of their values. Chroma is sited in the
// middle of its four luma texels, so that the same normalised coordinate serves all three planes.
#include "environment.glsl"
#include "atlas_lookup.glsl"

layout(binding = 3) uniform sampler2D luma_plane;
layout(binding = 4) uniform sampler2D cb_plane;
layout(binding = 5) uniform sampler2D cr_plane;
layout(location = 0) in vec2 atlas_texel;
layout(location = 1) flat in vec4 block; // left, top, right, bottom in texels
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

vec4 color_of(float luma, vec2 uv) {
    vec3 ycbcr = vec3(luma, texture(cb_plane, uv).r, texture(cr_plane, uv).r);
    return vec4(linear_from_srgb(clamp(rgb_from_ycbcr(ycbcr), 0.0, 1.0)), 1.0);
}
