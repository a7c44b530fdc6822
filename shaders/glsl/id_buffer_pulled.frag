#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_nonuniform_qualifier : require
// Writes which patch is seen, as the vertices tell it.
#include "id_buffer_fragment.glsl"

layout(location = 1) flat in uint pulled_id;

void main() {
    cut_out();
    id = pulled_id;
}
