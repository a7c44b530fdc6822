// What both ways of drawing a bundle read: a corner per patch vertex, positions by slot, and the eyes.
#ifndef CLIENT_GEOMETRY_GLSL
#define CLIENT_GEOMETRY_GLSL

struct CornerGpu {
    uint vertex_slot;
    uint instance;
    vec2 atlas_texel; // inside the block's lookup rectangle
    uvec2 block;      // x | y << 16 of its first texel, IS_MASKED or not, IS_KEPT or not, in the store STORED_PIXEL_BIT; x | y << BLOCK_END_BITS of the first one beyond it, and above both its page
};

struct EyesGpu {
    mat4 clip_from_world[EYES];
    mat4 space_from_clip_direction[EYES]; // (ndc, 1, 0) to a direction in the backdrop's space
    vec4 space_eye[EYES];                 // xyz in the backdrop's space, metres
    vec4 blend;                           // x: how much of a colour is the newest picture's, of a block that the one before it has too
};

// Left, top, right, bottom in texels.
uvec4 block_sides(uvec2 block) {
    bool is_stored = block.y >> (2 * BLOCK_END_BITS) != 0;
    uint mask = (1 << BLOCK_END_BITS) - 1, first_mask = is_stored ? (1 << STORED_PIXEL_BIT) - 1 : mask;
    return uvec4(block.x & first_mask, block.x >> 16 & first_mask, block.y & mask, block.y >> BLOCK_END_BITS & mask);
}

// Whether the picture before has the same block.
bool is_kept(uvec2 block) {
    return (block.y >> (2 * BLOCK_END_BITS)) == 0 && (block.x & IS_KEPT) != 0;
}

vec4 block_texels(uvec2 block) {
    return vec4(block_sides(block));
}

// The block's layer in the store, below 0 for one in the atlas; its highest mip level: no larger than the block, and at its
// address; texels across and down that a pixel covered when it was shaded.
vec4 store_place(uvec2 block) {
    uvec4 sides = block_sides(block);
    uvec2 shared_bits = sides.xy | (sides.zw - sides.xy);
    int layer = int(block.y >> (2 * BLOCK_END_BITS)) - 1;
    uvec2 pixel_steps = uvec2(block.x, block.x >> 16) >> STORED_PIXEL_BIT & (1u << PIXEL_BITS) - 1;
    int highest = findLSB(shared_bits.x | shared_bits.y | 1 << (STORE_LEVELS - 1));
    return vec4(layer, highest, exp2(vec2(pixel_steps) / PIXEL_STEPS));
}

// The same, but of a block in the atlas how much of its colour is the newest picture's in place of its highest mip level.
vec4 colour_place(uvec2 block, float newest_part) {
    vec4 place = store_place(block);
    if (place.x < 0.0) place.y = is_kept(block) ? newest_part : 1.0;
    return place;
}

// No triangle is drawn whose vertices have no samples: the draw list leaves its patch out, and the time at which vertices
// are evaluated never leaves the samples of what it holds. There is no position that drops a triangle for one corner's
// sake: clipping keeps a part, and what a NaN does is for each driver to choose.
vec4 clip_position(mat4 clip_from_world, vec4 position) {
    return clip_from_world * vec4(position.xyz, 1.0);
}

#endif
