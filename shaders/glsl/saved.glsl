// Positions and frames that skinning saved, 8 bytes each, in several buffers of which every device can bind one; an instance lies
// in one of them. The includer says where they are bound: BOXES_BINDING with SAVED_VERTICES_BINDING, or TANGENTS_BINDING, or
// all. Twin: server/src/animation/packing.rs.
#ifndef SAVED_GLSL
#define SAVED_GLSL
#extension GL_EXT_nonuniform_qualifier : require

#ifndef SAVED_ACCESS
#define SAVED_ACCESS readonly
#endif

#ifdef SAVED_VERTICES_BINDING
// What positions of an instance are packed in.
struct BoxGpu {
    vec4 origin_m; // xyz
    vec4 step_m;   // xyz
};
layout(std430, binding = BOXES_BINDING) readonly buffer Boxes { BoxGpu boxes[]; };
layout(std430, binding = SAVED_VERTICES_BINDING) SAVED_ACCESS buffer SavedVertices { uvec2 at[]; } saved_vertices[SAVED_CHUNKS];

const uint POSITION_MOST = (1 << POSITION_BITS) - 1;

uvec2 pack_position(uint instance, vec3 position) {
    vec3 place = round((position - boxes[instance].origin_m.xyz) / boxes[instance].step_m.xyz);
    uvec3 at = uvec3(clamp(place, vec3(0.0), vec3(POSITION_MOST)));
    return uvec2(at.x | at.y << POSITION_BITS, at.y >> (32 - POSITION_BITS) | at.z << (2 * POSITION_BITS - 32));
}

vec3 unpack_position(uint instance, uvec2 bits) {
    uvec3 at = uvec3(bits.x, bits.x >> POSITION_BITS | bits.y << (32 - POSITION_BITS), bits.y >> (2 * POSITION_BITS - 32));
    return boxes[instance].origin_m.xyz + vec3(at & POSITION_MOST) * boxes[instance].step_m.xyz;
}
#endif

#ifdef TANGENTS_BINDING
layout(std430, binding = TANGENTS_BINDING) SAVED_ACCESS buffer Tangents { uvec2 at[]; } tangents[SAVED_CHUNKS];

// What lies on the lower half of an octahedron that is unfolded, outside of the upper half's edges.
vec2 folded(vec2 at) {
    return (1.0 - abs(at.yx)) * mix(vec2(-1.0), vec2(1.0), greaterThanEqual(at, vec2(0.0)));
}

vec2 octahedral(vec3 direction) {
    vec3 at = direction / max(abs(direction.x) + abs(direction.y) + abs(direction.z), 1e-20);
    return at.z >= 0.0 ? at.xy : folded(at.xy);
}

vec3 octahedral_direction(vec2 at) {
    float z = 1.0 - abs(at.x) - abs(at.y);
    return normalize(vec3(z >= 0.0 ? at : folded(at), z));
}

// The tangent's w is the bitangent's side.
uvec2 pack_frame(vec3 normal, vec4 tangent) {
    uvec2 at = uvec2(ivec2(round(octahedral(tangent.xyz) * 16383.0)) + 16383);
    return uvec2(packSnorm2x16(octahedral(normal)), at.x | at.y << 15 | (tangent.w < 0.0 ? 1u << 30 : 0u));
}

vec3 unpack_normal(uvec2 bits) { return octahedral_direction(unpackSnorm2x16(bits.x)); }

vec4 unpack_tangent(uvec2 bits) {
    vec2 at = (vec2(bits.y & 0x7fff, bits.y >> 15 & 0x7fff) - 16383.0) / 16383.0;
    return vec4(octahedral_direction(at), (bits.y >> 30 & 1) == 1 ? -1.0 : 1.0);
}
#endif

#ifndef SAVED_IS_WRITTEN
#ifdef SAVED_VERTICES_BINDING
// Most scenes have one buffer, whose lookup has no other way to go.
vec3 saved_position(uint instance, uint index) {
    uvec2 bits = index < CHUNK_VERTICES ? saved_vertices[0].at[index]
        : saved_vertices[nonuniformEXT(index / CHUNK_VERTICES)].at[index % CHUNK_VERTICES];
    return unpack_position(instance, bits);
}
#endif

#ifdef TANGENTS_BINDING
uvec2 saved_frame(uint index) {
    return index < CHUNK_VERTICES ? tangents[0].at[index]
        : tangents[nonuniformEXT(index / CHUNK_VERTICES)].at[index % CHUNK_VERTICES];
}
#endif
#endif

#endif
