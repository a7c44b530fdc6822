#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Depth alone; holes of masked materials let the sun through.
#include "scene.glsl"

layout(std430, binding = 3) readonly buffer Materials { MaterialGpu materials[]; };
layout(binding = 4) uniform sampler2D textures[];
#include "alpha.glsl"
layout(push_constant) uniform ShadowPush {
    uint vertex_base;
    uint position_base;
    uint material;
    uint instance;
};
layout(location = 0) in vec3 lookup;

void main() {
    if (is_cut_out(materials[material], lookup)) discard;
}
