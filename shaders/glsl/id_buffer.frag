#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Writes the entry of the patch from FIRST_ID on; 0 is background.
#include "scene.glsl"

layout(std430, binding = 3) readonly buffer PatchOfTriangle { uint patch_of_triangle[]; };
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(binding = 5) uniform sampler2D textures[];
#include "alpha.glsl"
layout(push_constant) uniform IdBufferPush {
    uint vertex_base;
    uint position_base;
    uint triangle_base;
    uint first_entry;
    uint material;
    uint first_view;
    uint instance;
};
layout(location = 0) in vec3 lookup;
layout(location = 0) out uint id;

void main() {
    if (is_cut_out(materials[material], lookup)) discard;
    id = FIRST_ID + first_entry + patch_of_triangle[triangle_base + gl_PrimitiveID];
}
