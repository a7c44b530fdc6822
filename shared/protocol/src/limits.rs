//! Every capacity of the system as a named constant, so each overflow is defined in one place.
//!
//! Decoders check counts against these before they allocate. Shaders read some of them. The asserts at the end hold the
//! relations between them. The capacities of a scene come from `shadecast_model`.

pub use shadecast_model::limits::{MAX_COORDINATE_M, MAX_INSTANCES, MAX_LIGHTS, MAX_PRINTED_CHARS};

/// Static vertices lie on a grid of so many steps in a metre, wherever 32 bits are as fine: of 61 um.
pub const STATIC_STEPS_PER_M: f32 = 16_384.0;
/// Vertices that a client keeps at most. Slots are numbered from 0.
pub const MAX_VERTEX_SLOTS: u32 = 524_288;
/// Vertices that a client keeps at most where samples are sent for any.
pub const MAX_SAMPLED_SLOTS: u32 = 262_144;
/// Vertices that a client keeps unless it says otherwise.
pub const DEFAULT_VERTEX_SLOTS: u32 = 131_072;
/// Patches that a client keeps at most. Slots are numbered from 0.
pub const MAX_PATCH_SLOTS: u32 = 262_144;
/// Patches that a client keeps unless it says otherwise.
pub const DEFAULT_PATCH_SLOTS: u32 = 131_072;
/// Triangles that a client draws for an eye at most: three of each patch, both sides.
pub const MAX_TRIANGLES: u32 = 6 * MAX_PATCH_SLOTS;
/// Triangles that a client draws for an eye unless it says otherwise.
pub const DEFAULT_TRIANGLES: u32 = 6 * DEFAULT_PATCH_SLOTS;
/// Grid steps that a client keeps at least of what is sent step by step: step `g` lies at `g` modulo their number, which is a
/// power of two and a term of the session.
pub const MIN_SAMPLE_RING: u32 = 8;
/// Grid steps that a client keeps unless it says otherwise: on the longest way 0.87 s ahead, and some that are late.
pub const DEFAULT_SAMPLE_RING: u32 = 32;
/// Grid steps that a client keeps at most.
pub const MAX_SAMPLE_RING: u32 = 64;
/// Samples that a client keeps at most, over all vertices: of 16 bytes each what every Vulkan device can bind.
pub const MAX_KEPT_SAMPLES: u32 = 1 << 23;
/// Positions that an update predicts for a vertex without samples: the paper's.
pub const PREDICTIONS: u32 = 3;
/// Predicted views per update.
pub const MAX_VIEWS: u32 = 6;
/// Vertices of a patch of three triangles.
pub const PATCH_MAX_VERTICES: u32 = 5;

/// Seconds of a clip that travel together.
pub const CHUNK_S: f64 = 0.5;
/// Words of 16 bytes that a client's arena has at most: skeletons, clips, morph targets.
pub const MAX_ARENA_WORDS: u32 = 1 << 22;
/// Words of a client's arena unless it says otherwise: 8 MiB.
pub const DEFAULT_ARENA_WORDS: u32 = 1 << 19;
/// Vertices before skinning that a client keeps unless it says otherwise: 8 MiB.
pub const DEFAULT_REST_VERTICES: u32 = 1 << 18;
/// What lies in the arena starts at a multiple of this: every view of it is aligned there.
pub const ARENA_ALIGNMENT_WORDS: u32 = 4;
/// Vertices before skinning that a client keeps at most, 32 bytes each.
pub const MAX_REST_VERTICES: u32 = 1 << 19;
/// Bones of a skeleton.
pub const MAX_SKELETON_BONES: u32 = 4096;
/// Palette entries of a skeleton: what a vertex refers to.
pub const MAX_SKELETON_ENTRIES: u32 = 4096;
/// Morph targets of a mesh that a client adds by itself.
pub const MAX_MORPHS: u32 = 1024;
/// Morph targets that move one vertex, where a client adds them.
pub const MAX_VERTEX_MORPHS: u32 = 255;
/// Bones, and palette entries, of all instances together that a client skins.
pub const MAX_POSE_PLACES: u32 = 1 << 16;
/// Playbacks of one instance that a client is told in advance.
pub const MAX_SCHEDULE: usize = 64;
/// Curves of a chunk of a clip: translation, rotation and scale of each bone, and morph weights.
pub const MAX_CHUNK_TRACKS: u32 = 3 * MAX_SKELETON_BONES + MAX_MORPHS;
/// Keys of a chunk of a clip, over all its curves.
pub const MAX_CHUNK_KEYS: u32 = 1 << 18;
/// Frames per second by whose number a clip can say its key times.
pub const MAX_FRAME_RATE: u32 = 1024;
/// Bytes of one message about motion.
pub const MAX_MOTION_BYTES: usize = 16 << 20;

