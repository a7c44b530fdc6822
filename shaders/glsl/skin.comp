#version 460
#extension GL_GOOGLE_include_directive : require
// Skins each vertex once with its pose's palette. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 64) in;
#include "skin_buffers.glsl"
#include "rows.glsl"

layout(std430, binding = 6) readonly buffer Palettes { vec4 palettes[]; };

Rows influence(SkinJobGpu job, uint joint) {
    uint at = (job.palette_base + joint) * 3;
    return Rows(vec4[3](palettes[at], palettes[at + 1], palettes[at + 2]));
}
#include "skin.glsl"

void main() {
    SkinJobGpu job = job_of_group(group_number());
    uint index = (group_number() - job.first_group) * 64 + gl_LocalInvocationID.x;
    if (index < job.vertex_count) skin_vertex(job, index);
}
