// Skinning of one vertex, whatever its influences' matrices come from: the includer defines `Rows influence(SkinJobGpu
// job, uint joint)`, model_from_mesh of a palette entry.
#ifndef SKIN_GLSL
#define SKIN_GLSL
#include "rows.glsl"

SkinJobGpu job_of_group(uint group) {
    uint low = 0, high = job_count - 1;
    while (low < high) {
        uint middle = (low + high + 1) / 2;
        if (jobs[job_base + middle].first_group <= group) low = middle; else high = middle - 1;
    }
    return jobs[job_base + low];
}

// Number of this workgroup among those of all jobs.
uint group_number() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

// Adds the morph targets that move the vertex.
void add_morphs(inout VertexGpu v, SkinJobGpu job) {
    if (job.weight_base == NO_MORPHS) return;
    for (uint i = 0; i < v.morphs.y; i++) {
        MorphDeltaGpu delta = morph_deltas[v.morphs.x + i];
        float weight = morph_weights[job.weight_base + delta.morph];
        v.position_u.xyz += weight * delta.position;
        v.normal_v.xyz += weight * delta.normal;
        v.tangent.xyz += weight * delta.tangent;
    }
}

vec4 transform(Rows m, vec4 p) { return vec4(dot(m.r[0], p), dot(m.r[1], p), dot(m.r[2], p), 1.0); }

void save_position(SkinJobGpu job, uint index, Rows model_from_mesh, vec3 position) {
    vec4 in_model = transform(model_from_mesh, vec4(position, 1.0));
    saved_vertices[job.output_base + index] = transform(Rows(job.world_from_model), in_model);
}

// The position to saved_vertices, or normal and tangent to saved_frames, in the world.
void skin_vertex(SkinJobGpu job, uint index) {
    VertexGpu v = vertices[job.vertex_base + index];
    add_morphs(v, job);
    uint joints[4] = uint[4](v.joints.x & 0xffff, v.joints.x >> 16, v.joints.y & 0xffff, v.joints.y >> 16);
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (int i = 0; i < 4; i++) {
        if (v.weights[i] <= 0.0) continue;
        Rows matrix = influence(job, joints[i]);
        for (int r = 0; r < 3; r++) sum.r[r] += v.weights[i] * matrix.r[r];
    }
    Rows world = Rows(job.world_from_model);
    if (writes_frames == 0) {
        save_position(job, index, sum, v.position_u.xyz);
        return;
    }
    // Normals go through the cofactors of the matrix, which stay right under non-uniform scale.
    Rows whole = multiply(world, sum);
    mat3 m = transpose(mat3(whole.r[0].xyz, whole.r[1].xyz, whole.r[2].xyz));
    mat3 cofactors = mat3(cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1]));
    // With the determinant's sign, from the very product that the cofactors came from.
    float side = dot(m[0], cofactors[0]) < 0.0 ? -1.0 : 1.0;
    vec3 normal = cofactors * v.normal_v.xyz * side, tangent = m * v.tangent.xyz;
    saved_frames[job.output_base + index].normal = vec4(normal / max(length(normal), 1e-20), 0.0);
    saved_frames[job.output_base + index].tangent = vec4(tangent / max(length(tangent), 1e-20), v.tangent.w);
}

#endif
