// How a colour is made of the atlas's texels: in a straight line between the nearest, or luma by Catmull and Rom's cubic.
// Twin: twin/atlas_lookup.rs.
#ifndef ATLAS_LOOKUP_GLSL
#define ATLAS_LOOKUP_GLSL

// The nearest place that the patch's triangles map to. The middle of a pixel of which a triangle covers a corner alone lies
// outside the triangle, in a small or far one by many texels. block: left, top, right, bottom in texels.
vec2 inside_block(vec2 at, vec4 block) {
    return clamp(at, block.xy + BLOCK_INSET_TEXELS, block.zw - BLOCK_INSET_TEXELS);
}

// The nearest place where no lookup of chroma leaves the block: its samples lie farther apart.
vec2 inside_chroma(vec2 at, vec4 block) {
    return clamp(at, block.xy + CHROMA_INSET_TEXELS, block.zw - CHROMA_INSET_TEXELS);
}

// Places of the five lookups, texels, and the weights that they are made of, by axis.
struct CubicTaps {
    vec2 first, middle, last;
    vec2 before, inner, behind;
    float weight;
};

// Of sixteen texels by five bilinear lookups, without the four corners, which count for little. The outer ones go no
// farther than the block's outermost texels. `at` is inside the block.
CubicTaps cubic_taps(vec2 at, vec4 block) {
    vec2 second = floor(at - 0.5) + 0.5, f = at - second;
    vec2 w0 = f * (-0.5 + f * (1.0 - 0.5 * f)), w1 = 1.0 + f * f * (1.5 * f - 2.5);
    vec2 w2 = f * (0.5 + f * (2.0 - 1.5 * f)), w3 = f * f * (0.5 * f - 0.5);
    vec2 inner = w1 + w2;
    vec2 first = max(second - 1.0, block.xy + 0.5), last = min(second + 2.0, block.zw - 0.5);
    float weight = inner.x * inner.y + (w0.x + w3.x) * inner.y + inner.x * (w0.y + w3.y);
    return CubicTaps(first, second + w2 / inner, last, w0, inner, w3, weight);
}

// texels: of the plane. (The compiler's reflection misses a plane that its caller does not ask for its size.)
float cubic_lookup(sampler2D plane, ivec2 texels, vec2 at, vec4 block) {
    CubicTaps taps = cubic_taps(at, block);
    vec2 scale = 1.0 / vec2(texels);
    vec2 first = taps.first * scale, middle = taps.middle * scale, last = taps.last * scale;
    float value = textureLod(plane, middle, 0.0).r * taps.inner.x * taps.inner.y
        + textureLod(plane, vec2(first.x, middle.y), 0.0).r * taps.before.x * taps.inner.y
        + textureLod(plane, vec2(last.x, middle.y), 0.0).r * taps.behind.x * taps.inner.y
        + textureLod(plane, vec2(middle.x, first.y), 0.0).r * taps.inner.x * taps.before.y
        + textureLod(plane, vec2(middle.x, last.y), 0.0).r * taps.inner.x * taps.behind.y;
    return value / taps.weight;
}

#endif
