#version 460
#extension GL_GOOGLE_include_directive : require
// Bone palettes, model_from_mesh: every bone of every pose once, parents first, level by level; one workgroup a pose.
// Twin: scene/src/animation/pose.rs.
const uint GROUP = 32;
layout(local_size_x = GROUP) in;

#include "pose.glsl"

layout(std430, binding = 6) readonly buffer Levels { uint level_starts[]; };
layout(std430, binding = 7) coherent buffer Globals { vec4 globals[]; };
layout(std430, binding = 8) writeonly buffer Palettes { vec4 palettes[]; };
layout(push_constant) uniform PalettePush {
    uint pose_base;
};

Rows load_global(uint index) {
    uint at = index * AFFINE_ROWS;
    return Rows(vec4[](globals[at], globals[at + 1], globals[at + 2]));
}

void store_global(uint index, Rows m) {
    for (int i = 0; i < AFFINE_ROWS; i++) globals[index * AFFINE_ROWS + i] = m.r[i];
}

void main() {
    PoseGpu pose = poses[pose_base + gl_WorkGroupID.x];
    uint bone_count = level_starts[pose.level_base + pose.level_count];
    // Curves do not depend on parents: all of them first, with every invocation at work.
    for (uint bone = gl_LocalInvocationID.x; bone < bone_count; bone += GROUP) {
        store_global(pose.global_base + bone, local_transform(pose, bone));
    }
    // The roots are done already.
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
    for (uint i = gl_LocalInvocationID.x; i < pose.entry_count; i += GROUP) {
        EntryGpu entry = entries[pose.entry_base + i];
        Rows model_from_mesh = multiply(load_global(pose.global_base + entry.bone.x), Rows(entry.bone_from_mesh));
        for (int r = 0; r < AFFINE_ROWS; r++) palettes[(pose.palette_base + i) * AFFINE_ROWS + r] = model_from_mesh.r[r];
    }
}
