#version 460
#extension GL_GOOGLE_include_directive : require
// Skins each vertex once with its pose's palette. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 128) in;
#include "skin_buffers.glsl"
#include "skin.glsl"

layout(std430, binding = 5) readonly buffer Palettes { vec4 palettes[]; };

void add_influence(inout Rows sum, uvec2 joints, vec4 weights, uint i) {
    uint at = (job.palette_base + joint_of(joints, i)) * 3;
    for (int r = 0; r < 3; r++) sum.r[r] += weights[i] * palettes[at + r];
}

// Those of weight 0 come last.
Rows blend(uvec2 joints, vec4 weights) {
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < 4; i++) {
        if (weights[i] <= 0.0) break;
        add_influence(sum, joints, weights, i);
    }
    return sum;
}

void main() {
    uint index = gl_GlobalInvocationID.x, vertex = job.vertex_base + index;
    if (index >= job.vertex_count) return;
    Rows model_from_mesh = blend(vertices[vertex].joints, vertices[vertex].weights);
    skin_vertex(index, vertices[vertex].position_u.xyz, model_from_mesh);
}
