#version 460
#extension GL_GOOGLE_include_directive : require
// One quad per live block.
#include "scene.glsl"

// Where a block is and what it shows; bases are of the patch's instance at shading time.
struct BlockGpu {
    uint patch_index;    // into patches
    uint address_texels; // x | y << 16
    uint extent_texels;  // width | height << 16
    uint vertex_base;
    uint position_base;
    uint tangent_base;
    uint material_base;
    uint instance;
};
layout(std430, binding = 0) readonly buffer Blocks { BlockGpu blocks[]; };
layout(push_constant) uniform ShadingPush {
    vec4 head_from_world[AFFINE_ROWS]; // of the head that is expected in the middle of the update's time on display
    vec4 world_eye;                    // where it is
    vec2 atlas_extent_texels;
    vec2 pixels_per_tangent;           // of the display, in the middle of an eye's picture
    uint samples_a_side;
};
layout(location = 0) flat out uint block_index;
layout(location = 1) out vec2 texel; // inside the block

void main() {
    BlockGpu b = blocks[gl_InstanceIndex];
    vec2 corner = vec2(gl_VertexIndex & 1, gl_VertexIndex >> 1);
    vec2 extent = vec2(b.extent_texels & 0xffff, b.extent_texels >> 16);
    vec2 address = vec2(b.address_texels & 0xffff, b.address_texels >> 16);
    block_index = gl_InstanceIndex;
    texel = corner * extent;
    gl_Position = vec4((address + texel) / atlas_extent_texels * 2.0 - 1.0, 0.0, 1.0);
}
