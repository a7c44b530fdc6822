// A vertex where its skeleton moves it. Who includes this has palettes, morph_weights and arena, which client_skin.comp describes.
#ifndef CLIENT_SKIN_GLSL
#define CLIENT_SKIN_GLSL

// Influences of weight 0 come last.
Rows blend(uvec4 influences, uint first_joints, uint palette_base) {
    uvec2 joints = uvec2(first_joints, influences.x);
    vec4 weights = vec4(unpackUnorm2x16(influences.y), unpackUnorm2x16(influences.z));
    Rows sum = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = 0; i < MAX_INFLUENCES; i++) {
        if (weights[i] <= 0.0) break;
        uint at = (palette_base + joint_of(joints, i)) * AFFINE_ROWS;
        for (int r = 0; r < AFFINE_ROWS; r++) sum.r[r] += weights[i] * palettes[at + r];
    }
    return sum;
}

vec3 morphed(vec3 position, uint morphs, uint palette_base) {
    uint first = morphs & ((1u << MORPH_FIRST_BITS) - 1u), end = first + (morphs >> MORPH_FIRST_BITS);
    for (uint i = first; i < end; i++) {
        uvec4 delta = arena[i];
        // Until they are written, words hold anything.
        uint weight = min(palette_base + delta.w, uint(morph_weights.length()) - 1);
        position += morph_weights[weight] * uintBitsToFloat(delta.xyz);
    }
    return position;
}

vec3 skinned(RestGpu rest, uint palette_base) {
    vec4 in_mesh = vec4(morphed(uintBitsToFloat(rest.position_joints.xyz), rest.influences.w, palette_base), 1.0);
    Rows m = blend(rest.influences, rest.position_joints.w, palette_base);
    return vec3(dot(m.r[0], in_mesh), dot(m.r[1], in_mesh), dot(m.r[2], in_mesh));
}

#endif
