// Skinning of one vertex, whatever its influences' matrices come from: the includer blends them.
//
// Every member is read where it is needed and no structure is copied: what a vertex costs is what it reads.
#ifndef SKIN_GLSL
#define SKIN_GLSL
#include "rows.glsl"

// Where a morph delta's members go, by its target's weight.
vec3 morphed(uint vertex, uint member, vec3 value) {
    if (job.weight_base == NO_MORPHS) return value;
    uvec2 range = vertices[vertex].morphs;
    for (uint i = range.x; i < range.x + range.y; i++) {
        float weight = morph_weights[job.weight_base + morph_deltas[i].morph];
        vec3 delta = member == POSITION ? morph_deltas[i].position
            : member == NORMAL ? morph_deltas[i].normal : morph_deltas[i].tangent;
        value += weight * delta;
    }
    return value;
}

vec4 transform(Rows m, vec4 p) { return vec4(dot(m.r[0], p), dot(m.r[1], p), dot(m.r[2], p), 1.0); }

// The position in the world to the saved vertices.
void skin_position(uint index, vec3 position, Rows model_from_mesh) {
    vec4 in_model = transform(model_from_mesh, vec4(position, 1.0));
    vec3 in_world = transform(Rows(job.world_from_model), in_model).xyz;
    uint at = job.output_base + index;
    saved_vertices[at / CHUNK_VERTICES].at[at % CHUNK_VERTICES] = pack_position(job.instance, in_world);
}

// Normal and tangent in the world to tangents.
void skin_frame(uint index, Rows model_from_mesh) {
    uint vertex = job.vertex_base + index;
    vec3 normal = morphed(vertex, NORMAL, vertices[vertex].normal_v.xyz);
    vec4 tangent = vertices[vertex].tangent;
    tangent.xyz = morphed(vertex, TANGENT, tangent.xyz);
    // Normals go through the cofactors of the matrix, which stay right under non-uniform scale.
    Rows whole = multiply(Rows(job.world_from_model), model_from_mesh);
    mat3 m = transpose(mat3(whole.r[0].xyz, whole.r[1].xyz, whole.r[2].xyz));
    mat3 cofactors = mat3(cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1]));
    // With the determinant's sign, from the very product that the cofactors came from.
    float side = dot(m[0], cofactors[0]) < 0.0 ? -1.0 : 1.0;
    normal = cofactors * normal * side;
    tangent.xyz = m * tangent.xyz;
    uint at = job.output_base + index;
    tangents[at / CHUNK_VERTICES].at[at % CHUNK_VERTICES] = pack_frame(normal, tangent);
}

void skin_vertex(uint index, vec3 position, Rows model_from_mesh) {
    if (WRITES_FRAMES == 0) {
        skin_position(index, morphed(job.vertex_base + index, POSITION, position), model_from_mesh);
    } else {
        skin_frame(index, model_from_mesh);
    }
}

#endif
