#version 460
#extension GL_GOOGLE_include_directive : require
// Skins positions from a stream of their own: 32 bytes a vertex, sorted by the number of influences, so that a workgroup
// blends exactly as many matrices as its vertices have. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 64) in;
#include "skin_buffers.glsl"
#include "rows.glsl"

struct PackedVertexGpu {
    vec3 position;
    uint index;    // of the vertex in its mesh; NO_VERTEX fills a workgroup up
    uvec2 joints;  // four of 16 bits
    uvec2 weights; // four of 16 bits, 65535 for 1
};
const uint NO_VERTEX = 0xffffffffu;

layout(std430, binding = 6) readonly buffer Palettes { vec4 palettes[]; };
layout(std430, binding = 7) readonly buffer PackedVertices { PackedVertexGpu packed_vertices[]; };

Rows influence(SkinJobGpu job, uint joint) {
    uint at = (job.palette_base + joint) * 3;
    return Rows(vec4[3](palettes[at], palettes[at + 1], palettes[at + 2]));
}
#include "skin.glsl"

vec3 morphed_position(SkinJobGpu job, PackedVertexGpu v) {
    if (job.weight_base == NO_MORPHS) return v.position;
    VertexGpu whole = vertices[job.vertex_base + v.index];
    add_morphs(whole, job);
    return whole.position_u.xyz;
}

void main() {
    SkinJobGpu job = job_of_group(group_number());
    uint first = (group_number() - job.first_group) * 64;
    if (first >= job.packed_ends.w) return; // the last row of workgroups may be longer than the work
    PackedVertexGpu v = packed_vertices[job.packed_base + first + gl_LocalInvocationID.x];
    if (v.index == NO_VERTEX) return;
    // The same for the whole workgroup: the ends are multiples of 64.
    int count = first < job.packed_ends.x ? 1 : first < job.packed_ends.y ? 2 : first < job.packed_ends.z ? 3 : 4;
    vec4 weights = vec4(unpackUnorm2x16(v.weights.x), unpackUnorm2x16(v.weights.y));
    uint joints[4] = uint[4](v.joints.x & 0xffff, v.joints.x >> 16, v.joints.y & 0xffff, v.joints.y >> 16);
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (int i = 0; i < count; i++) {
        Rows matrix = influence(job, joints[i]);
        for (int r = 0; r < 3; r++) sum.r[r] += weights[i] * matrix.r[r];
    }
    save_position(job, v.index, sum, morphed_position(job, v));
}
