// How a colour is looked up in the store: linear, between the texels and mip levels of one block.
// Twin: twin/store_lookup.rs.
#ifndef STORE_LOOKUP_GLSL
#define STORE_LOOKUP_GLSL
#include "atlas_lookup.glsl"

layout(binding = 12) uniform sampler2DArray store;

// The level that filters for a pixel of now what is filtered already. footprint: how far a pixel to the right and one down lie, texels.
// pixel: the sides of the pixel that it was shaded for, texels. Squares of the widths of filters add up: what lacks is that of the level's
// texel.
float store_level(vec4 footprint, float highest, vec2 pixel) {
    vec4 by_filter = footprint / (STORED_FILTER_PIXELS * pixel.xyxy);
    float across = dot(by_filter.xy, by_filter.xy), down = dot(by_filter.zw, by_filter.zw);
    vec2 longer = across > down ? footprint.xy : footprint.zw;
    float lacking = dot(longer, longer) * (1.0 - 1.0 / max(max(across, down), 1.0));
    return min(0.5 * log2(max(lacking, 1.0)), highest);
}

// The nearest place from which a lookup in a level has no texel of another block.
vec2 inside_level(vec2 at, vec4 block, float level) {
    float inset = max(0.5 * exp2(level), BLOCK_INSET_TEXELS);
    return clamp(at, block.xy + inset, block.zw - inset);
}

vec3 store_texel(vec2 at, float layer, float level) {
    return textureLod(store, vec3(at / STORE_PAGE_SIDE, layer), level).rgb;
}

// Each level has a lookup of its own, since the coarser one must keep farther away from the block's border.
vec3 store_mixed(vec3 fine, vec2 at, vec4 block, float layer, float level) {
    float first = floor(level);
    if (level == first) return fine;
    return mix(fine, store_texel(inside_level(at, block, first + 1.0), layer, first + 1.0), level - first);
}

vec3 store_linear(vec2 at, vec4 block, float layer, float level) {
    vec3 fine = store_texel(inside_level(at, block, floor(level)), layer, floor(level));
    return store_mixed(fine, at, block, layer, level);
}

// The same with a cubic filter in the finest level.
vec3 store_cubic(vec2 at, vec4 block, float layer, float level) {
    if (level >= 1.0) return store_linear(at, block, layer, level);
    CubicTaps taps = cubic_taps(inside_level(at, block, 0.0), block);
    vec3 fine = store_texel(taps.middle, layer, 0.0) * taps.inner.x * taps.inner.y
        + store_texel(vec2(taps.first.x, taps.middle.y), layer, 0.0) * taps.before.x * taps.inner.y
        + store_texel(vec2(taps.last.x, taps.middle.y), layer, 0.0) * taps.behind.x * taps.inner.y
        + store_texel(vec2(taps.middle.x, taps.first.y), layer, 0.0) * taps.inner.x * taps.before.y
        + store_texel(vec2(taps.middle.x, taps.last.y), layer, 0.0) * taps.inner.x * taps.behind.y;
    return store_mixed(clamp(fine / taps.weight, 0.0, 1.0), at, block, layer, level);
}

#endif
