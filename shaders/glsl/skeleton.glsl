// What both kinds of palettes do with a skeleton: bones into one frame, parents first, level by level, then the entries.
// One workgroup of GROUP invocations a pose; its control flow is the same for all of them. The includer defines GROUP.
#ifndef SKELETON_GLSL
#define SKELETON_GLSL
#include "pose.glsl"

layout(std430, binding = 6) readonly buffer Levels { uint level_starts[]; };
layout(std430, binding = 7) coherent buffer Globals { vec4 globals[]; };
layout(std430, binding = 8) writeonly buffer Palettes { vec4 palettes[]; };

Rows load_global(uint index) {
    uint at = index * AFFINE_ROWS;
    return Rows(vec4[](globals[at], globals[at + 1], globals[at + 2]));
}

void store_global(uint index, Rows m) {
    for (int i = 0; i < AFFINE_ROWS; i++) globals[index * AFFINE_ROWS + i] = m.r[i];
}

uint bone_count(PoseGpu pose) { return level_starts[pose.level_base + pose.level_count]; }

// Bones of the first level: they have no parent.
uint root_count(PoseGpu pose) { return level_starts[pose.level_base + 1]; }

// Globals hold the local transforms, and of roots what all others are to follow; they become the chains' products.
void chain_bones(PoseGpu pose) {
    for (uint level = 1; level < pose.level_count; level++) {
        memoryBarrierBuffer();
        barrier();
        uint first = level_starts[pose.level_base + level], end = level_starts[pose.level_base + level + 1];
        for (uint bone = first + gl_LocalInvocationID.x; bone < end; bone += GROUP) {
            uint place = pose.global_base + bone, parent = pose.global_base + uint(parents[pose.bone_base + bone]);
            store_global(place, multiply(load_global(parent), load_global(place)));
        }
    }
    memoryBarrierBuffer();
    barrier();
}

void store_palette(PoseGpu pose, uint entry, Rows m) {
    for (int r = 0; r < AFFINE_ROWS; r++) palettes[(pose.palette_base + entry) * AFFINE_ROWS + r] = m.r[r];
}

// Of chained bones.
void write_palette(PoseGpu pose) {
    for (uint i = gl_LocalInvocationID.x; i < pose.entry_count; i += GROUP) {
        EntryGpu entry = entries[pose.entry_base + i];
        store_palette(pose, i, multiply(load_global(pose.global_base + entry.bone.x), Rows(entry.bone_from_mesh)));
    }
}

#endif
