#version 460
#extension GL_GOOGLE_include_directive : require
// The pictures of the eyes on the window, each in the middle of its part, with figures over them.
#include "present.glsl"

layout(binding = 0) uniform sampler2DArray picture; // sRGB, a layer an eye
layout(location = 0) out vec4 color;

void main() {
    vec2 part = vec2(window_extent.x / float(panes), window_extent.y);
    float eye = min(floor(gl_FragCoord.x / part.x), float(panes - 1));
    vec2 in_part = gl_FragCoord.xy - vec2(eye * part.x, 0.0);
    vec2 uv = (in_part - (part - pane_extent) * 0.5) / pane_extent;
    bool is_inside = all(greaterThanEqual(uv, vec2(0.0))) && all(lessThanEqual(uv, vec2(1.0)));
    vec2 last = picture_part - 0.5 / vec2(textureSize(picture, 0).xy);
    uv = min(uv * picture_part, last);
    color = presented(is_inside ? textureLod(picture, vec3(uv, eye), 0.0).rgb : vec3(0.0));
}
