#version 460
#extension GL_GOOGLE_include_directive : require
// Positions of all animated vertices at the display time, once per display frame for both eyes.
// Twin: twin/interpolate.rs.
layout(local_size_x = 64) in;
#include "client_vertices.glsl"

layout(std430, binding = 0) readonly buffer Samples { uvec4 samples[]; };
layout(std430, binding = 1) buffer Positions { vec4 positions[]; };
layout(std430, binding = 2) buffer Blends { vec4 blends[]; };
layout(push_constant) uniform InterpolatePush {
    uint vertex_count;    // slots from 0 on
    uint vertex_slots;    // stride of the ring
    uint sample_ring;     // steps of the grid that it has
    uint tag;             // of the last grid step at or before the display time
    float fraction;       // 0..1 from that step to the next
    uint tag_before;      // the same of the display frame before
    float fraction_before;
    float blend_step;     // share of the blending time that has passed since then
    uint cubic;           // 0: linear
    uint now;             // the display time as predictions have it in their tags
};

uvec4 sample_at(uint slot, uint at) { return samples[ring_place(slot, at, sample_ring, vertex_slots)]; }
vec3 place(uvec4 s) { return uintBitsToFloat(s.xyz); }

// Past the last sample the vertex goes on for one grid step at its last velocity, and then stays.
vec4 beyond(uint slot, uint at, float f) {
    uint last = 0;
    for (uint i = 0; i < sample_ring; i++) {
        uint known = samples[i * vertex_slots + slot].w;
        if (known <= at && known > last) last = known;
    }
    if (last == NO_SAMPLE) return vec4(0.0);
    vec3 end = place(sample_at(slot, last));
    uvec4 earlier = sample_at(slot, last - 1);
    vec3 velocity = earlier.w == last - 1 && earlier.w != NO_SAMPLE ? end - place(earlier) : vec3(0.0);
    return vec4(end + velocity * min(float(at - last) + f, 1.0), PAST_THE_END);
}

// xyz and state at `f` of the way from step `at` to the next.
vec4 curve(uint slot, uint at, float f) {
    uvec4 b = sample_at(slot, at), c = sample_at(slot, at + 1);
    if (b.w != at || c.w != at + 1) return beyond(slot, at, f);
    uvec4 a = sample_at(slot, at - 1), d = sample_at(slot, at + 2);
    if (cubic == 0 || a.w != at - 1 || d.w != at + 2) return vec4(mix(place(b), place(c), f), ON_CURVE);
    // Lagrange's polynomial through the four samples at -1, 0, 1, 2.
    vec4 w = vec4(-f * (f - 1.0) * (f - 2.0) / 6.0, (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0,
                  -(f + 1.0) * f * (f - 2.0) / 2.0, (f + 1.0) * f * (f - 1.0) / 6.0);
    return vec4(w.x * place(a) + w.y * place(b) + w.z * place(c) + w.w * place(d), ON_CURVE);
}

// How long before the display time a prediction's is, in units of predictions' times.
int since(uint tag) { return int(now - (tag - tag % TIME_TAG_UNIT)) / int(TIME_TAG_UNIT); }

// The paper's: on the line between the two predictions around the display time, at the first before them, at the last after.
vec4 predicted(uint slot) {
    uvec4 before = samples[vertex_slots + slot];
    if (before.w == NO_SAMPLE) return vec4(0.0);
    if (since(before.w) <= 0) return vec4(place(before), ON_CURVE);
    for (uint i = 2; i <= PREDICTIONS; i++) {
        uvec4 after = samples[i * vertex_slots + slot];
        if (after.w == NO_SAMPLE) break;
        int past = since(before.w), left = -since(after.w);
        if (left >= 0) return vec4(mix(place(before), place(after), float(past) / float(max(past + left, 1))), ON_CURVE);
        before = after;
    }
    return vec4(place(before), PAST_THE_END);
}

void main() {
    uint slot = gl_GlobalInvocationID.x;
    if (slot >= vertex_count) return;
    vec4 blend = blends[slot];
    if (blend.w == STATIC_BLEND) return;
    if (blend.w == PREDICTED_BLEND) {
        positions[slot] = predicted(slot);
        return;
    }
    vec4 before = positions[slot];
    vec4 now = curve(slot, tag, fraction);
    if (now.w == NOT_DRAWABLE) {
        positions[slot] = vec4(0.0);
        return;
    }
    if (before.w == PAST_THE_END && now.w == ON_CURVE) {
        // After a gap the curve at that time is not known, and the samples that were gone on from may have left the ring.
        vec4 then = curve(slot, tag_before, fraction_before);
        blend = then.w == ON_CURVE ? vec4(before.xyz - then.xyz, 1.0) : vec4(0.0);
    }
    blend.w = max(blend.w - blend_step, 0.0);
    blends[slot] = blend;
    positions[slot] = vec4(now.xyz + blend.xyz * blend.w, now.w);
}
