// Skins a vertex from the buffer that holds all of it: the includer defines `Rows influence(uint joint)`, model_from_mesh of
// a palette entry.
#ifndef SKIN_WHOLE_GLSL
#define SKIN_WHOLE_GLSL

// Influences of weight 0 come last.
Rows blend(uvec2 joints, vec4 weights) {
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < MAX_INFLUENCES; i++) {
        if (weights[i] <= 0.0) break;
        Rows matrix = influence(joint_of(joints, i));
        for (int r = 0; r < AFFINE_ROWS; r++) sum.r[r] += weights[i] * matrix.r[r];
    }
    return sum;
}

// Numbers within a mesh, those of its coarsest level first.
layout(std430, binding = 13) readonly buffer VertexOrder { uint vertex_order[]; };

void skin_whole_vertex() {
    if (gl_GlobalInvocationID.x >= job.vertex_count) return;
    uint index = vertex_order[job.vertex_base + gl_GlobalInvocationID.x], vertex = job.vertex_base + index;
    Rows model_from_mesh = blend(vertices[vertex].joints, vertices[vertex].weights);
    skin_vertex(index, vertices[vertex].position_u.xyz, model_from_mesh);
}

#endif