/// Atlas width and height in texels unless asked otherwise; see [`crate::atlas::AtlasExtent`].
pub const ATLAS_DEFAULT_EXTENT: [u32; 2] = [2048, 2048];
/// Largest atlas width and height in texels.
pub const ATLAS_MAX_EXTENT: [u32; 2] = [4096, 2048];
/// Smallest atlas side in texels: one of the largest blocks.
pub const ATLAS_MIN_SIDE: u32 = 1 << BLOCK_MAX_LOG2;
/// Smallest side of a block is `1 << BLOCK_MIN_LOG2` texels. Addresses are multiples of it.
pub const BLOCK_MIN_LOG2: u32 = 2;
/// Largest side of a block is `1 << BLOCK_MAX_LOG2` texels.
pub const BLOCK_MAX_LOG2: u32 = 9;
/// Smallest side of a superblock is `1 << SUPERBLOCK_MIN_LOG2` texels.
pub const SUPERBLOCK_MIN_LOG2: u32 = 6;
/// A patch's unit square maps to its block less this many luma texels on each side: from the middle of the first texel to that of
/// the last.
pub const BLOCK_INSET_TEXELS: f32 = 0.5;
/// Chroma is looked up in a block less this many luma texels on each side: from the middle of the first sample to that of the last.
pub const CHROMA_INSET_TEXELS: f32 = 1.0;
/// Sides of a page of the store in texels.
pub const STORE_PAGE_SIDE: u32 = 2048;
/// Pages that a store may have: 500 MB at four bytes a texel.
pub const MAX_STORE_PAGES: u32 = 31;
/// Texels of blocks whose coverage one delta may tell: those of the largest atlas.
pub const MAX_COVERED_TEXELS: u32 = ATLAS_MAX_EXTENT[0] * ATLAS_MAX_EXTENT[1];
/// 16x16 macroblocks in one coded picture: H.264 level 5.2.
pub const MAX_MACROBLOCKS: u32 = 36_864;
/// Bytes of one coded macroblock: 3200 bits. Source: ITU-T H.264, A.3.1.
pub const MAX_MACROBLOCK_BYTES: usize = 400;
/// Smallest width and height of a coded picture in texels: one macroblock.
pub const MIN_PICTURE_SIDE_TEXELS: u32 = 16;
/// Largest width and height of a coded picture in texels.
pub const MAX_PICTURE_EXTENT_TEXELS: [u32; 2] = [4096, 2304];

/// Grid steps for which one delta may carry samples of as many vertices as there may be.
pub const MAX_NEW_SAMPLE_GRIDS: u32 = 8;
/// Batches of samples in one delta: first samples, regular ones, and those sent again after the future changed.
pub const MAX_SAMPLE_BATCHES: u32 = 2 * MAX_SAMPLE_RING;
/// Vertex samples in one delta, over all its batches.
pub const MAX_SAMPLES_PER_DELTA: u32 = MAX_SAMPLED_SLOTS * MAX_NEW_SAMPLE_GRIDS;
/// Smallest quantisation step of vertex samples in metres.
pub const MIN_STEP_M: f32 = 1e-6;
/// Largest quantisation step of vertex samples in metres.
pub const MAX_STEP_M: f32 = 1.0;
/// Largest speed in metres or radians per second that a head state may claim.
pub const MAX_SPEED: f32 = 1e4;

