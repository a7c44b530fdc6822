//! Memory traffic of a client's display frame, from the layouts of its compiled shaders times the counts: a floor (each byte
//! once, as with infinite caches) and the requests (as without caches).

use shadecast_client::draw::draw_list::{MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH};
use shadecast_client::draw::stages::atlas_draw::BUNDLES;
use shadecast_client::options::USUAL_STORE_PAGES;
use shadecast_protocol::limits::{DEFAULT_PATCH_SLOTS, STORE_PAGE_SIDE};
use shadecast_shaders::constants::{EYES, STORE_LEVELS};
use shadecast_shaders::generated::{CornerGpu, EntryGpu, PlacedPoseGpu, RestGpu, TrackGpu};

/// A frame that a standalone headset is to hold: everything in it is skinned, by four joints a vertex, and opaque.
const VERTICES: u64 = 100_000;
const PATCHES: u64 = 45_000;
const INSTANCES: u64 = 64;
const BONES: u64 = 136;
const INFLUENCES: u64 = 4;
const EYE_PIXELS: u64 = 1832 * 1920;
const ATLAS_TEXELS: u64 = 4096 * 2048;
const FRAMES_HZ: u64 = 72;
const UPDATES_HZ: u64 = 30;

/// A patch of two triangles.
const CORNERS: u64 = 4;
const INDICES: u64 = 6;
const INDEX_BYTES: u64 = 4;
/// Four numbers of 32 bits: a position with its state, a key, a row of a transform.
const VECTOR_BYTES: u64 = 16;
/// Rows of an affine transform.
const ROWS_BYTES: u64 = 3 * VECTOR_BYTES;
/// `skins`: a vertex's rest and where its palette begins.
const SKIN_BYTES: u64 = 8;
/// Texels that a bilinear lookup asks for, in each of three planes of a byte a texel.
const LOOKUP_BYTES: u64 = 3 * 4;
/// A lookup in the store asks for four texels of two mip levels: more than lookups in two pictures.
const STORE_LOOKUP_BYTES: u64 = 2 * 4 * STORED_TEXEL_BYTES;
const _: () = assert!(STORE_LOOKUP_BYTES > 2 * LOOKUP_BYTES);
/// Light in 32 bits.
const STORED_TEXEL_BYTES: u64 = 4;
/// Of an update the store takes a twentieth of the atlas at most (`server/src/atlas/store.rs`).
const SETTLED_TEXELS: u64 = ATLAS_TEXELS / 20;
/// Colour that leaves the pass; depth and samples stay in it.
const PIXEL_BYTES: u64 = 4;

/// What a stage moves in a frame, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moved {
    /// Its name.
    pub stage: &'static str,
    /// Read, each byte once.
    pub read: u64,
    /// Read, as often as it is asked for.
    pub asked: u64,
    /// Written.
    pub written: u64,
}

/// Bytes of a struct of the shaders.
const fn bytes<T>() -> u64 {
    size_of::<T>() as u64
}

/// The stages of a frame, in their order.
pub fn stages() -> [Moved; 7] {
    let (bones, corners) = (INSTANCES * BONES, PATCHES * CORNERS);
    // Three tracks a bone, two keys each; a bone's rows: as values, as a transform, chained to its parent's, and for its entries.
    let a_bone = 3 * (bytes::<TrackGpu>() + 2 * VECTOR_BYTES) + 4 * ROWS_BYTES + bytes::<EntryGpu>();
    let pose_read = INSTANCES * bytes::<PlacedPoseGpu>() + bones * a_bone;
    let rest = SKIN_BYTES + bytes::<RestGpu>();
    let picture = ATLAS_TEXELS * 3 / 2;
    let draw_read =
        PATCHES * INDICES * INDEX_BYTES + corners * bytes::<CornerGpu>() + VERTICES * VECTOR_BYTES;
    let invocations = PATCHES * INDICES * u64::from(EYES);
    let per_frame = |of_an_update: u64| of_an_update * UPDATES_HZ / FRAMES_HZ;
    [
        // Written by the CPU, read and written by the copy.
        Moved {
            stage: "picture",
            read: per_frame(picture),
            asked: per_frame(picture),
            written: per_frame(2 * picture),
        },
        // The finest level of the picture, each further one of the one before.
        Moved {
            stage: "settled blocks",
            read: per_frame(
                SETTLED_TEXELS * 3 / 2 + with_levels(SETTLED_TEXELS, STORE_LEVELS - 1) * STORED_TEXEL_BYTES,
            ),
            asked: per_frame(
                SETTLED_TEXELS * LOOKUP_BYTES
                    + with_levels(SETTLED_TEXELS, STORE_LEVELS - 1) * STORED_TEXEL_BYTES,
            ),
            written: per_frame(with_levels(SETTLED_TEXELS, STORE_LEVELS) * STORED_TEXEL_BYTES),
        },
        Moved { stage: "pose", read: pose_read, asked: pose_read, written: bones * 4 * ROWS_BYTES },
        // A look at each slot, whether it has samples.
        Moved {
            stage: "interpolation",
            read: VERTICES * VECTOR_BYTES,
            asked: VERTICES * VECTOR_BYTES,
            written: 0,
        },
        Moved {
            stage: "skin",
            read: VERTICES * rest + bones * ROWS_BYTES,
            asked: VERTICES * (rest + INFLUENCES * ROWS_BYTES),
            written: VERTICES * VECTOR_BYTES,
        },
        Moved {
            stage: "vertices",
            read: draw_read,
            asked: PATCHES * INDICES * INDEX_BYTES + invocations * (bytes::<CornerGpu>() + VECTOR_BYTES),
            written: 0,
        },
        Moved {
            // All of the atlas's blocks, of two pictures: what is read of the store instead is less.
            stage: "pixels",
            read: 2 * picture,
            asked: u64::from(EYES) * EYE_PIXELS * STORE_LOOKUP_BYTES,
            written: u64::from(EYES) * EYE_PIXELS * PIXEL_BYTES,
        },
    ]
}

