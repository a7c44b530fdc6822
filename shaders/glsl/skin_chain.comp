#version 460
#extension GL_GOOGLE_include_directive : require
// The paper's skinning, the baseline: each vertex walks the whole parent chain of each of its bones and samples every
// bone on the way; nothing is shared between vertices. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 128) in;
#include "skin_buffers.glsl"
#define POSE_BINDING 5
#include "pose.glsl"
#include "skin.glsl"

Rows influence(uint joint) {
    PoseGpu pose = poses[job.pose];
    EntryGpu entry = entries[pose.entry_base + joint];
    int bone = int(entry.bone.x);
    Rows chain = Rows(entry.bone_from_mesh);
    while (bone != NO_PARENT) {
        chain = multiply(local_transform(pose, uint(bone)), chain);
        bone = parents[pose.bone_base + uint(bone)];
    }
    return chain;
}
#include "skin_whole.glsl"

void main() { skin_whole_vertex(); }
