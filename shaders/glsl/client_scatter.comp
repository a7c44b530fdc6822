#version 460
#extension GL_GOOGLE_include_directive : require
// Writes what a delta says about vertices into the client's vertex memory: entries first, samples in a dispatch after it.
// Twin: twin/interpolate.rs.
layout(local_size_x = 64) in;
#include "client_vertices.glsl"

// REST_BIT in slot: half a rest, the second one with REST_END_BIT; tag is the last of its words. Otherwise, NO_SAMPLE as
// tag: a vertex enters, static (STATIC_BIT in slot, with its position), skinned (SKINNED_BIT, x and y as in skins),
// predicted (PREDICTED_BIT), or sampled. Any other tag: one sample.
struct VertexWriteGpu {
    uint slot;
    uint tag;
    uint x;
    uint y;
    uint z;
};
layout(std430, binding = 0) buffer Samples { uvec4 samples[]; };
layout(std430, binding = 1) buffer Positions { vec4 positions[]; };
layout(std430, binding = 2) writeonly buffer Blends { vec4 blends[]; };
layout(std430, binding = 3) readonly buffer Writes { VertexWriteGpu writes[]; };
layout(std430, binding = 4) writeonly buffer Skins { uvec2 skins[]; };
layout(std430, binding = 5) writeonly buffer Rests { RestGpu rests[]; };
layout(push_constant) uniform ScatterPush {
    uint first;
    uint count;
    uint vertex_slots;
    uint sample_ring;     // steps of the grid that are kept
};

void write_rest(VertexWriteGpu write) {
    uint rest = write.slot & SLOT_MASK;
    if (rest >= rests.length()) return;
    uvec4 half_rest = uvec4(write.x, write.y, write.z, write.tag);
    if ((write.slot & REST_END_BIT) == 0) rests[rest].position_joints = half_rest; else rests[rest].influences = half_rest;
}

void enter(uint slot, VertexWriteGpu write) {
    bool is_static = (write.slot & STATIC_BIT) != 0, is_skinned = (write.slot & SKINNED_BIT) != 0;
    for (uint i = 0; i < sample_ring; i++) samples[i * vertex_slots + slot] = uvec4(0);
    positions[slot] = is_static ? vec4(uintBitsToFloat(uvec3(write.x, write.y, write.z)), ON_CURVE) : vec4(0.0);
    bool is_predicted = (write.slot & PREDICTED_BIT) != 0;
    blends[slot] = vec4(0.0, 0.0, 0.0, is_predicted ? PREDICTED_BLEND : is_static || is_skinned ? STATIC_BLEND : 0.0);
    skins[slot] = is_skinned ? uvec2(write.x, write.y) : uvec2(NO_REST, 0);
}

void main() {
    if (gl_GlobalInvocationID.x >= count) return;
    VertexWriteGpu write = writes[first + gl_GlobalInvocationID.x];
    if ((write.slot & REST_BIT) != 0) {
        write_rest(write);
        return;
    }
    uint slot = write.slot & SLOT_MASK;
    if (slot >= vertex_slots) return;
    if (write.tag == NO_SAMPLE) {
        enter(slot, write);
        return;
    }
    uint at = ring_place(slot, write.tag, sample_ring, vertex_slots);
    bool revised = samples[at].w == write.tag;
    samples[at] = uvec4(write.x, write.y, write.z, write.tag);
    if (revised && positions[slot].w == ON_CURVE) positions[slot].w = PAST_THE_END;
}
