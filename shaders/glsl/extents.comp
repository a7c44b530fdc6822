#version 460
#extension GL_GOOGLE_include_directive : require
// The visible patches, in any order, each with its largest extent on the display over all predicted views, in texels. Twin:
// twin/extents.rs.
layout(local_size_x = 64) in;
#include "scene.glsl"
#define SAVED_VERTICES_BINDING 1
#define BOXES_BINDING 7
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std140, binding = 2) uniform Views { ViewGpu views[ID_BUFFER_VIEWS]; };
layout(std430, binding = 3) readonly buffer Patches { PatchGpu patches[]; };
layout(std430, binding = 4) readonly buffer Materials { MaterialGpu materials[]; };
layout(std430, binding = 5) readonly buffer Visible { uint visible[]; };
// A patch that is visible.
struct SeenGpu {
    uint entry;
    uint extent_texels; // width | height << 16
};
layout(std430, binding = 6) writeonly buffer Seen { SeenGpu seen[]; };
layout(std430, binding = 8) buffer SeenCount { uint seen_count[]; };
layout(push_constant) uniform ExtentsPush {
    uint vertex_base;
    uint patch_base;       // of the model's level of detail, into patches
    uint first_entry;      // of the instance's patches, into visible
    uint patch_count;
    uint view_count;
    uint position_base[MAX_VIEWS / EYES]; // of the instance at the time of views 0-1, 2-3, 4-5
    uint material_base;
    uint instance;
};

// Where a point stands on the display, in pixels from the optical axis. Outside of the display's own field of view, in the part of a
// predicted view that is there in case the head turns otherwise, and behind the eye, an angle has as many pixels as at the border:
// what comes into view from there has no more.
vec2 place_pixels(vec4 c, ViewGpu v) {
    vec2 beside = c.xy * v.tangents_from_clip.xy + c.w * v.tangents_from_clip.zw;
    float distance_beside = length(beside);
    if (distance_beside < 1e-12) return vec2(0.0);
    vec2 way = beside / distance_beside;
    vec2 border = mix(v.shown_tangents.xy, v.shown_tangents.zw, greaterThan(way, vec2(0.0)));
    float edge = 1.0 / max(abs(way.x) / border.x, abs(way.y) / border.y);
    float tangent = distance_beside < c.w * edge ? distance_beside / c.w
        : edge + (1.0 + edge * edge) * (atan(distance_beside, c.w) - atan(edge));
    return way * tangent * v.pixels_per_tangent.xy;
}

bool outside_one_side(vec4 c[PATCH_MAX_VERTICES]) {
    bvec4 out_all = bvec4(true);
    for (int i = 0; i < PATCH_MAX_VERTICES; i++) {
        out_all.x = out_all.x && c[i].x < -c[i].w;
        out_all.y = out_all.y && c[i].x > c[i].w;
        out_all.z = out_all.z && c[i].y < -c[i].w;
        out_all.w = out_all.w && c[i].y > c[i].w;
    }
    return any(out_all);
}

// Both sets.
vec4 vertex_uvs(uint index) {
    VertexGpu v = vertices[vertex_base + index];
    return vec4(v.position_u.w, v.normal_v.w, v.uv1);
}

// Texels along an edge of the sharper of the two sets.
float texels_along(vec4 from, vec4 to, MaterialGpu m) {
    return max(distance(from.xy, to.xy) * m.texture_extent_texels, distance(from.zw, to.zw) * m.texture_extent1_texels);
}

// What the source textures hold, with half a step to spare; unbounded where there is none.
vec2 texture_cap(PatchGpu p) {
    MaterialGpu m = materials[material_base + p.material];
    if (m.texture_extent_texels <= 0.0 && m.texture_extent1_texels <= 0.0) return vec2(MAX_PATCH_EXTENT_TEXELS);
    uint height_corner = p.kind == PATCH_ONE ? 2 : 3;
    vec4 origin = vertex_uvs(p.vertices[0]);
    vec2 cap = vec2(texels_along(origin, vertex_uvs(p.vertices[1]), m),
        texels_along(origin, vertex_uvs(p.vertices[height_corner]), m));
    return max(cap * 1.5, vec2(8.0));
}

void main() {
    uint index = gl_GlobalInvocationID.x;
    if (index >= patch_count || visible[first_entry + index] == 0) return;
    PatchGpu p = patches[patch_base + index];
    vec2 extent = vec2(1.0);
    bool is_within = visible[first_entry + index] != SPREAD;
    for (uint view = 0; view < view_count; view++) {
        vec4 c[PATCH_MAX_VERTICES];
        for (int i = 0; i < PATCH_MAX_VERTICES; i++) {
            vec3 at = saved_position(instance, position_base[view / EYES] + p.vertices[i]);
            c[i] = views[view].clip_from_world * vec4(at, 1.0);
        }
        if (outside_one_side(c)) continue;
        is_within = true;
        vec2 at[PATCH_MAX_VERTICES];
        for (int i = 0; i < PATCH_MAX_VERTICES; i++) at[i] = place_pixels(c[i], views[view]);
        float width = distance(at[0], at[1]), height = distance(at[0], at[p.kind == PATCH_ONE ? 2 : 3]);
        if (p.kind != PATCH_ONE) {
            width = max(width, distance(at[3], at[2]));
            height = max(height, distance(at[1], at[2]));
        }
        extent = max(extent, vec2(width, height));
    }
    if (!is_within) return;
    uvec2 texels = uvec2(clamp(ceil(min(extent, texture_cap(p))), 1.0, MAX_PATCH_EXTENT_TEXELS));
    seen[atomicAdd(seen_count[0], 1)] = SeenGpu(first_entry + index, texels.x | texels.y << 16);
}
