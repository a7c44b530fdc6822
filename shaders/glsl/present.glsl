// What the last stage of a window does to a colour: figures over it, and the coding that the window's format leaves to it.
#ifndef PRESENT_GLSL
#define PRESENT_GLSL
#include "environment.glsl"

// Devices that evaluate both sides of a branch are spared the text where there is none, and the coding that a format does.
layout(constant_id = 0) const uint HAS_FIGURES = 1;
layout(constant_id = 1) const uint CODES_SRGB = 1; // the window's format does not
layout(std430, binding = 1) readonly buffer Text { uint text[]; };
layout(push_constant) uniform PresentPush {
    uvec2 cells;         // columns and rows of figures; 0 for none
    uint pixels_per_dot;
    uint panes;          // pictures beside each other
    vec2 window_extent;  // pixels
    vec2 pane_extent;    // pixels of each picture on the window
    vec2 picture_part;   // of the picture that is drawn, from its first corner on, 0..1
};
#include "text.glsl"

// The picture's colour on the window; where there are figures, on their panel.
vec4 presented(vec3 c) {
    if (HAS_FIGURES != 0) {
        vec2 at = (gl_FragCoord.xy / float(pixels_per_dot) - FIGURES_MARGIN_DOTS) / vec2(GLYPH_CELL_DOTS);
        c = mix(c * 0.25, vec3(0.95), text_dot(at, cells));
    }
    return vec4(CODES_SRGB != 0 ? srgb_from_linear(c) : c, 1.0);
}

#endif
