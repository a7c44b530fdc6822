#version 460
#extension GL_GOOGLE_include_directive : require
// The ground truth's vertex path: positions and frames were skinned at the exact time of the picture.
#include "scene.glsl"
#define SAVED_VERTICES_BINDING 1
#define TANGENTS_BINDING 2
#define BOXES_BINDING 9
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
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
    uvec2 frame = saved_frame(tangent_base + gl_VertexIndex);
    world_position = saved_position(instance, position_base + gl_VertexIndex);
    world_normal = unpack_normal(frame);
    world_tangent = unpack_tangent(frame);
    uvs = vec4(v.position_u.w, v.normal_v.w, v.uv1);
    vertex_color = unpackUnorm4x8(v.color);
    gl_Position = view.clip_from_world * vec4(world_position, 1.0);
}
