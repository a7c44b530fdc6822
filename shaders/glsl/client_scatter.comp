#version 460
#extension GL_GOOGLE_include_directive : require
// Writes what a delta says about vertices into the client's vertex memory: entries first, samples in a dispatch after it.
// Twin: twin/interpolate.rs.
layout(local_size_x = 64) in;
#include "client_vertices.glsl"

// NO_SAMPLE as tag: a vertex enters, static (STATIC_BIT in slot, with its position) or sampled. Otherwise: one sample.
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
layout(push_constant) uniform ScatterPush {
    uint first;
    uint count;
    uint vertex_slots;
};

void main() {
    if (gl_GlobalInvocationID.x >= count) return;
    VertexWriteGpu write = writes[first + gl_GlobalInvocationID.x];
    uint slot = write.slot & ~STATIC_BIT;
    if (slot >= vertex_slots) return;
    uvec3 place = uvec3(write.x, write.y, write.z);
    if (write.tag != NO_SAMPLE) {
        uint at = ring_place(slot, write.tag, vertex_slots);
        bool revised = samples[at].w == write.tag;
        samples[at] = uvec4(place, write.tag);
        if (revised && positions[slot].w == ON_CURVE) positions[slot].w = PAST_THE_END;
        return;
    }
    bool is_static = (write.slot & STATIC_BIT) != 0;
    for (uint i = 0; i < SAMPLE_RING; i++) samples[i * vertex_slots + slot] = uvec4(0);
    positions[slot] = is_static ? vec4(uintBitsToFloat(place), ON_CURVE) : vec4(0.0);
    blends[slot] = vec4(0.0, 0.0, 0.0, is_static ? STATIC_BLEND : 0.0);
}
