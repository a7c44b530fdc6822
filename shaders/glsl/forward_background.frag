#version 460
#extension GL_GOOGLE_include_directive : require
// The environment as the user sees it.
#include "environment.glsl"
#include "light.glsl"

layout(std140, binding = 0) uniform Light { LightGpu light; };
layout(push_constant) uniform BackgroundPush {
    mat4 world_from_clip_direction; // takes (ndc, 1, 1) to a world direction
};
layout(location = 0) in vec2 ndc;
layout(location = 0) out vec4 color;

void main() {
    vec3 direction = normalize((world_from_clip_direction * vec4(ndc, 1.0, 0.0)).xyz);
    color = vec4(tone_map(sky_radiance(light.zenith.rgb, light.horizon.rgb, light.nadir.rgb, direction)), 1.0);
}
