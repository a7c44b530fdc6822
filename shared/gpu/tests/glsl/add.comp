#version 460
// Adds to each of the terms, for the tests of dispatches.
layout(local_size_x = 128) in;

layout(std430, binding = 0) readonly buffer Terms { vec4 terms[]; };
layout(std430, binding = 1) writeonly buffer Sums { vec4 sums[]; };
layout(push_constant) uniform AddPush { float added; };

void main() { sums[gl_GlobalInvocationID.x] = terms[gl_GlobalInvocationID.x] + added; }
