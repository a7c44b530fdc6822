// What skinning reads and writes.
#ifndef SKIN_BUFFERS_GLSL
#define SKIN_BUFFERS_GLSL
#include "influences.glsl"
#include "scene.glsl"

const uint POSITION = 0, NORMAL = 1, TANGENT = 2; // members that morph

struct MorphDeltaGpu {
    vec3 position;
    uint morph;
    vec3 normal;
    uint reserved0;
    vec3 tangent;
    uint reserved1;
};

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 1) readonly buffer MorphDeltas { MorphDeltaGpu morph_deltas[]; };
layout(std430, binding = 2) readonly buffer MorphWeights { float morph_weights[]; };
layout(std430, binding = 3) writeonly buffer SavedVertices { vec4 saved_vertices[]; };
layout(std430, binding = 4) writeonly buffer Tangents { TangentGpu tangents[]; };

// One instance at one sample time: a dispatch of its own. Read from a buffer, it would cost every invocation as much as
// an influence does.
layout(push_constant) uniform SkinJob {
    vec4 world_from_model[AFFINE_ROWS]; // rows
    uint vertex_base;
    uint vertex_count;
    uint palette_base;        // of its pose, into palettes
    uint output_base;         // into saved_vertices or tangents
    uint weight_base;         // of its pose, into morph_weights; NO_MORPHS
    uint pose;                // into poses
    uint writes_tangents;       // 0: positions, 1: normals and tangents
    uint packed_base;         // into packed_vertices
} job;

#endif
