#version 460
#extension GL_GOOGLE_include_directive : require
// Bone palettes, model_from_mesh: every bone of every pose once, parents first, level by level; one workgroup a pose.
// Twin: scene/src/animation/pose.rs.
layout(local_size_x = 64) in;

#include "pose.glsl"

layout(std430, binding = 6) readonly buffer Levels { uint level_starts[]; };
layout(std430, binding = 7) coherent buffer Globals { vec4 globals[]; };
layout(std430, binding = 8) writeonly buffer Palettes { vec4 palettes[]; };
layout(push_constant) uniform PalettePush {
    uint pose_base;
};

Rows load_global(uint index) {
    return Rows(vec4[3](globals[index * 3], globals[index * 3 + 1], globals[index * 3 + 2]));
}

void main() {
    PoseGpu pose = poses[pose_base + gl_WorkGroupID.x];
    for (uint level = 0; level < pose.level_count; level++) {
        uint first = level_starts[pose.level_base + level], end = level_starts[pose.level_base + level + 1];
        for (uint bone = first + gl_LocalInvocationID.x; bone < end; bone += 64) {
            Rows local = local_transform(pose, bone);
            int parent = parents[pose.bone_base + bone];
            Rows global = parent < 0 ? local : multiply(load_global(pose.global_base + uint(parent)), local);
            for (int i = 0; i < 3; i++) globals[(pose.global_base + bone) * 3 + i] = global.r[i];
        }
        memoryBarrierBuffer();
        barrier();
    }
    for (uint i = gl_LocalInvocationID.x; i < pose.entry_count; i += 64) {
        EntryGpu entry = entries[pose.entry_base + i];
        Rows model_from_mesh = multiply(load_global(pose.global_base + entry.bone.x), Rows(entry.bone_from_mesh));
        for (int r = 0; r < 3; r++) palettes[(pose.palette_base + i) * 3 + r] = model_from_mesh.r[r];
    }
}
