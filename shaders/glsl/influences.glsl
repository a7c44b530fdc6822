// The joints that move a vertex, two in a word.
#ifndef INFLUENCES_GLSL
#define INFLUENCES_GLSL

uint joint_of(uvec2 joints, uint i) { return (joints[i / 2] >> (16 * (i & 1))) & 0xffff; }

#endif
