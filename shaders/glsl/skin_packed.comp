#version 460
#extension GL_GOOGLE_include_directive : require
// Skins from a stream of its own, 32 bytes a vertex, sorted by the number of influences, with a pipeline for each number:
// no invocation waits for one that has more. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 128) in;
layout(constant_id = 1) const uint INFLUENCES = MAX_INFLUENCES;
#include "skin_buffers.glsl"
#include "skin.glsl"

struct PackedVertexGpu {
    uvec4 position_joints; // xyz bits of metres, w the first two joints, 16 bits each
    uvec4 influences;      // x the other two joints, y and z weights of 16 bits, 65535 for 1, w the index in the mesh
};

layout(std430, binding = 5) readonly buffer Palettes { vec4 palettes[]; };
layout(std430, binding = 6) readonly buffer PackedVertices { PackedVertexGpu packed_vertices[]; };

void main() {
    if (gl_GlobalInvocationID.x >= job.vertex_count) return;
    uint place = job.packed_base + gl_GlobalInvocationID.x;
    uvec4 first = packed_vertices[place].position_joints;
    uvec4 influences = packed_vertices[place].influences;
    uvec2 joints = uvec2(first.w, influences.x);
    vec4 weights = vec4(unpackUnorm2x16(influences.y), unpackUnorm2x16(influences.z));
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < INFLUENCES; i++) {
        uint at = (job.palette_base + joint_of(joints, i)) * AFFINE_ROWS;
        for (int r = 0; r < AFFINE_ROWS; r++) sum.r[r] += weights[i] * palettes[at + r];
    }
    skin_vertex(influences.w, uintBitsToFloat(first.xyz), sum);
}
