#version 460
#extension GL_GOOGLE_include_directive : require
// Bone palette per skeleton instance at one sample time: every bone once, parents first, level by level; one
// workgroup per instance. Twin: server/src/animation/pose.rs.
layout(local_size_x = 64) in;

struct KeyGpu {
    vec4 translation;
    vec4 rotation; // quaternion xyzw, unit, neighbours in the same hemisphere
    vec4 scale;
};

// world_from_model as rows; two keyframes per bone and the fraction between them.
struct PoseGpu {
    vec4 world_from_model[3];
    uint bone_base;
    uint level_base;
    uint level_count;
    uint key0_base;
    uint key1_base;
    float fraction;
    uint entry_base;
    uint entry_count;
    uint global_base;
    uint palette_base;
    uint reserved0;
    uint reserved1;
};

// bone_from_mesh as rows.
struct EntryGpu {
    vec4 bone_from_mesh[3];
    uvec4 bone;
};

layout(std430, binding = 0) readonly buffer Poses { PoseGpu poses[]; };
layout(std430, binding = 1) readonly buffer Parents { int parents[]; };
layout(std430, binding = 2) readonly buffer Levels { uint level_starts[]; };
layout(std430, binding = 3) readonly buffer Keys { KeyGpu keys[]; };
layout(std430, binding = 4) readonly buffer Entries { EntryGpu entries[]; };
layout(std430, binding = 5) coherent buffer Globals { vec4 globals[]; };
layout(std430, binding = 6) writeonly buffer Palettes { vec4 palettes[]; };

layout(push_constant) uniform PalettePush {
    uint pose_base;
    uint palette_slot_base;
};

struct Rows { vec4 r[3]; };

Rows multiply(Rows a, Rows b) {
    Rows c;
    for (int i = 0; i < 3; i++) {
        c.r[i] = a.r[i].x * b.r[0] + a.r[i].y * b.r[1] + a.r[i].z * b.r[2] + vec4(0, 0, 0, a.r[i].w);
    }
    return c;
}

// translate * rotate * scale.
Rows local_transform(KeyGpu a, KeyGpu b, float f) {
    vec3 t = mix(a.translation.xyz, b.translation.xyz, f), s = mix(a.scale.xyz, b.scale.xyz, f);
    vec4 qb = dot(a.rotation, b.rotation) < 0.0 ? -b.rotation : b.rotation;
    vec4 q = normalize(mix(a.rotation, qb, f));
    vec3 x = vec3(1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)) * s.x;
    vec3 y = vec3(2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.w * q.x)) * s.y;
    vec3 z = vec3(2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)) * s.z;
    return Rows(vec4[3](vec4(x.x, y.x, z.x, t.x), vec4(x.y, y.y, z.y, t.y), vec4(x.z, y.z, z.z, t.z)));
}

Rows load_global(uint index) {
    return Rows(vec4[3](globals[index * 3], globals[index * 3 + 1], globals[index * 3 + 2]));
}

void main() {
    PoseGpu pose = poses[pose_base + gl_WorkGroupID.x];
    for (uint level = 0; level < pose.level_count; level++) {
        uint first = level_starts[pose.level_base + level], end = level_starts[pose.level_base + level + 1];
        for (uint bone = first + gl_LocalInvocationID.x; bone < end; bone += 64) {
            Rows local = local_transform(keys[pose.key0_base + bone], keys[pose.key1_base + bone], pose.fraction);
            int parent = parents[pose.bone_base + bone];
            Rows global = parent < 0 ? local : multiply(load_global(pose.global_base + uint(parent)), local);
            for (int i = 0; i < 3; i++) globals[(pose.global_base + bone) * 3 + i] = global.r[i];
        }
        memoryBarrierBuffer();
        barrier();
    }
    Rows world = Rows(pose.world_from_model);
    for (uint i = gl_LocalInvocationID.x; i < pose.entry_count; i += 64) {
        EntryGpu entry = entries[pose.entry_base + i];
        Rows model = multiply(load_global(pose.global_base + entry.bone.x), Rows(entry.bone_from_mesh));
        Rows result = multiply(world, model);
        for (int r = 0; r < 3; r++) {
            palettes[(palette_slot_base + pose.palette_base + i) * 3 + r] = result.r[r];
        }
    }
}
