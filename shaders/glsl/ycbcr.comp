#version 460
#extension GL_GOOGLE_include_directive : require
// Atlas colour to full-range BT.709 4:2:0 planes, four samples to a word. One invocation converts YCBCR_TEXELS, 8x2.
// Chroma is centre-sited: what lines between its samples must be to come nearest to the hues of the texels of the block, so
// that it is made of no other block's. Twin: twin/ycbcr.rs. Where asked, alpha becomes coverage: a word an invocation, a
// bit a texel, of its rows one after the other.
layout(local_size_x = 8, local_size_y = 8) in;
#include "environment.glsl"

layout(binding = 0) uniform sampler2D atlas;
layout(std430, binding = 1) writeonly buffer Planes { uint planes[]; };
layout(std430, binding = 2) writeonly buffer Coverage { uint coverage[]; };
// The extent of the blocks in each cell of the smallest superblock's side, in rows: width | height << 16.
layout(std430, binding = 3) readonly buffer CellExtents { uint cell_extents[]; };
// The workgroups of the atlas that have something to convert: x | y << 16.
layout(std430, binding = 4) readonly buffer Groups { uint groups[]; };
layout(push_constant) uniform YcbcrPush {
    uint width_texels;
    uint height_texels;
    uint has_coverage;
};

const float TAPS[4][CHROMA_REACH] = CHROMA_TAPS;
// Texels before a sample's own two that it is made of.
const int BEFORE = int(CHROMA_REACH) / 2 - 1;

uvec2 block_extent(uvec2 texel) {
    uint cells = (width_texels - 1 >> SUPERBLOCK_MIN_LOG2) + 1;
    uvec2 cell = texel >> SUPERBLOCK_MIN_LOG2;
    uint word = cell_extents[cell.y * cells + cell.x];
    return uvec2(word & 0xffff, word >> 16);
}

// What a texel counts for the sample whose own texels begin at `at`, along a side on which blocks have `side` texels. Blocks lie
// at multiples of their sides.
float tap(uint at, uint side, uint texel) {
    uint from_first = (at & side - 1) / 2, from_last = side / 2 - 1 - from_first;
    uint near = min(from_first, from_last);
    return TAPS[side == 4 ? 0 : 1 + min(near, 2)][from_first <= from_last ? texel : CHROMA_REACH - 1 - texel];
}

vec3 ycbcr_at(ivec2 at, out float alpha) {
    // What lies outside counts nothing, but is to be a number.
    vec4 texel = texelFetch(atlas, clamp(at, ivec2(0), ivec2(width_texels, height_texels) - 1), 0);
    alpha = texel.a;
    return ycbcr_from_rgb(texel.rgb);
}

void main() {
    uint group = groups[gl_WorkGroupID.x];
    uvec2 invocation = uvec2(group & 0xffff, group >> 16) * gl_WorkGroupSize.xy + gl_LocalInvocationID.xy;
    uvec2 at = invocation * YCBCR_TEXELS;
    if (at.x >= width_texels || at.y >= height_texels) return;
    uvec2 extent = block_extent(at);
    float across[4][CHROMA_REACH];
    for (uint i = 0; i < 4; i++)
        for (uint texel = 0; texel < CHROMA_REACH; texel++) across[i][texel] = tap(at.x + 2 * i, extent.x, texel);
    vec2 chroma[4] = vec2[4](vec2(0), vec2(0), vec2(0), vec2(0));
    vec4 luma[YCBCR_TEXELS.y][2];
    uint covered = 0;
    for (int row = -BEFORE; row <= BEFORE + 1; row++) {
        float down = tap(at.y, extent.y, row + BEFORE);
        if (down == 0.0) continue;
        bool is_own_row = row == 0 || row == 1;
        for (int i = -BEFORE; i < int(YCBCR_TEXELS.x) + BEFORE; i++) {
            float alpha;
            vec3 c = ycbcr_at(ivec2(at) + ivec2(i, row), alpha);
            for (int s = 0; s < 4; s++) {
                int texel = i + BEFORE - 2 * s;
                if (texel >= 0 && texel < int(CHROMA_REACH)) chroma[s] += across[s][texel] * down * c.yz;
            }
            if (is_own_row && i >= 0 && i < int(YCBCR_TEXELS.x)) {
                covered |= uint(alpha >= 0.5) << (row * YCBCR_TEXELS.x + i);
                luma[row][i / 4][i % 4] = c.x;
            }
        }
    }
    for (uint row = 0; row < YCBCR_TEXELS.y; row++) {
        uint word = ((at.y + row) * width_texels + at.x) / 4;
        planes[word] = packUnorm4x8(luma[row][0]);
        planes[word + 1] = packUnorm4x8(luma[row][1]);
    }
    uint luma_words = width_texels * height_texels / 4;
    // Each invocation has one word of either chroma plane.
    uint word = invocation.y * (width_texels / YCBCR_TEXELS.x) + invocation.x;
    if (has_coverage != 0) coverage[word] = covered;
    planes[luma_words + word] = packUnorm4x8(vec4(chroma[0].x, chroma[1].x, chroma[2].x, chroma[3].x));
    planes[luma_words + luma_words / 4 + word] =
        packUnorm4x8(vec4(chroma[0].y, chroma[1].y, chroma[2].y, chroma[3].y));
}
