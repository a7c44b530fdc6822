#version 460
#extension GL_GOOGLE_include_directive : require
// One ring around the visible patches of an instance: whatever shares a vertex with one of them counts as visible too. Two
// dispatches, one after the other: vertices, then patches. Twin: twin/spread.rs.
layout(local_size_x = 64) in;
#include "scene.glsl"

layout(std430, binding = 0) readonly buffer Patches { PatchGpu patches[]; };
layout(std430, binding = 1) buffer Visible { uint visible[]; };
layout(std430, binding = 2) buffer Reached { uint reached[]; }; // a bit a vertex
layout(push_constant) uniform SpreadPush {
    uint patch_base;   // of the model's level of detail, into patches
    uint first_entry;  // of the instance's patches, into visible
    uint patch_count;
    uint first_vertex; // of the instance, into reached
};
// 0: from patches to their vertices; 1: from vertices to their patches. Devices that evaluate both sides of a branch are
// spared the other.
layout(constant_id = 0) const uint TO_PATCHES = 0;

void main() {
    uint index = gl_GlobalInvocationID.x;
    if (index >= patch_count) return;
    bool is_visible = visible[first_entry + index] != 0;
    if (is_visible == (TO_PATCHES != 0)) return;
    PatchGpu p = patches[patch_base + index];
    for (int i = 0; i < PATCH_MAX_VERTICES; i++) {
        uint vertex = first_vertex + p.vertices[i];
        uint bit = 1u << (vertex & 31u);
        if (TO_PATCHES == 0) {
            atomicOr(reached[vertex >> 5], bit);
        } else if ((reached[vertex >> 5] & bit) != 0) {
            visible[first_entry + index] = SPREAD;
        }
    }
}
