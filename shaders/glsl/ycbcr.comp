#version 460
#extension GL_GOOGLE_include_directive : require
// Atlas colour to full-range BT.709 4:2:0 planes, four samples to a word. One invocation converts YCBCR_TEXELS, 8x2.
// Chroma is the mean of its four texels (centre-sited). Twin: color.rs. Where asked, alpha becomes coverage: a word an
// invocation, a bit a texel, of its rows one after the other.
layout(local_size_x = 8, local_size_y = 8) in;
#include "environment.glsl"

layout(binding = 0) uniform sampler2D atlas;
layout(std430, binding = 1) writeonly buffer Planes { uint planes[]; };
layout(std430, binding = 2) writeonly buffer Coverage { uint coverage[]; };
layout(push_constant) uniform YcbcrPush {
    uint width_texels;
    uint height_texels;
    uint has_coverage;
};

void main() {
    uvec2 at = gl_GlobalInvocationID.xy * YCBCR_TEXELS;
    if (at.x >= width_texels || at.y >= height_texels) return;
    vec2 chroma[4] = vec2[4](vec2(0), vec2(0), vec2(0), vec2(0));
    uint covered = 0;
    for (uint row = 0; row < YCBCR_TEXELS.y; row++) {
        vec4 luma[2];
        for (uint i = 0; i < YCBCR_TEXELS.x; i++) {
            vec4 texel = texelFetch(atlas, ivec2(at + uvec2(i, row)), 0);
            vec3 c = ycbcr_from_rgb(texel.rgb);
            covered |= uint(texel.a >= 0.5) << (row * YCBCR_TEXELS.x + i);
            luma[i / 4][i % 4] = c.x;
            chroma[i / 2] += c.yz * 0.25;
        }
        uint word = ((at.y + row) * width_texels + at.x) / 4;
        planes[word] = packUnorm4x8(luma[0]);
        planes[word + 1] = packUnorm4x8(luma[1]);
    }
    uint luma_words = width_texels * height_texels / 4;
    // Each invocation has one word of either chroma plane.
    uint word = gl_GlobalInvocationID.y * (width_texels / YCBCR_TEXELS.x) + gl_GlobalInvocationID.x;
    if (has_coverage != 0) coverage[word] = covered;
    planes[luma_words + word] = packUnorm4x8(vec4(chroma[0].x, chroma[1].x, chroma[2].x, chroma[3].x));
    planes[luma_words + luma_words / 4 + word] =
        packUnorm4x8(vec4(chroma[0].y, chroma[1].y, chroma[2].y, chroma[3].y));
}
