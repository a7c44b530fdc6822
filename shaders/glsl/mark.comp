#version 460
#extension GL_GOOGLE_include_directive : require
// Union of the predicted views: sets visible[patch] for every patch in the ID buffer. Plain stores of the same
// value race harmlessly. Twin: twin/mark.rs.
layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0) uniform usampler2DArray id_buffer;
layout(std430, binding = 1) writeonly buffer Visible { uint visible[]; };

void main() {
    ivec3 at = ivec3(gl_GlobalInvocationID);
    if (any(greaterThanEqual(at, textureSize(id_buffer, 0)))) return;
    uint id = texelFetch(id_buffer, at, 0).x;
    if (id >= FIRST_ID) visible[id - FIRST_ID] = 1;
}
