// What the last stage of a window does to a colour: figures over it, and the coding that the window's format leaves to it.
#ifndef PRESENT_GLSL
#define PRESENT_GLSL
#include "environment.glsl"

layout(std430, binding = 1) readonly buffer Text { uint text[]; };
layout(push_constant) uniform PresentPush {
    uvec2 cells;         // columns and rows of figures; 0 for none
    uint pixels_per_dot;
    uint codes_srgb;     // 1: the window's format does not
    vec2 window_extent;  // pixels
    vec2 pane_extent;    // pixels of each picture on the window
    vec2 picture_part;   // of the picture that is drawn, from its first corner on, 0..1
    uint panes;          // pictures beside each other
};
#include "text.glsl"

vec4 presented(vec3 c) {
    vec2 at = (gl_FragCoord.xy / float(pixels_per_dot) - vec2(2.0)) / GLYPH_EXTENT;
    if (all(greaterThanEqual(at, vec2(-0.5))) && all(lessThan(at, vec2(cells) + 0.5)) && cells.y > 0) {
        c = mix(c * 0.25, vec3(0.95), text_dot(at, cells));
    }
    return vec4(codes_srgb != 0 ? srgb_from_linear(c) : c, 1.0);
}

#endif
