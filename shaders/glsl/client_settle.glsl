// Blocks that settle, in tiles of SETTLE_TILE texels a side: a workgroup each. Twin: twin/settle.rs.
#ifndef CLIENT_SETTLE_GLSL
#define CLIENT_SETTLE_GLSL

struct SettleTileGpu {
    uint from;  // x | y << 16 of the block's first texel in the picture
    uint to;    // the same in its page of the store
    uint shape; // from bit 0: log2 of the block's width (4 bits) and height (4), the tile's column (5) and row (5) in it, the
                // layer (5), the highest mip level (3)
};
layout(std430, binding = 0) readonly buffer Tiles { SettleTileGpu tiles[]; };
layout(push_constant) uniform SettlePush {
    uint first_tile;
    uint level; // that is written
};

uvec2 texel_of(uint word) {
    return uvec2(word & 0xffff, word >> 16);
}

uvec2 block_extent(SettleTileGpu tile) {
    return uvec2(1u << (tile.shape & 15), 1u << (tile.shape >> 4 & 15));
}

// Of the tile's first texel in the block.
uvec2 tile_place(SettleTileGpu tile) {
    return uvec2(tile.shape >> 8 & 31, tile.shape >> 13 & 31) * SETTLE_TILE;
}

uint layer_of(SettleTileGpu tile) {
    return tile.shape >> 18 & 31;
}

uint highest_level(SettleTileGpu tile) {
    return tile.shape >> 23 & 7;
}

// Light as the store keeps it: nine bits a channel, five of a common exponent ("Shared Exponent to RGB" in Vulkan's specification).
// Components from 0 to 1. Twin: packed_light.
uint packed_light(vec3 light) {
    float largest = max(max(light.r, max(light.g, light.b)), exp2(-16.0));
    uint exponent = (floatBitsToUint(largest) >> 23) - 111;
    if (round(largest * exp2(24.0 - float(exponent))) == 512.0) ++exponent;
    uvec3 mantissas = uvec3(round(light * exp2(24.0 - float(exponent))));
    return mantissas.r | mantissas.g << 9 | mantissas.b << 18 | exponent << 27;
}

vec3 unpacked_light(uint word) {
    uvec3 mantissas = uvec3(word, word >> 9, word >> 18) & 511;
    return vec3(mantissas) * exp2(float(word >> 27) - 24.0);
}

#endif
