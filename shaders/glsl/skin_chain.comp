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
    while (bone >= 0) {
        chain = multiply(local_transform(pose, uint(bone)), chain);
        bone = parents[pose.bone_base + uint(bone)];
    }
    return chain;
}

Rows blend(uvec2 joints, vec4 weights) {
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < 4; i++) {
        if (weights[i] <= 0.0) break;
        Rows matrix = influence(joint_of(joints, i));
        for (int r = 0; r < 3; r++) sum.r[r] += weights[i] * matrix.r[r];
    }
    return sum;
}

void main() {
    uint index = gl_GlobalInvocationID.x, vertex = job.vertex_base + index;
    if (index >= job.vertex_count) return;
    Rows model_from_mesh = blend(vertices[vertex].joints, vertices[vertex].weights);
    skin_vertex(index, vertices[vertex].position_u.xyz, model_from_mesh);
}
