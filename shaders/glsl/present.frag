#version 460
#extension GL_GOOGLE_include_directive : require
// The rendered picture on the window, with figures over it.
#include "environment.glsl"

layout(binding = 0) uniform sampler2D picture; // sRGB, of the window's size
layout(std430, binding = 1) readonly buffer Text { uint text[]; };
layout(push_constant) uniform PresentPush {
    uvec2 cells;         // columns and rows of figures; 0 for none
    uint pixels_per_dot;
    uint codes_srgb;     // 1: the window's format does not
};
layout(location = 0) out vec4 color;
#include "text.glsl"

void main() {
    vec3 c = texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb;
    vec2 at = (gl_FragCoord.xy / float(pixels_per_dot) - vec2(2.0)) / GLYPH_EXTENT;
    if (all(greaterThanEqual(at, vec2(-0.5))) && all(lessThan(at, vec2(cells) + 0.5)) && cells.y > 0) {
        c = mix(c * 0.25, vec3(0.95), text_dot(at, cells));
    }
    color = vec4(codes_srgb != 0 ? srgb_from_linear(c) : c, 1.0);
}
