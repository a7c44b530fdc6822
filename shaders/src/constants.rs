//! Constants shared by GLSL and Rust. Rust is their source: the build script includes this file, and gives its constants, and
//! those of `shadecast_protocol` that shaders read, to the compiler as macros of the same names. GLSL repeats none, and Rust
//! repeats none of GLSL's.

use shadecast_protocol::atlas::{PIXEL_BITS, PIXEL_STEPS, PatchKind};
use shadecast_protocol::limits::{
    BLOCK_INSET_TEXELS, CHROMA_INSET_TEXELS, MAX_LIGHTS, MAX_SAMPLE_RING, MAX_VIEWS, PATCH_MAX_VERTICES,
    PREDICTIONS, STORE_PAGE_SIDE, SUPERBLOCK_MIN_LOG2,
};
use shadecast_protocol::pose::NEAR_M;

/// A value as GLSL writes it.
trait Literal {
    fn literal(&self) -> String;
}

impl Literal for u32 {
    fn literal(&self) -> String {
        format!("{self}u")
    }
}

impl Literal for i32 {
    fn literal(&self) -> String {
        format!("({self})")
    }
}

impl Literal for f32 {
    fn literal(&self) -> String {
        format!("({self:?})")
    }
}

impl Literal for [u32; 2] {
    fn literal(&self) -> String {
        format!("uvec2({}u, {}u)", self[0], self[1])
    }
}

impl<const ROWS: usize, const COLUMNS: usize> Literal for [[f32; COLUMNS]; ROWS] {
    fn literal(&self) -> String {
        let row = |row: &[f32; COLUMNS]| {
            let values: Vec<_> = row.iter().map(f32::literal).collect();
            format!("float[{COLUMNS}]({})", values.join(", "))
        };
        let rows: Vec<_> = self.iter().map(row).collect();
        format!("float[{ROWS}][{COLUMNS}]({})", rows.join(", "))
    }
}

