#version 460
#extension GL_GOOGLE_include_directive : require
// The ground truth's vertex path without what only shading needs.
#include "scene.glsl"
#include "alpha_lookup.glsl"
#define SAVED_VERTICES_BINDING 1
#define BOXES_BINDING 9
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(std140, binding = 3) uniform View { ViewGpu view; };
layout(push_constant) uniform ForwardPush {
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material;
    uint instance;
};
layout(location = 0) out vec3 lookup;

void main() {
    lookup = alpha_lookup(materials[material], vertices[vertex_base + gl_VertexIndex]);
    gl_Position = view.clip_from_world * vec4(saved_position(instance, position_base + gl_VertexIndex), 1.0);
}
