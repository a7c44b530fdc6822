#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// As id_buffer.vert where fragments cannot be told the number of their triangle: reads the indices by itself, three to a triangle, and
// so knows it. It places a vertex once for each triangle.
#include "id_buffer_vertex.glsl"

layout(std430, binding = 7) readonly buffer Indices { uint indices[]; };
layout(location = 1) flat out uint pulled_id;

void main() {
    place(indices[3 * triangle_base + gl_VertexIndex]);
    pulled_id = id_of(gl_VertexIndex / 3);
}
