// How a colour is made of the atlas's texels: in a straight line between the nearest, or luma by Catmull and Rom's cubic.
// Twin: twin/atlas_lookup.rs.
#ifndef ATLAS_LOOKUP_GLSL
#define ATLAS_LOOKUP_GLSL

// The nearest place that the patch's triangles map to. The middle of a pixel of which a triangle covers a corner alone lies
// outside the triangle, in a small or far one by many texels. block: left, top, right, bottom in texels.
vec2 inside_block(vec2 at, vec4 block) {
    return clamp(at, block.xy + BLOCK_INSET_TEXELS, block.zw - BLOCK_INSET_TEXELS);
}

// Of sixteen texels by five bilinear lookups, without the four corners, which count for little. The outer ones go no
// farther than the block's outermost texels. `at` is inside the block.
float cubic_lookup(sampler2D plane, vec2 at, vec4 block) {
    vec2 second = floor(at - 0.5) + 0.5, f = at - second;
    vec2 w0 = f * (-0.5 + f * (1.0 - 0.5 * f)), w1 = 1.0 + f * f * (1.5 * f - 2.5);
    vec2 w2 = f * (0.5 + f * (2.0 - 1.5 * f)), w3 = f * f * (0.5 * f - 0.5);
    vec2 inner = w1 + w2, scale = 1.0 / vec2(textureSize(plane, 0));
    vec2 first = max(second - 1.0, block.xy + 0.5) * scale, last = min(second + 2.0, block.zw - 0.5) * scale;
    vec2 middle = (second + w2 / inner) * scale;
    float value = texture(plane, middle).r * inner.x * inner.y
        + texture(plane, vec2(first.x, middle.y)).r * w0.x * inner.y
        + texture(plane, vec2(last.x, middle.y)).r * w3.x * inner.y
        + texture(plane, vec2(middle.x, first.y)).r * inner.x * w0.y
        + texture(plane, vec2(middle.x, last.y)).r * inner.x * w3.y;
    return value / (inner.x * inner.y + (w0.x + w3.x) * inner.y + inner.x * (w0.y + w3.y));
}

#endif
