// What the shaders of the ID buffer share, however a pixel learns its triangle.
#ifndef ID_BUFFER_GLSL
#define ID_BUFFER_GLSL
#include "scene.glsl"
#include "alpha_lookup.glsl"

layout(std430, binding = 3) readonly buffer PatchOfTriangle { uint patch_of_triangle[]; };
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

// The entry of the patch from FIRST_ID on; 0 is background.
uint id_of(uint triangle) { return FIRST_ID + first_entry + patch_of_triangle[triangle_base + triangle]; }

#endif
