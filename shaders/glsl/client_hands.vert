#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// Both controllers as simple shapes, one an instance: a handle that narrows to where it points.
#include "client_geometry.glsl"

struct HandsGpu {
    mat4 space_from_hand[2]; // the controller lies along z, and points to -z; metres
    vec4 is_shown;           // x left, y right
};
layout(std140, binding = 0) uniform Eyes { EyesGpu eyes; };
layout(std140, binding = 1) uniform Hands { HandsGpu hands; };
layout(location = 0) flat out vec3 shade;

const vec3 HALF_EXTENT_M = vec3(0.02, 0.016, 0.06);
// Its width at the tip, of that at its other end.
const float TIP = 0.35;

void main() {
    int face = gl_VertexIndex / 6, corner = gl_VertexIndex % 6;
    float side = (face & 1) == 0 ? 1.0 : -1.0;
    // Two triangles, counter-clockwise from outside where the side is the positive one.
    float u = corner == 1 || corner == 2 || corner == 4 ? 1.0 : -1.0;
    float v = corner == 2 || corner == 4 || corner == 5 ? 1.0 : -1.0;
    u *= side;
    int axis = face >> 1;
    vec3 at = axis == 0 ? vec3(side, u, v) : axis == 1 ? vec3(v, side, u) : vec3(u, v, side);
    vec3 outward = vec3(axis == 0, axis == 1, axis == 2) * side;
    float width = mix(TIP, 1.0, at.z * 0.5 + 0.5);
    vec3 in_hand = at * HALF_EXTENT_M * vec3(width, width, 1.0);
    bool is_left = gl_InstanceIndex == 0;
    bool is_shown = (is_left ? hands.is_shown.x : hands.is_shown.y) > 0.0;
    // Light from above, as far as a face looks there; one that is not shown has no area.
    vec3 normal = mat3(hands.space_from_hand[gl_InstanceIndex]) * outward;
    shade = (is_left ? vec3(0.25, 0.35, 0.6) : vec3(0.6, 0.33, 0.2)) * (0.6 + 0.4 * normal.y);
    vec4 in_space = hands.space_from_hand[gl_InstanceIndex] * vec4(is_shown ? in_hand : vec3(0), 1.0);
    gl_Position = eyes.clip_from_world[gl_ViewIndex] * in_space;
}
