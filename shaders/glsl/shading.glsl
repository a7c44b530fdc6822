// What the fragment shaders that shade blocks share: finds the triangle from the position inside the block, extrapolates into
// the gutter, and gives the tone-mapped colour sRGB-coded.
#include "scene.glsl"
#define SAVED_VERTICES_BINDING 3
#define TANGENTS_BINDING 4
#define BOXES_BINDING 9
#include "saved.glsl"
#include "environment.glsl"
#include "light.glsl"
#include "footprint.glsl"

struct BlockGpu {
    uint patch_index;
    uint address_texels;
    uint extent_texels;
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material_base;
    uint instance;
};
layout(std430, binding = 0) readonly buffer Blocks { BlockGpu blocks[]; };
layout(std430, binding = 1) readonly buffer Patches { PatchGpu patches[]; };
layout(std430, binding = 2) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std430, binding = 5) readonly buffer Materials { MaterialGpu materials[]; };
layout(std140, binding = 6) uniform Light { LightGpu light; };
layout(binding = 7) uniform sampler2D textures[];
layout(binding = 8) uniform sampler2D shadow_map;
#include "pbr.glsl"
layout(push_constant) uniform ShadingPush {
    vec4 head_from_world[AFFINE_ROWS]; // of the head that is expected in the middle of the update's time on display
    vec4 world_eye;                    // where it is
    vec2 atlas_extent_texels;
    vec2 pixels_per_tangent;           // of the display, in the middle of an eye's picture
    uint samples_a_side;               // of a texel whose textures are finer than a pixel
};
layout(location = 0) flat in uint block_index;
layout(location = 1) in vec2 middle_texel; // of the block
layout(location = 0) out vec4 color;

// By kind less one: the corners of its triangles, three each.
const uint TRIANGLE_CORNERS[PATCH_KINDS][3 * PATCH_KINDS] = PATCH_TRIANGLES;

// Place of a vertex in the unit square.
vec2 patch_corner_uv(uint kind, uint corner) {
    if (kind == PATCH_ONE) return PATCH_ONE_CORNERS[min(corner, 2)];
    return PATCH_CORNERS[corner];
}

uint triangle_at(uint kind, vec2 uv) {
    if (kind == PATCH_ONE) return 0;
    if (kind == PATCH_TWO) return uv.y <= uv.x ? 0 : 1;
    // Edges from (0.5, 0) to (0, 1) and to (1, 1).
    if (2.0 * uv.x + uv.y <= 1.0) return 0;
    return 2.0 * uv.x - uv.y >= 1.0 ? 2 : 1;
}

// Barycentric coordinates of uv, and their constant change with uv, as columns of 1, d/du, d/dv.
mat3 barycentric(vec2 a, vec2 b, vec2 c, vec2 uv) {
    vec2 ab = b - a, ac = c - a, ap = uv - a;
    float area = ab.x * ac.y - ab.y * ac.x;
    vec2 beta = vec2(ac.y, -ac.x) / area, gamma = vec2(-ab.y, ab.x) / area;
    vec2 w = vec2(dot(beta, ap), dot(gamma, ap));
    return mat3(vec3(1.0 - w.x - w.y, w), vec3(-beta.x - gamma.x, beta.x, gamma.x),
        vec3(-beta.y - gamma.y, beta.y, gamma.y));
}

// Of a point with w 1, of a direction with w 0.
vec3 in_head(vec4 world) {
    return vec3(dot(head_from_world[0], world), dot(head_from_world[1], world), dot(head_from_world[2], world));
}

// What a pixel of the display covers of the block at a point of the surface, which the columns are the change of with a texel.
mat2 footprint_texels(vec3 world_at, mat2x3 world_by_texel) {
    vec3 at = in_head(vec4(world_at, 1.0));
    vec3 x = in_head(vec4(world_by_texel[0], 0.0)), y = in_head(vec4(world_by_texel[1], 0.0));
    return texels_per_pixel(mat2(pixels_of(at, x, pixels_per_tangent), pixels_of(at, y, pixels_per_tangent)));
}

// Texels of a material's textures along the longest side of what is filtered.
float longest_texels(MaterialGpu m, Surface s) {
    vec2 uv = vec2(length(s.uv_dx), length(s.uv_dy)) * m.texture_extent_texels;
    vec2 uv1 = vec2(length(s.uv1_dx), length(s.uv1_dy)) * m.texture_extent1_texels;
    return max(max(uv.x, uv.y), max(uv1.x, uv1.y));
}

