// The scene in GPU memory: what every stage of the server reads. Rust sees these structs through reflection.
#ifndef SCENE_GLSL
#define SCENE_GLSL

// A vertex in mesh space. Joints are four 16-bit indices into the model's palette.
struct VertexGpu {
    vec4 position_u; // xyz metres, w texture u
    vec4 normal_v;   // xyz unit, w texture v
    vec4 tangent;    // xyz unit, w sign of the bitangent
    vec4 weights;    // sum 1
    uvec2 joints;
    uvec2 morphs;    // first delta of the vertex, and their number
    vec2 uv1;        // second texture coordinates
    uint color;      // linear RGBA, 8 bits each, red lowest
    uint reserved;
};

// A patch of 1 to 3 triangles; vertices are indices within the model. Unused entries repeat the first.
struct PatchGpu {
    uint vertices[5];
    uint kind;
    uint material; // of its model
    uint reserved;
};

// glTF 2.0 section 3.9; a texture index of -1 means none. alpha_cutoff below 0 means opaque.
struct MaterialGpu {
    vec4 base_color;
    vec4 emissive_metallic; // rgb, metallic
    float roughness;
    float normal_scale;
    float occlusion_strength;
    float alpha_cutoff;
    int base_color_texture;
    int metallic_roughness_texture;
    int normal_texture;
    int occlusion_texture;
    int emissive_texture;
    uint double_sided;
    float texture_extent_texels; // largest side of its textures, 0 where it has none
    uint reserved;
};

// Position and frame of one vertex at shading time.
struct FrameGpu {
    vec4 normal;
    vec4 tangent;
};

// One view: a predicted one, an eye, or a camera of the ground truth.
struct ViewGpu {
    mat4 clip_from_world;
    vec4 world_eye;       // xyz
    vec4 extent_pixels;   // xy
};

// Corners of a patch's triangles, three per triangle: as shadecast_protocol::atlas::PatchKind has them.
const uint PATCH_TRIANGLES[3][9] = uint[3][9](
    uint[9](0, 1, 2, 0, 0, 0, 0, 0, 0),
    uint[9](0, 1, 2, 0, 2, 3, 0, 0, 0),
    uint[9](0, 4, 3, 4, 2, 3, 4, 1, 2));

vec2 patch_corner_uv(uint kind, uint corner) {
    if (kind == 1) return vec2[3](vec2(0, 0), vec2(1, 0), vec2(0, 1))[min(corner, 2)];
    return vec2[5](vec2(0, 0), vec2(1, 0), vec2(1, 1), vec2(0, 1), vec2(0.5, 0))[corner];
}

#endif
