// What skinning reads and writes.
#ifndef SKIN_BUFFERS_GLSL
#define SKIN_BUFFERS_GLSL
#include "scene.glsl"

// One instance at one sample time.
struct SkinJobGpu {
    vec4 world_from_model[3]; // rows
    uint first_group;         // workgroups of the jobs before it
    uint vertex_base;
    uint vertex_count;
    uint palette_base;        // of its pose, into palettes
    uint output_base;         // into saved_vertices or saved_frames
    uint weight_base;         // of its pose, into morph_weights; NO_MORPHS
    uint pose;                // into poses
    uint packed_base;         // into packed_vertices
    uvec4 packed_ends;        // where the vertices of 1, 2, 3, 4 influences end, multiples of 64, from packed_base
};

const uint NO_MORPHS = 0xffffffffu;

struct MorphDeltaGpu {
    vec3 position;
    uint morph;
    vec3 normal;
    uint reserved0;
    vec3 tangent;
    uint reserved1;
};

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 1) readonly buffer Jobs { SkinJobGpu jobs[]; };
layout(std430, binding = 2) readonly buffer MorphDeltas { MorphDeltaGpu morph_deltas[]; };
layout(std430, binding = 3) readonly buffer MorphWeights { float morph_weights[]; };
layout(std430, binding = 4) writeonly buffer SavedVertices { vec4 saved_vertices[]; };
layout(std430, binding = 5) writeonly buffer SavedFrames { FrameGpu saved_frames[]; };
layout(push_constant) uniform SkinPush {
    uint job_base;
    uint job_count;
    uint writes_frames; // 0: positions, 1: normals and tangents
};

#endif
