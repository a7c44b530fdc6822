#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// The ground truth: per-pixel shading with the atlas's own shading code.
#include "scene.glsl"
#include "environment.glsl"
#include "light.glsl"

layout(std140, binding = 3) uniform View { ViewGpu view; };
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(std140, binding = 5) uniform Light { LightGpu light; };
layout(binding = 6) uniform sampler2D textures[];
layout(binding = 7) uniform sampler2D shadow_map;
#include "pbr.glsl"
layout(push_constant) uniform ForwardPush {
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material;
    uint instance;
};
layout(location = 0) in vec3 world_position;
layout(location = 1) in vec3 world_normal;
layout(location = 2) in vec4 world_tangent;
layout(location = 3) in vec4 uvs; // both sets
layout(location = 4) in vec4 vertex_color;
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

void main() {
    MaterialGpu m = materials[material];
    float side = m.double_sided != 0 && !gl_FrontFacing ? -1.0 : 1.0;
    vec4 dx = dFdx(uvs), dy = dFdy(uvs);
    Surface s = Surface(world_position, world_normal * side, world_tangent.xyz, world_tangent.w,
        uvs.xy, dx.xy, dy.xy, uvs.zw, dx.zw, dy.zw, vertex_color);
    float sun_reaches = -1.0;
    vec4 shown = display_color(m, s, view.world_eye.xyz, sun_reaches);
    if (m.alpha_cutoff != NO_ALPHA_CUTOFF && shown.a < m.alpha_cutoff) discard;
    color = vec4(shown.rgb, 1.0);
}