// Mean light of `side` by `side` samples of a pixel, with textures filtered for a part of it each. One sample of a filtered texture
// is too bright: tone mapping is concave. Position and normal are those of the pixel's middle.
vec4 mean_display_color(MaterialGpu m, Surface s, uint side) {
    vec2 dx = s.uv_dx / float(side), dy = s.uv_dy / float(side);
    vec2 dx1 = s.uv1_dx / float(side), dy1 = s.uv1_dy / float(side);
    Surface part = s;
    part.uv_dx = dx;
    part.uv_dy = dy;
    part.uv1_dx = dx1;
    part.uv1_dy = dy1;
    vec4 sum = vec4(0.0);
    float sun_reaches = -1.0;
    for (uint at = 0; at < side * side; at++) {
        vec2 place = vec2(at % side, at / side) + 0.5 * (1.0 - float(side));
        part.uv = s.uv + dx * place.x + dy * place.y;
        part.uv1 = s.uv1 + dx1 * place.x + dy1 * place.y;
        sum += display_color(m, part, world_eye.xyz, sun_reaches);
    }
    return sum / float(side * side);
}

// The colour at a place of the block, in texels from its corner; alpha is 0 where the material cuts it out, else 1.
vec4 shaded(vec2 texel) {
    BlockGpu b = blocks[block_index];
    PatchGpu p = patches[b.patch_index];
    vec2 inner = vec2(b.extent_texels & 0xffff, b.extent_texels >> 16) - 2.0 * BLOCK_INSET_TEXELS;
    vec2 uv = (texel - BLOCK_INSET_TEXELS) / inner;
    uint t = triangle_at(p.kind, uv) * 3;
    uint corners[3] = uint[3](
        TRIANGLE_CORNERS[p.kind - 1][t], TRIANGLE_CORNERS[p.kind - 1][t + 1], TRIANGLE_CORNERS[p.kind - 1][t + 2]);
    mat3 weights = barycentric(patch_corner_uv(p.kind, corners[0]), patch_corner_uv(p.kind, corners[1]),
        patch_corner_uv(p.kind, corners[2]), uv);
    Surface s;
    s.world_position = s.world_normal = s.world_tangent = vec3(0.0);
    s.uv = s.uv_dx = s.uv_dy = s.uv1 = s.uv1_dx = s.uv1_dy = vec2(0.0);
    s.color = vec4(0.0);
    vec3 at[3];
    mat2 uv_by_texel = mat2(0.0), uv1_by_texel = mat2(0.0);
    mat2x3 world_by_texel = mat2x3(0.0);
    for (int i = 0; i < 3; i++) {
        uint index = p.vertices[corners[i]];
        VertexGpu v = vertices[b.vertex_base + index];
        uvec2 frame = saved_frame(b.tangent_base + index);
        vec4 tangent = unpack_tangent(frame);
        vec2 vertex_uv = vec2(v.position_u.w, v.normal_v.w);
        at[i] = saved_position(b.instance, b.position_base + index);
        s.world_position += weights[0][i] * at[i];
        s.world_normal += weights[0][i] * unpack_normal(frame);
        s.world_tangent += weights[0][i] * tangent.xyz;
        s.tangent_sign = tangent.w;
        s.uv += weights[0][i] * vertex_uv;
        s.uv1 += weights[0][i] * v.uv1;
        vec2 by_texel = vec2(weights[1][i], weights[2][i]) / inner;
        uv_by_texel += outerProduct(vertex_uv, by_texel);
        uv1_by_texel += outerProduct(v.uv1, by_texel);
        world_by_texel += outerProduct(at[i], by_texel);
        s.color += weights[0][i] * unpackUnorm4x8(v.color);
    }
#ifdef FOOTPRINT_IS_TEXEL
    mat2 footprint = mat2(1.0);
#else
    mat2 footprint = footprint_texels(s.world_position, world_by_texel);
#endif
    mat2 uv_by_pixel = uv_by_texel * footprint, uv1_by_pixel = uv1_by_texel * footprint;
    s.uv_dx = uv_by_pixel[0];
    s.uv_dy = uv_by_pixel[1];
    s.uv1_dx = uv1_by_pixel[0];
    s.uv1_dy = uv1_by_pixel[1];
    MaterialGpu m = materials[b.material_base + p.material];
    vec3 facing = cross(at[1] - at[0], at[2] - at[0]);
    if (m.double_sided != 0 && dot(facing, world_eye.xyz - s.world_position) < 0.0) s.world_normal = -s.world_normal;
    s.color = clamp(s.color, 0.0, 1.0); // the gutter extrapolates
    vec4 shown = mean_display_color(m, s, longest_texels(m, s) > 1.0 ? samples_a_side : 1);
    float is_there = m.alpha_cutoff != NO_ALPHA_CUTOFF && shown.a < m.alpha_cutoff ? 0.0 : 1.0;
    return vec4(srgb_from_linear(shown.rgb), is_there);
}
