#version 460
#extension GL_GOOGLE_include_directive : require
// Looks the atlas up. Chroma is sited in the middle of its four luma texels, so that the same normalised coordinate
// serves all three planes.
#include "environment.glsl"

layout(binding = 3) uniform sampler2D luma_plane;
layout(binding = 4) uniform sampler2D cb_plane;
layout(binding = 5) uniform sampler2D cr_plane;
layout(location = 0) in vec2 atlas_texel;
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

void main() {
    vec2 uv = atlas_texel / vec2(textureSize(luma_plane, 0));
    vec3 ycbcr = vec3(texture(luma_plane, uv).r, texture(cb_plane, uv).r, texture(cr_plane, uv).r);
    color = vec4(linear_from_srgb(clamp(rgb_from_ycbcr(ycbcr), 0.0, 1.0)), 1.0);
}
