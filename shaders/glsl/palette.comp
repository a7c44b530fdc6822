#version 460
#extension GL_GOOGLE_include_directive : require
// Bone palettes, model_from_mesh: every bone of every pose once, parents first, level by level; one workgroup a pose.
// Twin: scene/src/animation/pose.rs.
const uint GROUP = 32;
layout(local_size_x = GROUP) in;

#include "skeleton.glsl"

layout(push_constant) uniform PalettePush {
    uint pose_base;
};

void main() {
    PoseGpu pose = poses[pose_base + gl_WorkGroupID.x];
    // Curves do not depend on parents: all of them first, with every invocation at work.
    for (uint bone = gl_LocalInvocationID.x; bone < bone_count(pose); bone += GROUP) {
        store_global(pose.global_base + bone, local_transform(pose, bone));
    }
    chain_bones(pose);
    write_palette(pose);
}
