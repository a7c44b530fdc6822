//! The scene as every renderer sees it: models with their bones, clips and materials, and placed instances.
//!
//! Importers ([`gltf`]) and the scene file ([`mod@file`]) produce it; nothing in here knows of Vulkan.

pub mod error;
pub mod file;
pub mod gltf;
pub mod ground;
pub mod influences;
pub mod load;
pub mod split;
pub mod suggest;
pub mod weld;

pub use error::SceneError;
pub use load::{SceneSource, load_scene};

use glam::{Affine3A, Quat, Vec3};
use shadecast_protocol::pose::Pose;

/// Everything that is rendered.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Assets, each stored once however often it is placed.
    pub models: Vec<Model>,
    /// Placed models; an index into this list is an `InstanceId`.
    pub instances: Vec<Instance>,
    /// The one directional light.
    pub sun: Sun,
    /// Background and ambient light.
    pub environment: Environment,
    /// Where the stage's origin (the floor under the user) starts in the world.
    pub world_from_stage: Pose,
}

/// One asset: its node hierarchy, its geometry (all primitives in one vertex and index array), materials, clips.
#[derive(Clone, Debug, Default)]
pub struct Model {
    /// For messages and statistics.
    pub name: String,
    /// Every node of the asset, parents before children. A node is a bone, whether or not a skin uses it.
    pub bones: Vec<Bone>,
    /// What vertices refer to: a bone and the transform into its space.
    pub palette: Vec<PaletteEntry>,
    /// All vertices, in mesh space.
    pub vertices: Vec<Vertex>,
    /// Three per triangle, into `vertices`, counter-clockwise seen from the front.
    pub indices: Vec<u32>,
    /// Ranges of `indices` with one material each; together they cover `indices`.
    pub primitives: Vec<Primitive>,
    /// Materials; never empty where there are primitives.
    pub materials: Vec<Material>,
    /// Images, 8-bit RGBA.
    pub textures: Vec<Texture>,
    /// Source clips, curves as the file has them.
    pub clips: Vec<Clip>,
}

/// Translation, rotation and scale: `translate * rotate * scale`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trs {
    /// Metres (the asset's unit).
    pub translation: Vec3,
    /// Unit quaternion.
    pub rotation: Quat,
    /// Per axis.
    pub scale: Vec3,
}

/// A node of the hierarchy.
#[derive(Clone, Debug)]
pub struct Bone {
    /// From the asset, or made up.
    pub name: String,
    /// Index of the parent, always smaller than the bone's own.
    pub parent: Option<u32>,
    /// Local transform where no clip moves the bone.
    pub rest: Trs,
}

/// `model_from_mesh = model_from_bone * bone_from_mesh`: a skin's joint with its inverse bind matrix, or a plain
/// node with the identity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaletteEntry {
    /// Index into [`Model::bones`].
    pub bone: u32,
    /// The inverse bind matrix.
    pub bone_from_mesh: Affine3A,
}

/// A vertex in mesh space with its (at most four) influences.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vertex {
    /// Mesh space, metres.
    pub position: Vec3,
    /// Unit length.
    pub normal: Vec3,
    /// xyz unit length, w the sign of the bitangent: `cross(normal, tangent.xyz) * w`.
    pub tangent: [f32; 4],
    /// First texture coordinate set, v down as in glTF.
    pub uv: [f32; 2],
    /// Indices into [`Model::palette`].
    pub joints: [u16; 4],
    /// Not negative, sum 1.
    pub weights: [f32; 4],
}

/// A range of indices with one material.
#[derive(Clone, Debug, PartialEq)]
pub struct Primitive {
    /// First index, a multiple of 3.
    pub first_index: u32,
    /// Number of indices, a multiple of 3.
    pub index_count: u32,
    /// Index into [`Model::materials`].
    pub material: u32,
}

