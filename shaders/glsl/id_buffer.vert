#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// Visibility: one draw of every instance per predicted time, both eyes at once.
#include "scene.glsl"
#define SAVED_VERTICES_BINDING 1
#define BOXES_BINDING 6
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std140, binding = 2) uniform Views { ViewGpu views[MAX_VIEWS]; };
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(push_constant) uniform IdBufferPush {
    uint vertex_base;
    uint position_base;  // of the instance at the view's time
    uint triangle_base;  // of the primitive, into patch_of_triangle
    uint first_entry;    // of the instance's patches, in visible
    uint material;
    uint first_view;
    uint instance;
};
layout(location = 0) out vec3 lookup;

void main() {
    lookup = alpha_lookup(materials[material], vertices[vertex_base + gl_VertexIndex]);
    gl_Position = views[first_view + gl_ViewIndex].clip_from_world * vec4(saved_position(instance, position_base + gl_VertexIndex), 1.0);
}
