// What skinning reads and writes.
#ifndef SKIN_BUFFERS_GLSL
#define SKIN_BUFFERS_GLSL
#include "influences.glsl"
#include "scene.glsl"

// 0: writes positions, 1: normals and tangents. Devices that evaluate both sides of a branch are spared the other.
layout(constant_id = 0) const uint WRITES_FRAMES = 0;
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
#define SAVED_IS_WRITTEN
#define SAVED_ACCESS writeonly
#define SAVED_VERTICES_BINDING 3
#define TANGENTS_BINDING 4
#define BOXES_BINDING 12
#include "saved.glsl"

// One instance at one sample time: a dispatch of its own. Read from a buffer, it would cost every invocation as much as
// an influence does.
layout(push_constant) uniform SkinJob {
    vec4 world_from_model[AFFINE_ROWS]; // rows
    uint vertex_base;
    uint vertex_count;
    uint palette_base;        // of its pose, into palettes
    uint output_base;         // of the instance, among the saved vertices or frames
    uint weight_base;         // of its pose, into morph_weights; NO_MORPHS
    uint pose;                // into poses
    uint packed_base;         // into packed_vertices
    uint instance;            // whose box positions are packed in
} job;

#endif
