#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Writes which patch is seen, where the device numbers the triangles of a draw.
#include "id_buffer_fragment.glsl"

void main() {
    cut_out();
    id = id_of(gl_PrimitiveID);
}
