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

#include "client_skin.glsl"

void main() {
    uint slot = gl_GlobalInvocationID.x;
    if (slot >= vertex_count) return;
    uvec2 skin = skins[slot];
    if (skin.x == NO_REST) return;
    RestGpu rest = rests[skin.x - 1];
    positions[slot] = vec4(skinned(rest, skin.y), ON_CURVE);
}