/// Texels of so many mip levels, of which the finest has `texels`.
fn with_levels(texels: u64, levels: u32) -> u64 {
    (0..levels).map(|level| texels >> (2 * level)).sum()
}

/// What a client with the usual room keeps on the device, bytes: of a display's eyes and of its own programs nothing is counted.
pub fn memory() -> [(&'static str, u64); 4] {
    let bundles = BUNDLES as u64;
    let patches = u64::from(DEFAULT_PATCH_SLOTS);
    let corners = MAX_CORNERS_PER_PATCH as u64 * bytes::<CornerGpu>();
    let page = u64::from(STORE_PAGE_SIDE).pow(2);
    [
        (
            "the store: settled blocks",
            u64::from(USUAL_STORE_PAGES) * with_levels(page, STORE_LEVELS) * STORED_TEXEL_BYTES,
        ),
        ("pictures: the one on display, the one before, the next", bundles * ATLAS_TEXELS * 3 / 2),
        ("pictures on their way from the CPU; none where the device decodes", bundles * ATLAS_TEXELS * 3 / 2),
        (
            "corners and indices of patches, by bundle",
            bundles * patches * (corners + MAX_INDICES_PER_PATCH as u64 * INDEX_BYTES),
        ),
    ]
}

/// The table of [`memory`] in `docs/budget.md`.
pub fn memory_table() -> String {
    let rows: String =
        memory().iter().map(|(part, bytes)| format!("| {part} | {:.1} |\n", *bytes as f64 * 1e-6)).collect();
    let sum: u64 = memory().iter().map(|(_, bytes)| bytes).sum();
    format!("| part | MB |\n| --- | --- |\n{rows}| together | {:.1} |\n", sum as f64 * 1e-6)
}

/// What vertices would ask for if each invocation of the vertex shader skinned its own, instead of a pass before.
pub fn pulled_asked() -> u64 {
    let rest = SKIN_BYTES + bytes::<RestGpu>() + INFLUENCES * ROWS_BYTES;
    PATCHES * INDICES * (INDEX_BYTES + u64::from(EYES) * (bytes::<CornerGpu>() + rest))
}

/// The table of `docs/budget.md`.
pub fn table() -> String {
    let mb = |bytes: u64| format!("{:.2}", bytes as f64 * 1e-6);
    let line = |stage: &str, read: u64, asked: u64, written: u64| {
        format!("| {stage} | {} | {} | {} |\n", mb(read), mb(asked), mb(written))
    };
    let stages = stages();
    let sum = |of: fn(&Moved) -> u64| stages.iter().map(of).sum::<u64>();
    let (read, asked, written) = (sum(|m| m.read), sum(|m| m.asked), sum(|m| m.written));
    let rows: String = stages.iter().map(|m| line(m.stage, m.read, m.asked, m.written)).collect();
    let second = (read + written) as f64 * FRAMES_HZ as f64 * 1e-9;
    let [_, _, _, _, skin, vertices, _] = stages;
    let before = skin.asked + skin.written + vertices.asked;
    format!(
        "| stage | read, each byte once, MB | asked for, MB | written, MB |\n| --- | --- | --- | --- |\n{rows}{}\nEach byte once that \
         is {second:.1} GB a second at {FRAMES_HZ} frames.\n\nSkinning in a pass before, and drawing, asks for and writes {} MB; skinning in \
         the vertex shader would ask for {} MB, since each corner is evaluated for both eyes, and a vertex by each of its patches.\n",
        line("together", read, asked, written),
        mb(before),
        mb(pulled_asked()),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Raise one only with a reason in `docs/budget.md`.
    const MOST_OF_A_VERTEX: u64 = 88;
    const MOST_OF_A_CORNER: u64 = 24;
    const MOST_OF_A_BONE: u64 = 642;
    const MOST_OF_A_FRAME: u64 = 93_000_000;
    const MOST_OF_MEMORY: u64 = 290_000_000;

    #[test]
    fn no_vertex_corner_or_bone_exceeds_its_budget() {
        let vertex = VECTOR_BYTES + SKIN_BYTES + bytes::<RestGpu>() + 2 * VECTOR_BYTES;
        assert!(
            vertex <= MOST_OF_A_VERTEX,
            "{vertex} bytes a vertex: slots, rest, position written and read"
        );
        assert!(bytes::<CornerGpu>() <= MOST_OF_A_CORNER, "{} bytes a corner", bytes::<CornerGpu>());
        let [_, _, pose, ..] = stages();
        let bone = (pose.read + pose.written) / (INSTANCES * BONES);
        assert!(bone <= MOST_OF_A_BONE, "{bone} bytes a bone");
        let frame: u64 = stages().iter().map(|moved| moved.read + moved.written).sum();
        assert!(frame <= MOST_OF_A_FRAME, "{frame} bytes a frame");
        let memory: u64 = memory().iter().map(|(_, bytes)| bytes).sum();
        assert!(memory <= MOST_OF_MEMORY, "{memory} bytes of memory");
        assert!(stages().iter().all(|moved| moved.asked >= moved.read || moved.stage == "pixels"));
    }

    #[test]
    fn a_pass_before_moves_less_than_a_vertex_shader_that_skins() {
        let [_, _, _, _, skin, vertices, _] = stages();
        assert!(2 * (skin.asked + skin.written + vertices.asked) < pulled_asked());
    }
}
