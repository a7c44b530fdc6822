#version 460
#extension GL_GOOGLE_include_directive : require
// Palettes, world_from_mesh, and morph weights of the instances on the draw list that move by clips or by poses on the
// grid, at the display time; one workgroup an instance. Twin: twin/pose.rs.
const uint GROUP = 32;
const uint VALUES = 3; // of a bone: translation, rotation, scale; as many as its rows
layout(local_size_x = GROUP) in;

#include "skeleton.glsl"

// An instance at a time. Arena words are 16 bytes; the other numbers are in units of the views that they index.
struct PlacedPoseGpu {
    vec4 placement[AFFINE_ROWS]; // rows; world_from_model = path * placement
    PoseGpu pose;                // of a pose on the grid: without tracks and phases
    uint flags;                  // POSE_READY, POSE_HAS_PATH, POSE_FROM_GRID
    uint morph_count;
    uint path_track_base;        // of the path: translation, rotation, scale
    float path_phase_s;
    float path_phase_low_s;
    uint reserved0;
    uint reserved1;
    uint reserved2;
    uvec4 grid_words;            // first arena words of the four grid steps around the time
    vec4 grid_weights;           // of these steps; those that are not there have none, and the place of one that is
};

layout(std430, binding = 9) readonly buffer PlacedPoses { PlacedPoseGpu placed_poses[]; };
layout(std430, binding = 10) writeonly buffer MorphWeights { float morph_weights[]; };

// Of the path: translation, rotation, scale.
shared vec4 path_values[VALUES];

// A word of a step on the grid. A bone has three: translation, rotation, scale; then come the morph weights, four a word.
// Rotations, not of unit length, in the hemisphere of the step before the time, whatever signs they came with.
vec4 on_grid(PlacedPoseGpu placed, uint word, bool is_rotation) {
    vec4 near = keys[placed.grid_words[1] + word], sum = vec4(0.0);
    for (int i = 0; i < GRID_STEPS; i++) {
        vec4 value = keys[placed.grid_words[i] + word];
        sum += placed.grid_weights[i] * (is_rotation && dot(value, near) < 0.0 ? -value : value);
    }
    return sum;
}

// The first tracks of a pose are the bones', three each; then come the morphs', whose weight is in x. Those are no rotations
// wherever they stand, so that the bases move and `sample_pose` is asked for the first track or the second.
vec4 from_tracks(PoseGpu pose, uint track, bool is_rotation) {
    uint member = is_rotation ? 1 : 0;
    pose.track_base += track - member;
    pose.fading_track_base += track - member;
    return sample_pose(pose, member);
}

PoseGpu path_pose(PlacedPoseGpu placed) {
    PoseGpu pose = placed.pose;
    pose.track_base = placed.path_track_base;
    pose.phase_s = placed.path_phase_s;
    pose.phase_low_s = placed.path_phase_low_s;
    pose.fading = 0.0;
    return pose;
}

// Values of the bones, of the morphs, of the path: one place for all, since a compiler puts a copy of a curve's evaluation
// wherever it is called.
vec4 value_of(PlacedPoseGpu placed, uint value, uint bone_values) {
    uint path_first = bone_values + placed.morph_count;
    bool is_path = value >= path_first, is_morph = value >= bone_values && !is_path;
    uint track = is_path ? value - path_first : value;
    bool is_rotation = !is_morph && track % VALUES == 1;
    if (is_path || (placed.flags & POSE_FROM_GRID) == 0) {
        PoseGpu pose = placed.pose;
        if (is_path) pose = path_pose(placed);
        return from_tracks(pose, track, is_rotation);
    }
    uint morph = value - bone_values;
    vec4 word = on_grid(placed, is_morph ? bone_values + morph / 4 : value, is_rotation);
    return is_morph ? vec4(word[morph % 4]) : word;
}

Rows world_from_model(PlacedPoseGpu placed) {
    Rows placement = Rows(placed.placement);
    if ((placed.flags & POSE_HAS_PATH) == 0) return placement;
    return multiply(transform_of(path_values[0].xyz, path_values[1], path_values[2].xyz), placement);
}

// Triangles of an instance whose keys have not arrived have no area, whatever its morph weights were.
void collapse(PoseGpu pose) {
    Rows nothing = Rows(vec4[3](vec4(0), vec4(0), vec4(0)));
    for (uint i = gl_LocalInvocationID.x; i < pose.entry_count; i += GROUP) store_palette(pose, i, nothing);
}

// Values do not depend on parents: all of them first, with every invocation at work. A bone's three go where its rows will.
void evaluate(PlacedPoseGpu placed, uint bone_values) {
    uint path_first = bone_values + placed.morph_count;
    uint end = path_first + ((placed.flags & POSE_HAS_PATH) == 0 ? 0 : VALUES);
    for (uint i = gl_LocalInvocationID.x; i < end; i += GROUP) {
        vec4 value = value_of(placed, i, bone_values);
        if (i < bone_values) globals[placed.pose.global_base * AFFINE_ROWS + i] = value;
        else if (i < path_first) morph_weights[placed.pose.palette_base + i - bone_values] = value.x;
        else path_values[i - path_first] = value;
    }
    memoryBarrierBuffer();
    memoryBarrierShared();
    barrier();
}

void main() {
    PlacedPoseGpu placed = placed_poses[gl_WorkGroupID.x];
    PoseGpu pose = placed.pose;
    if ((placed.flags & POSE_READY) == 0) {
        collapse(pose);
        return;
    }
    uint bones = bone_count(pose), roots = root_count(pose);
    evaluate(placed, VALUES * bones);
    for (uint bone = gl_LocalInvocationID.x; bone < bones; bone += GROUP) {
        Rows values = load_global(pose.global_base + bone);
        Rows local = transform_of(values.r[0].xyz, values.r[1], values.r[2].xyz);
        if (bone < roots) local = multiply(world_from_model(placed), local);
        store_global(pose.global_base + bone, local);
    }
    chain_bones(pose);
    write_palette(pose);
}
