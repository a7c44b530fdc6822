// Copies blocks of a picture to the store's finest level: the light in each texel's middle. Chroma comes from inside the block,
// where lookups in the atlas stay too.
#include "environment.glsl"
#include "atlas_lookup.glsl"
#include "client_settle.glsl"

layout(binding = 1, r32ui) writeonly uniform uimage2DArray written;

// The shader's own.
vec3 picture_rgb(vec2 at, vec2 chroma_at);

void copy_texel(SettleTileGpu tile, uvec2 at) {
    vec2 first = vec2(texel_of(tile.from)), end = first + vec2(block_extent(tile));
    vec2 middle = first + vec2(at) + 0.5;
    vec3 rgb = picture_rgb(middle, inside_chroma(middle, vec4(first, end)));
    uint light = packed_light(linear_from_srgb(clamp(rgb, 0.0, 1.0)));
    imageStore(written, ivec3(texel_of(tile.to) + at, layer_of(tile)), uvec4(light));
}

void main() {
    SettleTileGpu tile = tiles[first_tile + gl_WorkGroupID.x];
    for (uint i = gl_LocalInvocationID.x; i < SETTLE_TILE * SETTLE_TILE; i += gl_WorkGroupSize.x) {
        uvec2 at = tile_place(tile) + uvec2(i % SETTLE_TILE, i / SETTLE_TILE);
        if (all(lessThan(at, block_extent(tile)))) copy_texel(tile, at);
    }
}
