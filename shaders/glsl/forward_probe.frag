#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// What is where in the ground truth: instance and distance along the view axis, one sample a pixel.
#include "scene.glsl"
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(binding = 6) uniform sampler2D textures[];
#include "alpha.glsl"
layout(push_constant) uniform ForwardPush {
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material;
    uint instance;
};
layout(location = 0) in vec3 lookup;
layout(location = 0) out uint id; // FIRST_ID and up; 0 is background
layout(location = 1) out float distance_m;

void main() {
    if (is_cut_out(materials[material], lookup)) discard;
    id = FIRST_ID + instance;
    distance_m = 1.0 / gl_FragCoord.w;
}