/// Bytes of one message on the control stream.
pub const MAX_CONTROL_BYTES: usize = 1 << 20;
/// Bytes of padding that follow a welcome: a train of 16 packets, from which the server learns what the path carries. At 1 Mbit/s they take
/// 0.15 s.
pub const PADDING_BYTES: usize = 18_000;
/// Empty messages on a control stream: the one that makes the stream known to the server.
pub const MAX_EMPTY_CONTROL_MESSAGES: usize = 1;
/// Control messages a second, and at once after a pause: a client reports each update that it shows, and asks for little
/// else.
pub const MAX_CONTROL_PER_SECOND: u32 = 1000;
/// Datagrams a second, and at once after a pause, that are taken from a peer: a head state each display frame, and pings.
pub const MAX_DATAGRAMS_PER_SECOND: u32 = 500;
/// Bytes of one geometry delta.
pub const MAX_DELTA_BYTES: usize = 62 << 20;
/// Bytes of one coded picture: whatever an encoder can make of the largest, or leaves as it is.
pub const MAX_ACCESS_UNIT_BYTES: usize = 16 << 20;
/// Bytes of one unidirectional stream: a delta or a picture with its framing.
pub const MAX_STREAM_BYTES: usize = MAX_DELTA_BYTES + 64;
/// Bytes of one datagram; what every path carries unfragmented inside QUIC.
pub const MAX_DATAGRAM_BYTES: usize = 1100;
/// Bytes of a text that a peer sends to be shown or logged.
pub const MAX_TEXT_BYTES: usize = 1024;
/// Codecs that a client may list.
pub const MAX_CODECS: usize = 8;
/// Deltas and early pictures that a client holds while one before them is still on its way.
pub const MAX_QUEUED_STREAMS: usize = 128;
/// Bytes that a client holds while an earlier delta is still on its way.
pub const MAX_QUEUED_STREAM_BYTES: usize = 2 * MAX_DELTA_BYTES;
/// Frames by which a delta or a picture may be ahead of the next delta due. What is further ahead is nonsense.
pub const MAX_FRAMES_AHEAD: u32 = 256;
/// Samples, vertices, patches and placements per agreed vertex slot that a client takes in between two display frames; deltas
/// beyond it wait. A delta is taken in whole. No update but the first brings as many.
pub const RECORDS_PER_SLOT_AND_TURN: u32 = 4;
/// Pixels per eye and side that a client may ask for.
pub const MAX_EYE_EXTENT_PIXELS: u32 = 8192;
/// Pixels per eye that a client may ask for: twice the texels of the largest atlas, since an atlas that shows much less than
/// the eye resolves is no picture for it.
pub const MAX_EYE_PIXELS: u32 = 2 * ATLAS_MAX_EXTENT[0] * ATLAS_MAX_EXTENT[1];

/// The word of a placement that takes a patch's block away.
pub const NO_BLOCK: u32 = u32::MAX;

/// Bytes that a sample can cost at worst: three raw words, and its share of a group's header.
const WORST_SAMPLE_BYTES: usize = 13;
/// Bytes that a vertex can cost at worst beside its samples: slot, instance, number, position or rest number, eviction.
/// A number has twice its bits; learning keeps the mean of a bit below one.
const WORST_VERTEX_BYTES: usize = 5 + 3 + 5 + 12 + 5;
/// Bytes that the predictions of a vertex can cost at worst: a run of its own, positions and times.
const WORST_PREDICTED_BYTES: usize = 10 + 16 * PREDICTIONS as usize;
/// Bytes that samples or predictions can cost at worst: a vertex with predictions has no samples.
const WORST_MOTION_BYTES: usize = {
    let samples = MAX_SAMPLES_PER_DELTA as usize * WORST_SAMPLE_BYTES;
    let predictions = MAX_VERTEX_SLOTS as usize * WORST_PREDICTED_BYTES;
    if samples > predictions { samples } else { predictions }
};
/// Bytes that a key of a clip can cost at worst: value, tangent, time, and its place among the times.
const WORST_KEY_BYTES: usize = 16 + 16 + 4 + 4;
/// Bytes that a curve of a clip can cost at worst beside its keys: what it is, steps, and thirteen widths.
const WORST_CURVE_BYTES: usize = 24;
/// Bytes that a patch can cost at worst: slot, instance, number, kind, five vertices, placement, eviction, slot and form of coverage.
const WORST_PATCH_BYTES: usize = 5 + 3 + 5 + 1 + 6 * PATCH_MAX_VERTICES as usize + 5 + 5 + 5 + 6;

