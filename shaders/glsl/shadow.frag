#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Depth alone; holes of masked materials let the sun through.
#include "scene.glsl"

layout(std430, binding = 3) readonly buffer Materials { MaterialGpu materials[]; };
layout(binding = 4) uniform sampler2D textures[];
layout(push_constant) uniform ShadowPush {
    uint vertex_base;
    uint position_base;
    uint material;
};
layout(location = 0) in vec2 uv;

void main() {
    MaterialGpu m = materials[material];
    if (m.alpha_cutoff < 0.0) return;
    float alpha = m.base_color.a;
    if (m.base_color_texture >= 0) alpha *= texture(textures[nonuniformEXT(m.base_color_texture)], uv).a;
    if (alpha < m.alpha_cutoff) discard;
}
