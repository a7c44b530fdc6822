#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// The same geometry as client_atlas.vert, for measurements.
#include "client_geometry.glsl"

layout(std430, binding = 0) readonly buffer Corners { CornerGpu corners[]; };
layout(std430, binding = 1) readonly buffer Positions { vec4 positions[]; };
layout(std140, binding = 2) uniform Eyes { EyesGpu eyes; };
layout(location = 0) flat out uint instance;

void main() {
    CornerGpu corner = corners[gl_VertexIndex];
    instance = corner.instance;
    gl_Position = clip_position(eyes.clip_from_world[gl_ViewIndex], positions[corner.vertex_slot]);
}
