#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// Visibility: one draw of every instance per predicted time, both eyes at once.
#include "id_buffer_vertex.glsl"

void main() { place(gl_VertexIndex); }
