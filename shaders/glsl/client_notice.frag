#version 460
#extension GL_GOOGLE_include_directive : require
// Light text on a dark panel through which the world is still guessed.
#include "client_notice.glsl"
layout(std430, binding = 2) readonly buffer Text { uint text[]; };
layout(location = 0) in vec2 cell;
layout(location = 0) out vec4 color; // linear, blended over; the attachment is sRGB

#include "text.glsl"

const vec3 PANEL = vec3(0.012);
const vec3 INK = vec3(0.9);
const float PANEL_COVERAGE = 0.85;

void main() {
    float share = text_coverage(cell, fwidth(cell) / 3.0, notice.text_cells.xy);
    color = vec4(mix(PANEL, INK, share), mix(PANEL_COVERAGE, 1.0, share));
}
