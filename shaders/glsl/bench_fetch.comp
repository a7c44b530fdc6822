#version 460
#extension GL_GOOGLE_include_directive : require
// What skinning is made of, for measuring the device's rate: a few vec4 for each invocation, fetched from a storage buffer
// at places that it has for itself, multiplied and added to a sum, which is stored.
layout(local_size_x = 128) in;

layout(std430, binding = 0) readonly buffer Table { vec4 table[]; };
layout(std430, binding = 1) writeonly buffer Sums { vec4 sums[]; };
layout(push_constant) uniform BenchFetchPush {
    uint fetches; // of each invocation
    uint mask;    // length of the table less one, a power of two
};

void main() {
    uint at = gl_GlobalInvocationID.x * 7;
    vec4 sum = vec4(0.0);
    for (uint i = 0; i < fetches; i += 4) {
        // Four at known distances, as the rows of a matrix are; only the first place is computed.
        sum += 0.25 * table[at & mask];
        sum += 0.50 * table[(at + 1) & mask];
        sum += 0.75 * table[(at + 2) & mask];
        sum += 0.125 * table[(at + 3) & mask];
        at += 13;
    }
    sums[gl_GlobalInvocationID.x] = sum;
}