const _: () = {
    assert!(MAX_VERTEX_SLOTS.is_power_of_two() && MAX_PATCH_SLOTS.is_power_of_two());
    assert!(MAX_INSTANCES <= 1 << 16, "an instance is 16 bits");
    assert!(MAX_SKELETON_BONES <= u16::MAX as u32 && MAX_SKELETON_ENTRIES <= MAX_POSE_PLACES);
    assert!(MAX_ARENA_WORDS <= 1 << 24, "a rest vertex names the word of its morphs in 24 bits");
    assert!(DEFAULT_ARENA_WORDS <= MAX_ARENA_WORDS);
    assert!(
        MAX_CHUNK_KEYS as usize * WORST_KEY_BYTES + MAX_CHUNK_TRACKS as usize * WORST_CURVE_BYTES + 64
            <= MAX_MOTION_BYTES
    );
    assert!(MAX_MOTION_BYTES + 64 <= MAX_STREAM_BYTES);
    assert!(MIN_SAMPLE_RING.is_power_of_two() && MAX_SAMPLE_RING.is_power_of_two());
    assert!(DEFAULT_SAMPLE_RING.is_power_of_two());
    assert!(DEFAULT_VERTEX_SLOTS <= MAX_VERTEX_SLOTS && DEFAULT_PATCH_SLOTS <= MAX_PATCH_SLOTS);
    assert!(DEFAULT_VERTEX_SLOTS * MAX_SAMPLE_RING <= MAX_KEPT_SAMPLES, "usual clients have every ring");
    assert!(MAX_SAMPLED_SLOTS * DEFAULT_SAMPLE_RING <= MAX_KEPT_SAMPLES, "the usual ring has every slot");
    assert!(MAX_VERTEX_SLOTS * MIN_SAMPLE_RING <= MAX_KEPT_SAMPLES, "the smallest ring has every slot");
    assert!(DEFAULT_VERTEX_SLOTS <= MAX_SAMPLED_SLOTS && MAX_SAMPLED_SLOTS <= MAX_VERTEX_SLOTS);
    assert!(MIN_SAMPLE_RING >= 8, "two ahead, four to interpolate, and some late");
    assert!(MIN_SAMPLE_RING <= DEFAULT_SAMPLE_RING && DEFAULT_SAMPLE_RING <= MAX_SAMPLE_RING);
    assert!(PREDICTIONS < MIN_SAMPLE_RING, "a client keeps them in place of samples");
    assert!(ATLAS_MAX_EXTENT[0] <= 1 << (10 + BLOCK_MIN_LOG2), "10 bits of address");
    assert!(ATLAS_MAX_EXTENT[1] <= 1 << (10 + BLOCK_MIN_LOG2), "10 bits of address");
    assert!(STORE_PAGE_SIDE <= 1 << (10 + BLOCK_MIN_LOG2), "10 bits of address");
    assert!(BLOCK_MAX_LOG2 - BLOCK_MIN_LOG2 < 8, "3 bits of size");
    assert!(SUPERBLOCK_MIN_LOG2 >= BLOCK_MIN_LOG2 && SUPERBLOCK_MIN_LOG2 <= BLOCK_MAX_LOG2);
    assert!(2.0 * CHROMA_INSET_TEXELS < (1 << BLOCK_MIN_LOG2) as f32, "the smallest block keeps an inside");
    assert!(ATLAS_MAX_EXTENT[0].is_power_of_two() && ATLAS_MAX_EXTENT[1].is_power_of_two());
    assert!(ATLAS_MIN_SIDE <= ATLAS_MAX_EXTENT[0] && ATLAS_MIN_SIDE <= ATLAS_MAX_EXTENT[1]);
    assert!(
        ATLAS_MIN_SIDE.is_multiple_of(1 << BLOCK_MAX_LOG2),
        "every atlas is whole blocks of the largest size"
    );
    assert!(ATLAS_MIN_SIDE >= MIN_PICTURE_SIDE_TEXELS, "every atlas is a picture that can be coded");
    assert!(ATLAS_MAX_EXTENT[0] <= MAX_PICTURE_EXTENT_TEXELS[0]);
    assert!(ATLAS_MAX_EXTENT[1] <= MAX_PICTURE_EXTENT_TEXELS[1]);
    assert!(MAX_PICTURE_EXTENT_TEXELS[0] / 16 * (MAX_PICTURE_EXTENT_TEXELS[1] / 16) <= MAX_MACROBLOCKS);
    assert!(
        MAX_MACROBLOCKS as usize * MAX_MACROBLOCK_BYTES + (64 << 10) <= MAX_ACCESS_UNIT_BYTES,
        "headers and parameter sets beside the worst picture"
    );
    assert!(
        ATLAS_MAX_EXTENT[0] as usize * ATLAS_MAX_EXTENT[1] as usize * 3 / 2 <= MAX_ACCESS_UNIT_BYTES,
        "every atlas as it is"
    );
    assert!(
        WORST_MOTION_BYTES
            + MAX_VERTEX_SLOTS as usize * WORST_VERTEX_BYTES
            + MAX_PATCH_SLOTS as usize * WORST_PATCH_BYTES
            + MAX_COVERED_TEXELS as usize / 8
            <= MAX_DELTA_BYTES,
        "whatever the server may have to say in one delta fits in one"
    );
    assert!(MAX_FRAMES_AHEAD as usize >= MAX_QUEUED_STREAMS, "what may wait may come");
    assert!(MAX_ACCESS_UNIT_BYTES + 64 <= MAX_STREAM_BYTES && MAX_STREAM_BYTES <= MAX_QUEUED_STREAM_BYTES);
};
