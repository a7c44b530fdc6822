#version 460
#extension GL_GOOGLE_include_directive : require
// Positions of all skinned vertices at the display time, once per display frame for both eyes. Others are left alone.
// Twin: twin/skin.rs.
layout(local_size_x = 64) in;
#include "rows.glsl"
#include "influences.glsl"
#include "client_vertices.glsl"

layout(std430, binding = 0) readonly buffer Skins { uvec2 skins[]; };
layout(std430, binding = 1) readonly buffer Rests { RestGpu rests[]; };
layout(std430, binding = 2) readonly buffer Palettes { vec4 palettes[]; };
layout(std430, binding = 3) readonly buffer MorphWeights { float morph_weights[]; };
// As bits, since a morph's number is no float that every device would keep.
layout(std430, binding = 4) readonly buffer Arena { uvec4 arena[]; };
layout(std430, binding = 5) writeonly buffer Positions { vec4 positions[]; };
layout(push_constant) uniform SkinPush {
    uint vertex_count; // slots from 0 on
};

// Influences of weight 0 come last.
Rows blend(uvec4 influences, uint first_joints, uint palette_base) {
    uvec2 joints = uvec2(first_joints, influences.x);
    vec4 weights = vec4(unpackUnorm2x16(influences.y), unpackUnorm2x16(influences.z));
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < MAX_INFLUENCES; i++) {
        if (weights[i] <= 0.0) break;
        uint at = (palette_base + joint_of(joints, i)) * AFFINE_ROWS;
        for (int r = 0; r < AFFINE_ROWS; r++) sum.r[r] += weights[i] * palettes[at + r];
    }
    return sum;
}

vec3 morphed(vec3 position, uint morphs, uint palette_base) {
    uint first = morphs & ((1u << MORPH_FIRST_BITS) - 1u), end = first + (morphs >> MORPH_FIRST_BITS);
    for (uint i = first; i < end; i++) {
        uvec4 delta = arena[i];
        // Until they are written, words hold anything.
        uint weight = min(palette_base + delta.w, uint(morph_weights.length()) - 1);
        position += morph_weights[weight] * uintBitsToFloat(delta.xyz);
    }
    return position;
}

void main() {
    uint slot = gl_GlobalInvocationID.x;
    if (slot >= vertex_count) return;
    uvec2 skin = skins[slot];
    if (skin.x == NO_REST) return;
    RestGpu rest = rests[skin.x - 1];
    vec4 in_mesh = vec4(morphed(uintBitsToFloat(rest.position_joints.xyz), rest.influences.w, skin.y), 1.0);
    Rows m = blend(rest.influences, rest.position_joints.w, skin.y);
    positions[slot] = vec4(dot(m.r[0], in_mesh), dot(m.r[1], in_mesh), dot(m.r[2], in_mesh), ON_CURVE);
}
