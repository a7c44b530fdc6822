// What both ways of drawing a bundle read: a corner per patch vertex, positions by slot, and the eyes.
#ifndef CLIENT_GEOMETRY_GLSL
#define CLIENT_GEOMETRY_GLSL

struct CornerGpu {
    uint vertex_slot;
    uint instance;
    vec2 atlas_texel; // inside the block's lookup rectangle
    uvec2 block;      // x | y << 16 of its first texel, IS_MASKED or not; x | y << BLOCK_END_BITS of the first one beyond it, and above both its page
};

struct EyesGpu {
    mat4 clip_from_world[EYES];
    mat4 space_from_clip_direction[EYES]; // (ndc, 1, 0) to a direction in the backdrop's space
    vec4 space_eye[EYES];                 // xyz in the backdrop's space, metres
};

// Left, top, right, bottom in texels.
uvec4 block_sides(uvec2 block) {
    uint first = block.x & ~IS_MASKED, mask = (1 << BLOCK_END_BITS) - 1;
    return uvec4(first & 0xffff, first >> 16, block.y & mask, block.y >> BLOCK_END_BITS & mask);
}

vec4 block_texels(uvec2 block) {
    return vec4(block_sides(block));
}

// The block's layer in the store, below 0 for one in the atlas, and its highest mip level: no larger than the block, and at its
// address.
vec2 store_place(uvec2 block) {
    uvec4 sides = block_sides(block);
    uvec2 shared_bits = sides.xy | (sides.zw - sides.xy);
    int layer = int(block.y >> (2 * BLOCK_END_BITS)) - 1;
    return vec2(layer, findLSB(shared_bits.x | shared_bits.y | 1 << (STORE_LEVELS - 1)));
}

// No triangle is drawn whose vertices have no samples: the draw list leaves its patch out, and the time at which vertices
// are evaluated never leaves the samples of what it holds. There is no position that drops a triangle for one corner's
// sake: clipping keeps a part, and what a NaN does is for each driver to choose.
vec4 clip_position(mat4 clip_from_world, vec4 position) {
    return clip_from_world * vec4(position.xyz, 1.0);
}

#endif
