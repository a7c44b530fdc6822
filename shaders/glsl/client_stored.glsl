// What all fragment shaders of the one draw share: what a patch is told, and the colours of the store. The colour is chosen in a
// branch, so derivatives are taken before it, and lookups in it name their level.
#include "environment.glsl"
#include "store_lookup.glsl"

// 0 where no block can be in the store: devices that evaluate both sides of a branch are spared its lookups.
layout(constant_id = 0) const uint HAS_STORE = 1;
// 0 where no colour is made of two pictures, likewise.
layout(constant_id = 1) const uint BLENDS = 1;
layout(location = 0) in vec2 atlas_texel;
layout(location = 1) flat in vec4 block; // left, top, right, bottom in texels
layout(location = 2) flat in vec4 stored; // layer in the store, below 0: it lies in the atlas; highest mip level, in the atlas how much is the newest picture's; texels of a pixel then
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

vec4 displayed(vec3 srgb) {
    return vec4(linear_from_srgb(clamp(srgb, 0.0, 1.0)), 1.0);
}

vec4 pixel_footprint() {
    return vec4(dFdx(atlas_texel), dFdy(atlas_texel));
}

// How much of a block's colour is the newest picture's.
float newest_part() {
    return BLENDS == 0 ? 1.0 : stored.y;
}

bool is_stored() {
    return HAS_STORE != 0 && stored.x >= 0.0;
}

vec4 stored_color(vec4 footprint) {
    return vec4(store_linear(atlas_texel, block, stored.x, store_level(footprint, stored.y, stored.zw)), 1.0);
}

vec4 stored_cubic_color(vec4 footprint) {
    return vec4(store_cubic(atlas_texel, block, stored.x, store_level(footprint, stored.y, stored.zw)), 1.0);
}
