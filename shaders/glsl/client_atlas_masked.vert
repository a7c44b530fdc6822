#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// As client_atlas.vert, of patches that may not cover all of their block.
#include "client_geometry.glsl"

layout(std430, binding = 0) readonly buffer Corners { CornerGpu corners[]; };
layout(std430, binding = 1) readonly buffer Positions { vec4 positions[]; };
layout(std140, binding = 2) uniform Eyes { EyesGpu eyes; };
layout(location = 0) out vec2 atlas_texel;
layout(location = 1) flat out vec4 block; // left, top, right, bottom in texels
layout(location = 2) flat out vec4 stored; // as colour_place says
layout(location = 3) flat out uint is_masked;

void main() {
    CornerGpu corner = corners[gl_VertexIndex];
    atlas_texel = corner.atlas_texel;
    block = block_texels(corner.block);
    stored = colour_place(corner.block, eyes.blend.x);
    is_masked = corner.block.x & IS_MASKED;
    gl_Position = clip_position(eyes.clip_from_world[gl_ViewIndex], positions[corner.vertex_slot]);
}
