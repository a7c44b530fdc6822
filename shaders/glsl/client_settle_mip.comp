#version 460
#extension GL_GOOGLE_include_directive : require
// A mip level of blocks in the store, of the level below it. Each texel is the mean of the light of four of its own block.
// Twin: twin/settle.rs.
layout(local_size_x = 64) in;
#include "client_settle.glsl"

layout(binding = 1, r32ui) writeonly uniform uimage2DArray written;
layout(binding = 2, r32ui) readonly uniform uimage2DArray finer;

vec3 light_at(ivec3 place) {
    return unpacked_light(imageLoad(finer, place).r);
}

void main() {
    SettleTileGpu tile = tiles[first_tile + gl_WorkGroupID.x];
    uint side = SETTLE_TILE >> level, number = gl_LocalInvocationID.x;
    uvec2 at = (tile_place(tile) >> level) + uvec2(number % side, number / side);
    bool is_inside = number < side * side && all(lessThan(at, block_extent(tile) >> level));
    if (level > highest_level(tile) || !is_inside) return;
    ivec3 place = ivec3((texel_of(tile.to) >> level) + at, layer_of(tile)), first = place * ivec3(2, 2, 1);
    vec3 sum = light_at(first) + light_at(first + ivec3(1, 0, 0)) + light_at(first + ivec3(0, 1, 0)) + light_at(first + ivec3(1, 1, 0));
    imageStore(written, place, uvec4(packed_light(sum * 0.25)));
}
