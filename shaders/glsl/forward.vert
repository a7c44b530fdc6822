#version 460
#extension GL_GOOGLE_include_directive : require
// The ground truth's vertex path: positions and frames were skinned at the exact time of the picture.
#include "scene.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 1) readonly buffer SavedVertices { vec4 saved_vertices[]; };
layout(std430, binding = 2) readonly buffer Tangents { TangentGpu tangents[]; };
layout(std140, binding = 3) uniform View { ViewGpu view; };
layout(push_constant) uniform ForwardPush {
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material;
    uint instance;
};
layout(location = 0) out vec3 world_position;
layout(location = 1) out vec3 world_normal;
layout(location = 2) out vec4 world_tangent;
layout(location = 3) out vec4 uvs; // both sets
layout(location = 4) out vec4 vertex_color;

void main() {
    VertexGpu v = vertices[vertex_base + gl_VertexIndex];
    TangentGpu f = tangents[tangent_base + gl_VertexIndex];
    world_position = saved_vertices[position_base + gl_VertexIndex].xyz;
    world_normal = f.normal.xyz;
    world_tangent = f.tangent;
    uvs = vec4(v.position_u.w, v.normal_v.w, v.uv1);
    vertex_color = unpackUnorm4x8(v.color);
    gl_Position = view.clip_from_world * vec4(world_position, 1.0);
}
