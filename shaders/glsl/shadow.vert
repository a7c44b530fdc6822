#version 460
#extension GL_GOOGLE_include_directive : require
// The scene as the sun sees it.
#include "scene.glsl"
#include "alpha_lookup.glsl"
#include "light.glsl"
#define SAVED_VERTICES_BINDING 1
#define BOXES_BINDING 5
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std140, binding = 2) uniform Light { LightGpu light; };
layout(std430, binding = 3) readonly buffer Materials { MaterialGpu materials[]; };
layout(push_constant) uniform ShadowPush {
    uint vertex_base;
    uint position_base;
    uint material;
    uint instance;
};
layout(location = 0) out vec3 lookup;

void main() {
    lookup = alpha_lookup(materials[material], vertices[vertex_base + gl_VertexIndex]);
    vec3 at = (light.shadow_from_world * vec4(saved_position(instance, position_base + gl_VertexIndex), 1.0)).xyz;
    gl_Position = vec4(at.xy * 2.0 - 1.0, at.z, 1.0);
}