/// Defines constants; [`glsl_macros`] gives them and those of elsewhere.
macro_rules! shared {
    ({ $($known:ident),* $(,)? } $($(#[$doc:meta])* $name:ident: $type:ty = $value:expr;)*) => {
        $($(#[$doc])* pub const $name: $type = $value;)*

        /// Names and values of the macros that shaders are compiled with.
        pub fn glsl_macros() -> Vec<(&'static str, String)> {
            vec![
                $((stringify!($known), $known.literal()),)*
                $((stringify!($name), $name.literal()),)*
                ("PATCH_TRIANGLES", patch_triangles()),
                ("PATCH_ONE_CORNERS", patch_corners(PatchKind::One)),
                // Those of two triangles are the first of them.
                ("PATCH_CORNERS", patch_corners(PatchKind::Three)),
            ]
        }
    };
}

/// Frusta that an eye is looked at in, at most: shaders only know of all views together.
pub const MAX_FRUSTA: u32 = 4;

shared! {
    {
        BLOCK_INSET_TEXELS, CHROMA_INSET_TEXELS, MAX_LIGHTS, MAX_VIEWS, NEAR_M, PATCH_MAX_VERTICES, PIXEL_BITS,
        PIXEL_STEPS, PREDICTIONS, STORE_PAGE_SIDE, SUPERBLOCK_MIN_LOG2,
    }

    /// Views that are drawn at once.
    EYES: u32 = 2;
    /// What the ID buffer can be drawn from: the predicted views, and behind them the frusta of those that have several.
    ID_BUFFER_VIEWS: u32 = MAX_VIEWS * (1 + MAX_FRUSTA);
    /// What an image of numbers holds for number 0. What is less, 0, is background.
    FIRST_ID: u32 = 1;

    /// What the tag of a prediction counts its time in: the places of the longest ring, so that every ring has the
    /// prediction in the same place whatever its time.
    TIME_TAG_UNIT: u32 = MAX_SAMPLE_RING;
    /// Tag of a place in the sample ring that holds no sample. Samples have tags above it.
    NO_SAMPLE: u32 = 0;
    /// Bit of [`VertexWriteGpu::slot`](crate::generated::VertexWriteGpu::slot) for a static vertex that enters.
    STATIC_BIT: u32 = 1 << 31;
    /// The same for a skinned vertex that enters.
    SKINNED_BIT: u32 = 1 << 30;
    /// The same for one half of a rest.
    REST_BIT: u32 = 1 << 29;
    /// Beside [`REST_BIT`]: it is the second half.
    REST_END_BIT: u32 = 1 << 28;
    /// The same as [`STATIC_BIT`] for a predicted vertex that enters.
    PREDICTED_BIT: u32 = 1 << 27;
    /// The bits below these: a vertex slot, or a rest's number.
    SLOT_MASK: u32 = (1 << 27) - 1;
    /// In place of a rest's number plus 1: the vertex is not skinned.
    NO_REST: u32 = 0;
    /// Bits of a rest's word for its first morph delta; those above say how many there are.
    MORPH_FIRST_BITS: u32 = 24;
    /// Flag of an instance's pose: all that it needs is in the arena.
    POSE_READY: u32 = 1;
    /// Flag of an instance's pose: a path moves the instance.
    POSE_HAS_PATH: u32 = 2;
    /// Flag of an instance's pose: its local transforms come from the time grid.
    POSE_FROM_GRID: u32 = 4;
    /// Grid steps around a time that a pose on the grid is made of.
    GRID_STEPS: u32 = 4;
    /// Share of the blend of a static or skinned vertex; others have none below 0.
    STATIC_BLEND: f32 = -1.0;
    /// The same of a predicted vertex.
    PREDICTED_BLEND: f32 = -2.0;
    /// State of a vertex's position, its `w`: no samples around the display time.
    NOT_DRAWABLE: f32 = 0.0;
    /// State of a position: interpolated, or static.
    ON_CURVE: f32 = 1.0;
    /// State of a position: past the last sample, or the future has changed; the next curve is blended to.
    PAST_THE_END: f32 = 2.0;

    /// Kinds of patches, which are numbers of triangles: 1 to this.
    PATCH_KINDS: u32 = PatchKind::ALL.len() as u32;
    /// A word of a patch that is visible as a neighbour of what a view shows.
    SPREAD: u32 = 2;
    /// The kind of a patch of one triangle.
    PATCH_ONE: u32 = PatchKind::One as u32;
    /// The kind of a patch of two triangles.
    PATCH_TWO: u32 = PatchKind::Two as u32;
    /// Largest projected extent that the extents pass tells.
    MAX_PATCH_EXTENT_TEXELS: f32 = 65535.0;
    /// Beyond this cosine from the middle of the view, 66 degrees, a pixel's footprint is not that of a flat picture any more.
    EDGE_COSINE: f32 = 0.4;
    /// Least that a pixel is taken to cover of a block in any direction.
    MIN_TEXELS_PER_PIXEL: f32 = 1.0;
    /// Most that a pixel is taken to cover of a block in any direction.
    MAX_TEXELS_PER_PIXEL: f32 = 32.0;
    /// Texels across and down that an invocation of `ycbcr.comp` converts.
    YCBCR_TEXELS: [u32; 2] = [8, 2];
    /// Texels of a row, or of a column, that a chroma sample is made of: its own two, and two on either side.
    CHROMA_REACH: u32 = 6;
    /// What each of them counts: for the sample beside the border of a block that has two; and of a wider one for that beside
    /// the border, for the next, and for all others. Of an opposite border they count mirrored. Nothing beyond the
    /// border counts. Straight lines between the samples are then nearest to straight lines between the texels' own values, over
    /// the places that are looked up; an even colour and an even slope stay what they are.
    CHROMA_TAPS: [[f32; 6]; 4] = [
        [0.0, 0.0, 0.219, 0.968, -0.093, -0.094],
        [0.0, 0.0, 0.165, 0.943, 0.119, -0.227],
        [-0.041, -0.040, 0.544, 0.591, 0.051, -0.105],
        [-0.118, 0.054, 0.564, 0.564, 0.054, -0.118],
    ];

    /// Set in the first word of a corner's block where the patch does not cover all of it.
    IS_MASKED: u32 = 1 << 31;
    /// In the same word: the picture before has the same block.
    IS_KEPT: u32 = 1 << 15;

    /// Bits of each coordinate of the first texel beyond a corner's block; those above both are its page.
    BLOCK_END_BITS: u32 = 13;
    /// From this bit on, of both coordinates of a block's first texel in the store: how many texels a pixel covered when it was shaded, in
    /// quarters of an octave above one, 4 bits.
    STORED_PIXEL_BIT: u32 = 11;
    /// Sides of what a copy in the store is filtered for, in pixels that it was shaded for: textures come from mip levels, which filter for
    /// more than one.
    STORED_FILTER_PIXELS: f32 = 2.8;
    /// Mip levels of a page of the store.
    STORE_LEVELS: u32 = 5;
    /// Sides of the part of a block that a workgroup copies to the store, texels: one texel of the last level.
    SETTLE_TILE: u32 = 1 << (STORE_LEVELS - 1);

    /// Slots of a material for textures.
    TEXTURE_SLOTS: u32 = 5;
    /// Slot of the base colour.
    BASE_COLOR_SLOT: u32 = 0;
    /// Slot of metalness and roughness.
    METALLIC_ROUGHNESS_SLOT: u32 = 1;
    /// Slot of the normal map.
    NORMAL_SLOT: u32 = 2;
    /// Slot of occlusion.
    OCCLUSION_SLOT: u32 = 3;
    /// Slot of emitted light.
    EMISSIVE_SLOT: u32 = 4;
    /// A material's texture index where a slot is empty.
    NO_TEXTURE: i32 = -1;
    /// A material's `alpha_cutoff` where it is opaque.
    NO_ALPHA_CUTOFF: f32 = -1.0;

    /// Rows of an affine transform; in memory a `vec4` each.
    AFFINE_ROWS: u32 = 3;
    /// Parent of a root bone.
    NO_PARENT: i32 = -1;
    /// Bones that move a vertex at most.
    MAX_INFLUENCES: u32 = 4;
    /// `SkinJob::weight_base` of a mesh without morph targets.
    NO_MORPHS: u32 = u32::MAX;
    /// Kind of a track: the earlier key holds.
    STEP_TRACK: u32 = 0;
    /// Kind of a track: a straight line from key to key.
    LINEAR_TRACK: u32 = 1;
    /// Kind of a track: Hermite's cubic of both keys' values and tangents.
    CUBIC_TRACK: u32 = 2;

    /// Bits of a coordinate of a saved position.
    POSITION_BITS: u32 = 21;
    /// Vertices of one of the buffers that skinned ones are saved in: of 8 bytes each as many as every device can bind.
    CHUNK_VERTICES: u32 = 1 << 24;
    /// Buffers that skinned vertices are saved in at most.
    SAVED_CHUNKS: u32 = 4;

    /// Columns and rows of a glyph's dots; a column is a byte.
    GLYPH_DOTS: [u32; 2] = [5, 8];
    /// Words of a glyph.
    GLYPH_WORDS: u32 = 2;
    /// Dots of a glyph's cell, across and along: those of the glyph, and what lies between glyphs.
    GLYPH_CELL_DOTS: [u32; 2] = [6, 9];
    /// Between a window's border and its figures.
    FIGURES_MARGIN_DOTS: f32 = 2.0;
}

/// By kind of patch the corners of its triangles, three each; what is left is 0.
fn patch_triangles() -> String {
    let most = PATCH_KINDS as usize * 3;
    let rows = PatchKind::ALL.map(|kind| {
        let corners = kind.triangles().as_flattened().iter().map(|corner| u32::from(*corner).literal());
        let row: Vec<_> = corners.chain(std::iter::repeat("0u".to_owned())).take(most).collect();
        format!("uint[{most}]({})", row.join(", "))
    });
    format!("uint[{PATCH_KINDS}][{most}]({})", rows.join(", "))
}

/// The places of a patch's vertices in the unit square.
fn patch_corners(kind: PatchKind) -> String {
    let corners: Vec<_> = kind.corner_uv().iter().map(|[u, v]| format!("vec2({u:?}, {v:?})")).collect();
    format!("vec2[{}]({})", corners.len(), corners.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_corners_of_two_triangles_are_the_first_of_three() {
        assert!(PatchKind::Three.corner_uv().starts_with(PatchKind::Two.corner_uv()));
    }

    #[test]
    fn every_macro_is_named_by_some_shader_and_defined_by_none() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/glsl");
        let files = std::fs::read_dir(folder).expect("shaders/glsl").flatten();
        let text: String = files.map(|file| std::fs::read_to_string(file.path()).expect("GLSL")).collect();
        let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let words: Vec<&str> = text.split(|c| !is_part(c)).collect();
        for (name, _) in glsl_macros() {
            assert!(words.contains(&name), "{name} is shared for nobody");
            assert!(!text.contains(&format!(" {name} =")), "{name} has two definitions");
        }
    }
}
