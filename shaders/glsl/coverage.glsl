// What a cutout leaves of its blocks: a bit a texel of the atlas, row by row. Included after the buffer `Coverage`, which
// begins with the atlas's width. Twin: Plane::linear of twin/atlas_lookup.rs, of zeros and ones.
#ifndef COVERAGE_GLSL
#define COVERAGE_GLSL

float covers(uvec2 at) {
    uint bit = at.y * width_texels + at.x;
    return float(covered[bit / 32] >> (bit % 32) & 1);
}

// Between the four nearest texels the edge lies where a straight line of their bits passes a half. `at` is inside the block.
bool is_covered(vec2 at) {
    vec2 first = floor(at - 0.5), f = at - 0.5 - first;
    uvec2 t = uvec2(first);
    float upper = mix(covers(t), covers(t + uvec2(1, 0)), f.x);
    float lower = mix(covers(t + uvec2(0, 1)), covers(t + uvec2(1, 1)), f.x);
    return mix(upper, lower, f.y) >= 0.5;
}

#endif
