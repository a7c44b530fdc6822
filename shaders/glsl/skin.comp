#version 460
#extension GL_GOOGLE_include_directive : require
// Skins each vertex once into saved_vertices (world space), or its frame into saved_frames.
// Twin: server/src/animation/pose.rs.
layout(local_size_x = 64) in;
#include "scene.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 1) readonly buffer Palettes { vec4 palettes[]; };
layout(std430, binding = 2) writeonly buffer SavedVertices { vec4 saved_vertices[]; };
layout(std430, binding = 3) writeonly buffer SavedFrames { FrameGpu saved_frames[]; };

layout(push_constant) uniform SkinPush {
    uint vertex_base;
    uint vertex_count;
    uint palette_base;  // of the instance, in the palette of the sample
    uint output_base;
    uint writes_frames; // 0: positions, 1: normal and tangent
};

void main() {
    uint index = gl_GlobalInvocationID.x;
    if (index >= vertex_count) return;
    VertexGpu v = vertices[vertex_base + index];
    uint joints[4] = uint[4](v.joints.x & 0xffff, v.joints.x >> 16, v.joints.y & 0xffff, v.joints.y >> 16);
    vec4 row0 = vec4(0), row1 = vec4(0), row2 = vec4(0);
    for (int i = 0; i < 4; i++) {
        uint at = (palette_base + joints[i]) * 3;
        row0 += v.weights[i] * palettes[at];
        row1 += v.weights[i] * palettes[at + 1];
        row2 += v.weights[i] * palettes[at + 2];
    }
    if (writes_frames == 0) {
        vec4 p = vec4(v.position_u.xyz, 1.0);
        saved_vertices[output_base + index] = vec4(dot(row0, p), dot(row1, p), dot(row2, p), 1.0);
        return;
    }
    // Normals go through the cofactors of the matrix, which stay right under non-uniform scale.
    mat3 m = transpose(mat3(row0.xyz, row1.xyz, row2.xyz));
    mat3 cofactors = mat3(cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1]));
    vec3 normal = cofactors * v.normal_v.xyz * sign(determinant(m)), tangent = m * v.tangent.xyz;
    saved_frames[output_base + index].normal = vec4(normal / max(length(normal), 1e-20), 0.0);
    saved_frames[output_base + index].tangent = vec4(tangent / max(length(tangent), 1e-20), v.tangent.w);
}
