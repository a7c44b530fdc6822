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
    uint vertices[PATCH_MAX_VERTICES];
    uint kind;
    uint material; // of its model
    uint reserved;
};

// glTF 2.0 section 3.9; a texture index may be NO_TEXTURE, alpha_cutoff NO_ALPHA_CUTOFF. Slots are numbered as the
// texture indices stand.
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
    // By set of texture coordinates: largest side of its textures in texels per unit of the vertices' coordinates, 0
    // where it has none.
    float texture_extent_texels;
    float texture_extent1_texels;
    // By slot two rows of a 2x3 matrix for the texture coordinates; the first row's w is the set, 0 or 1.
    vec4 uv_rows[2 * TEXTURE_SLOTS];
    uint unlit;
    uint reserved[3];
};

// What a slot looks up, from a vertex's or a pixel's coordinates; with `one` 0, changes of them are turned alike.
vec2 slot_uv(MaterialGpu m, uint slot, vec2 uv, vec2 uv1, float one) {
    vec4 u = m.uv_rows[2 * slot], v = m.uv_rows[2 * slot + 1];
    vec3 place = vec3(u.w == 0.0 ? uv : uv1, one);
    return vec2(dot(u.xyz, place), dot(v.xyz, place));
}

// One view: a predicted one, an eye, or a camera of the ground truth.
struct ViewGpu {
    mat4 clip_from_world;
    vec4 world_eye;       // xyz
    // For extents; 0 for an eye and a camera.
    vec4 tangents_from_clip; // of x and y over w: factors, and what is added; tangents of the view angle grow rightwards and upwards
    vec4 shown_tangents;     // the display's own field of view: left, down, right, up; positive
    vec4 pixels_per_tangent; // xy
};

#endif
