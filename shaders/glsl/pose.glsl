// Skeletons, sampled curves and poses: what evaluates a bone. Shared by the palette and by the per-vertex chain; the
// buffers are bound from POSE_BINDING on.
// Twin: scene/src/animation/{sampling,pose}.rs.
#ifndef POSE_GLSL
#define POSE_GLSL
#include "rows.glsl"

// A curve of a bone's translation, rotation or scale. One key: constant. interval_s > 0: keys at equal intervals.
struct TrackGpu {
    uint first_key;  // into keys; for cubic curves value and tangent alternate
    uint first_time; // into key_times
    uint key_count;
    uint kind;       // STEP_TRACK, LINEAR_TRACK or CUBIC_TRACK
    float interval_s;
    uint reserved0;
    uint reserved1;
    uint reserved2;
};

// A skeleton at a phase of a clip, and of another one that is faded out. Instances whose poses are equal share it.
struct PoseGpu {
    uint bone_base;    // of the skeleton, into parents
    uint level_base;   // into level_starts
    uint level_count;
    uint track_base;   // of the clip, three a bone: translation, rotation, scale
    uint entry_base;   // into entries
    uint entry_count;
    uint global_base;  // into globals
    uint palette_base; // into palettes
    float phase_s;     // seconds into the clip, and what single precision cannot hold of it
    float phase_low_s;
    uint fading_track_base; // of the clip that is faded out
    float fading_phase_s;
    float fading_phase_low_s;
    float fading;      // its share; 0: none is
    uint reserved0;
    uint reserved1;
};

// bone_from_mesh as rows.
struct EntryGpu {
    vec4 bone_from_mesh[AFFINE_ROWS];
    uvec4 bone;
};

#ifndef POSE_BINDING
#define POSE_BINDING 0
#endif
layout(std430, binding = POSE_BINDING) readonly buffer Poses { PoseGpu poses[]; };
layout(std430, binding = POSE_BINDING + 1) readonly buffer Parents { int parents[]; };
layout(std430, binding = POSE_BINDING + 2) readonly buffer Tracks { TrackGpu tracks[]; };
layout(std430, binding = POSE_BINDING + 3) readonly buffer Keys { vec4 keys[]; };
layout(std430, binding = POSE_BINDING + 4) readonly buffer KeyTimes { float key_times[]; };
layout(std430, binding = POSE_BINDING + 5) readonly buffer Entries { EntryGpu entries[]; };

// translate * rotate * scale; q need not be of unit length. Divided by its square instead of normalised: a device's
// inverse square root may be good to a few parts in a million only, and errors add up along a chain of bones.
Rows transform_of(vec3 t, vec4 q, vec3 s) {
    float k = 2.0 / dot(q, q);
    vec3 x = vec3(1 - k * (q.y * q.y + q.z * q.z), k * (q.x * q.y + q.w * q.z), k * (q.x * q.z - q.w * q.y)) * s.x;
    vec3 y = vec3(k * (q.x * q.y - q.w * q.z), 1 - k * (q.x * q.x + q.z * q.z), k * (q.y * q.z + q.w * q.x)) * s.y;
    vec3 z = vec3(k * (q.x * q.z + q.w * q.y), k * (q.y * q.z - q.w * q.x), 1 - k * (q.x * q.x + q.y * q.y)) * s.z;
    return Rows(vec4[3](vec4(x.x, y.x, z.x, t.x), vec4(x.y, y.y, z.y, t.y), vec4(x.z, y.z, z.z, t.z)));
}

// The key at or before the phase, never the last one.
uint key_before(TrackGpu track, float phase_s, float phase_low_s) {
    uint last = track.key_count - 2;
    if (track.interval_s > 0.0) return min(uint(phase_s / track.interval_s), last);
    uint low = 0, high = last;
    while (low < high) {
        uint middle = (low + high + 1) / 2;
        // In this order the comparison is exact, and a step falls on the same side as in double precision.
        if (key_times[track.first_time + middle] - phase_s <= phase_low_s) low = middle; else high = middle - 1;
    }
    return low;
}

vec4 sample_track(TrackGpu track, float phase_s, float phase_low_s) {
    if (track.key_count == 1) return keys[track.first_key];
    uint key = key_before(track, phase_s, phase_low_s);
    float from = key_times[track.first_time + key], to = key_times[track.first_time + key + 1], span = to - from;
    if (track.kind == STEP_TRACK) return keys[track.first_key + key + (to - phase_s <= phase_low_s ? 1 : 0)];
    // Subtracted before the low part is added: exact where phase and key are close.
    float f = clamp(((phase_s - from) + phase_low_s) / span, 0.0, 1.0);
    if (track.kind == LINEAR_TRACK) return mix(keys[track.first_key + key], keys[track.first_key + key + 1], f);
    uint at = track.first_key + 2 * key;
    float f2 = f * f, f3 = f2 * f;
    return keys[at] * (2.0 * f3 - 3.0 * f2 + 1.0) + keys[at + 1] * (span * (f3 - 2.0 * f2 + f))
        + keys[at + 2] * (3.0 * f2 - 2.0 * f3) + keys[at + 3] * (span * (f3 - f2));
}

// Translation, rotation (not of unit length) or scale of a bone, by the bone's track.
vec4 sample_pose(PoseGpu pose, uint track) {
    vec4 value = sample_track(tracks[pose.track_base + track], pose.phase_s, pose.phase_low_s);
    if (pose.fading <= 0.0) return value;
    vec4 before = sample_track(tracks[pose.fading_track_base + track], pose.fading_phase_s, pose.fading_phase_low_s);
    if (track % 3 == 1) {
        // Rotations along the shorter arc.
        value /= length(value);
        before /= length(before);
        before = dot(value, before) < 0.0 ? -before : before;
    }
    return mix(value, before, pose.fading);
}

// parent_from_bone of the bone at the pose's phase.
Rows local_transform(PoseGpu pose, uint bone) {
    uint first = 3 * bone;
    vec3 t = sample_pose(pose, first).xyz;
    vec4 q = sample_pose(pose, first + 1);
    vec3 s = sample_pose(pose, first + 2).xyz;
    return transform_of(t, q, s);
}

#endif
