// What both ways of drawing a bundle read: a corner per patch vertex, positions by slot, and the eyes.
#ifndef CLIENT_GEOMETRY_GLSL
#define CLIENT_GEOMETRY_GLSL

struct CornerGpu {
    uint vertex_slot;
    uint instance;
    vec2 atlas_texel; // inside the block's lookup rectangle
};

struct EyesGpu {
    mat4 clip_from_world[2];
    mat4 space_from_clip_direction[2]; // (ndc, 1, 0) to a direction in the backdrop's space
    vec4 space_eye[2];                 // xyz in the backdrop's space, metres
};

// A vertex without samples takes its triangles along: one NaN corner leaves nothing to rasterise.
vec4 clip_position(mat4 clip_from_world, vec4 position) {
    return position.w > 0.0 ? clip_from_world * vec4(position.xyz, 1.0) : vec4(uintBitsToFloat(0x7fc00000u));
}

#endif