/// PBR metallic-roughness, as glTF 2.0 section 3.9 defines it.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// From the asset.
    pub name: String,
    /// Linear RGBA factor.
    pub base_color: [f32; 4],
    /// 0..1.
    pub metallic: f32,
    /// 0..1, perceptual.
    pub roughness: f32,
    /// Linear RGB.
    pub emissive: [f32; 3],
    /// Scale of the normal map's x and y.
    pub normal_scale: f32,
    /// Strength of the occlusion texture, 0..1.
    pub occlusion_strength: f32,
    /// Index into [`Model::textures`] (sRGB).
    pub base_color_texture: Option<u32>,
    /// g roughness, b metallic (linear).
    pub metallic_roughness_texture: Option<u32>,
    /// Tangent space (linear).
    pub normal_texture: Option<u32>,
    /// r occlusion (linear).
    pub occlusion_texture: Option<u32>,
    /// sRGB.
    pub emissive_texture: Option<u32>,
    /// `Some(cutoff)` for alpha MASK; BLEND is treated as opaque, with one warning.
    pub alpha_cutoff: Option<f32>,
    /// Both sides are drawn and shaded.
    pub double_sided: bool,
}

/// An image, rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// From the asset.
    pub name: String,
    /// Width and height in texels, both at least 1.
    pub extent_texels: [u32; 2],
    /// `4 * width * height` bytes, RGBA.
    pub rgba8: Vec<u8>,
    /// Whether rgb is sRGB-coded (base colour, emissive) or linear (everything else).
    pub srgb: bool,
    /// How the texture repeats in u and v.
    pub wrap: [Wrap; 2],
}

/// Texture addressing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wrap {
    /// Repeat.
    Repeat,
    /// Repeat, every second one mirrored.
    Mirror,
    /// Clamp to the edge.
    Clamp,
}

/// A named set of curves.
#[derive(Clone, Debug, Default)]
pub struct Clip {
    /// From the asset, or made up.
    pub name: String,
    /// Time of the last key, seconds; keys start at 0 or later.
    pub duration_s: f32,
    /// At most one per bone and channel.
    pub tracks: Vec<Track>,
}

/// One curve of one bone.
#[derive(Clone, Debug)]
pub struct Track {
    /// Index into [`Model::bones`].
    pub bone: u32,
    /// Seconds, strictly rising, at least one.
    pub times_s: Vec<f32>,
    /// How to go from key to key.
    pub interpolation: Interpolation,
    /// Key values.
    pub values: TrackValues,
}

/// glTF's three interpolations. CUBICSPLINE stores in-tangent, value, out-tangent per key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Hold the key.
    Step,
    /// Linear; slerp for rotations.
    Linear,
    /// Hermite with the stored tangents (glTF 2.0 appendix C).
    CubicSpline,
}

/// Values of a curve: one per key, three per key for CUBICSPLINE.
#[derive(Clone, Debug)]
pub enum TrackValues {
    /// Metres.
    Translation(Vec<Vec3>),
    /// Quaternions.
    Rotation(Vec<Quat>),
    /// Factors.
    Scale(Vec<Vec3>),
}

/// A model placed in the world.
#[derive(Clone, Debug)]
pub struct Instance {
    /// For messages.
    pub name: String,
    /// Index into [`Scene::models`].
    pub model: usize,
    /// The configuration's matrix, applied after the asset's hierarchy.
    pub world_from_model: Affine3A,
    /// Index into the model's clips; `None` holds the rest pose.
    pub clip: Option<usize>,
    /// Added to the scene's time before the clip is looked up.
    pub time_shift_s: f32,
    /// Factor on time.
    pub speed: f32,
}

impl Instance {
    /// Seconds since the clip's start, not wrapped, at a time of the scene: the shift is added first, then the speed
    /// scales.
    pub fn clip_time_s(&self, scene_time_s: f64) -> f64 {
        (scene_time_s + f64::from(self.time_shift_s)) * f64::from(self.speed)
    }
}

/// A directional light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// Unit vector towards the sun.
    pub to_sun: Vec3,
    /// Linear RGB irradiance on a surface that faces the sun.
    pub irradiance: Vec3,
}

/// A vertical gradient: the sky seen by the user, and the ambient light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Environment {
    /// Linear RGB radiance straight up.
    pub zenith: Vec3,
    /// Linear RGB radiance at the horizon.
    pub horizon: Vec3,
    /// Linear RGB radiance straight down.
    pub nadir: Vec3,
}

impl Trs {
    /// Changes nothing.
    pub const IDENTITY: Self = Self { translation: Vec3::ZERO, rotation: Quat::IDENTITY, scale: Vec3::ONE };

    /// `translate * rotate * scale`.
    pub fn affine(self) -> Affine3A {
        Affine3A::from_scale_rotation_translation(self.scale, self.rotation, self.translation)
    }
}
