// What an alpha test needs of a vertex. Included after scene.glsl.
#ifndef ALPHA_LOOKUP_GLSL
#define ALPHA_LOOKUP_GLSL

// 0 where no material of a draw has holes. A test costs each vertex a lookup, and each fragment the early depth test.
layout(constant_id = 0) const uint IS_MASKED_DRAW = 1;

// The base colour's texture coordinates, and the vertex colour's alpha.
vec3 alpha_lookup(MaterialGpu m, VertexGpu v) {
    if (IS_MASKED_DRAW == 0) return vec3(0.0);
    vec2 uv = slot_uv(m, BASE_COLOR_SLOT, vec2(v.position_u.w, v.normal_v.w), v.uv1, 1.0);
    return vec3(uv, unpackUnorm4x8(v.color).a);
}

#endif
