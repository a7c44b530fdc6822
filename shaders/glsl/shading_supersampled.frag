#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// As shading.frag, each texel at SUPERSAMPLES by SUPERSAMPLES places: for measurements.
#include "shading.glsl"

void main() {
    vec4 sum = vec4(0.0);
    for (uint at = 0; at < SUPERSAMPLES * SUPERSAMPLES; at++) {
        vec2 place = vec2(at % SUPERSAMPLES, at / SUPERSAMPLES) + 0.5;
        sum += shaded(middle_texel + place / float(SUPERSAMPLES) - 0.5);
    }
    color = sum / float(SUPERSAMPLES * SUPERSAMPLES);
}
