#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// As client_atlas.vert with the skinning of client_skin.comp in it: what is measured against both, and not chosen.
#include "rows.glsl"
#include "influences.glsl"
#include "client_vertices.glsl"
#include "client_geometry.glsl"

layout(std430, binding = 0) readonly buffer Corners { CornerGpu corners[]; };
layout(std140, binding = 2) uniform Eyes { EyesGpu eyes; };
layout(std430, binding = 7) readonly buffer Skins { uvec2 skins[]; };
layout(std430, binding = 8) readonly buffer Rests { RestGpu rests[]; };
layout(std430, binding = 9) readonly buffer Palettes { vec4 palettes[]; };
layout(std430, binding = 10) readonly buffer MorphWeights { float morph_weights[]; };
layout(std430, binding = 11) readonly buffer Arena { uvec4 arena[]; };
layout(location = 0) out vec2 atlas_texel;
layout(location = 1) flat out vec4 block; // left, top, right, bottom in texels
layout(location = 2) flat out vec4 stored; // as store_place says
#include "client_skin.glsl"

void main() {
    CornerGpu corner = corners[gl_VertexIndex];
    atlas_texel = corner.atlas_texel;
    block = block_texels(corner.block);
    stored = store_place(corner.block);
    uvec2 skin = skins[corner.vertex_slot];
    vec4 position = vec4(skinned(rests[skin.x - 1], skin.y), 1.0);
    gl_Position = clip_position(eyes.clip_from_world[gl_ViewIndex], position);
}
