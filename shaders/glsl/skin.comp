#version 460
#extension GL_GOOGLE_include_directive : require
// Skins each vertex once with its pose's palette. Twin: scene/src/animation/pose.rs.
layout(local_size_x = 128) in;
#include "skin_buffers.glsl"
#include "skin.glsl"

layout(std430, binding = 5) readonly buffer Palettes { vec4 palettes[]; };

Rows influence(uint joint) {
    uint at = (job.palette_base + joint) * AFFINE_ROWS;
    return Rows(vec4[](palettes[at], palettes[at + 1], palettes[at + 2]));
}
#include "skin_whole.glsl"

void main() { skin_whole_vertex(); }
