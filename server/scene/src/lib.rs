//! The renderers' view of a scene: models with their bones, clips and materials, and placed instances.
//!
//! Importers ([`gltf`], [`fbx`]) and the scene file ([`mod@file`]) produce it; [`animation`] evaluates and samples its curves.
//! It is a separate crate: it cannot know Vulkan, sockets or clocks, and its readers of strangers' files can be fuzzed without
//! building a renderer.

pub mod animation;
pub mod bulk;
pub mod cache;
pub mod cancel;
mod check;
pub mod mips;
pub mod patches;
pub mod error;
pub mod fbx;
pub mod file;
pub mod gltf;
pub mod ground;
mod image;
mod import;
pub mod identity;
pub mod influences;
mod limits;
pub mod load;
pub mod lod;
mod path;
mod references;
pub mod process;
#[cfg(any(test, feature = "checks"))]
pub mod sound;
pub mod split;
pub mod suggest;
pub mod timeline;
mod surface;
mod tangent;
mod views;
pub mod weld;

pub use cancel::{Cancel, Cancelled};
pub use error::SceneError;
pub use load::{SceneSource, load_scene};

use animation::clip;
use bytemuck::{Pod, Zeroable};
use glam::{Affine3A, Quat, Vec3};
use patches::Patches;
use serde::{Deserialize, Serialize};
use shadecast_model::playback;
pub use shadecast_model::playback::Repetition;
use shadecast_model::pose::Pose;
use timeline::Event;

/// Everything that is rendered.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Assets, each stored once however often it is placed.
    pub models: Vec<Model>,
    /// Placed models; an index into this list is an `InstanceId`.
    pub instances: Vec<Instance>,
    /// What changes of what they play as time goes by, in any order; of one instance, none amid the fade of another.
    pub events: Vec<Event>,
    /// The light that casts shadows.
    pub sun: Sun,
    /// Lights placed by the scene file, at most [`MAX_LIGHTS`](shadecast_model::limits::MAX_LIGHTS);
    /// those of an asset are in its [`Model::lights`].
    pub lights: Vec<PlacedLight>,
    /// Background and ambient light.
    pub environment: Environment,
    /// Where the stage's origin (the floor under the user) starts in the world.
    pub world_from_stage: Pose,
    /// Named places to look from, for pictures and measurements; names are unique.
    pub cameras: Vec<Camera>,
    /// Named movements of a head in the stage, for measurements; names are unique.
    pub head_paths: Vec<HeadPath>,
}

/// One asset: its node hierarchy, its geometry (all primitives in one vertex and index array), materials, clips.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Model {
    /// For messages and statistics.
    pub name: String,
    /// Every node of the asset, parents before children. A node is a bone, whether or not a skin uses it.
    pub bones: Vec<Bone>,
    /// What vertices refer to: a bone and the transform into its space.
    pub palette: Vec<PaletteEntry>,
    /// All vertices, in mesh space, of all levels of detail.
    #[serde(with = "bulk")]
    pub vertices: Vec<Vertex>,
    /// The full detail: three per triangle, into `vertices`, counter-clockwise seen from the front.
    #[serde(with = "bulk")]
    pub indices: Vec<u32>,
    /// Ranges of `indices` with one material each; together they cover `indices`.
    pub primitives: Vec<Primitive>,
    /// Coarser levels, each coarser than the one before; empty where there is nothing to gain.
    pub lods: Vec<Lod>,
    /// Patches of the full detail, then of each of `lods`; empty until [`process`] has made them.
    pub patches: Vec<Patches>,
    /// Shapes that are added to the vertices before skinning, each times its weight.
    pub morphs: Vec<Morph>,
    /// Lights that hang on bones.
    pub lights: Vec<ModelLight>,
    /// Materials; never empty where there are primitives.
    pub materials: Vec<Material>,
    /// Images, 8-bit RGBA.
    pub textures: Vec<Texture>,
    /// Source clips, curves as the file has them.
    pub clips: Vec<Clip>,
}

/// Translation, rotation and scale: `translate * rotate * scale`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trs {
    /// Metres (the asset's unit).
    pub translation: Vec3,
    /// Unit quaternion.
    pub rotation: Quat,
    /// Per axis.
    pub scale: Vec3,
}

/// A node of the hierarchy.
#[derive(Clone, Debug, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PaletteEntry {
    /// Index into [`Model::bones`].
    pub bone: u32,
    /// The inverse bind matrix.
    pub bone_from_mesh: Affine3A,
}

/// A coarser level of detail: fewer triangles over a subset of the model's vertices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lod {
    /// Largest distance of its surface from the full detail's, metres in model space, as measured between the surfaces
    /// in the rest pose and in poses of the clips. At least the length of an edge over the texels of the largest block,
    /// where edges are longer than in the full detail.
    pub error_m: f32,
    /// Three per triangle, into [`Model::vertices`].
    #[serde(with = "bulk")]
    pub indices: Vec<u32>,
    /// Ranges of `indices`, one for each of [`Model::primitives`] in their order; a range may be empty.
    pub primitives: Vec<Primitive>,
}

/// A morph target of one mesh of the model: what a weight of 1 adds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Morph {
    /// From the asset, or made up.
    pub name: String,
    /// The weight where no clip moves it.
    pub rest_weight: f32,
    /// The vertices that it moves, ascending.
    #[serde(with = "bulk")]
    pub deltas: Vec<MorphDelta>,
}

/// What a morph target adds to one vertex, in mesh space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, Pod, Zeroable)]
#[repr(C)]
pub struct MorphDelta {
    /// Index into [`Model::vertices`].
    pub vertex: u32,
    /// Metres.
    pub position: Vec3,
    /// Added before the sum is made unit length.
    pub normal: Vec3,
    /// Added to the tangent's xyz likewise.
    pub tangent: Vec3,
}

/// A vertex in mesh space with its (at most four) influences.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, Pod, Zeroable)]
#[repr(C)]
pub struct Vertex {
    /// Mesh space, metres.
    pub position: Vec3,
    /// Unit length.
    pub normal: Vec3,
    /// xyz unit length, w the sign of the bitangent: `cross(normal, tangent.xyz) * w`.
    pub tangent: [f32; 4],
    /// First texture coordinate set, v down as in glTF.
    pub uv: [f32; 2],
    /// Second texture coordinate set; zero where no texture uses it.
    pub uv1: [f32; 2],
    /// Linear RGBA, 255 for 1, multiplied with the base colour.
    pub color: [u8; 4],
    /// Indices into [`Model::palette`].
    pub joints: [u16; 4],
    /// Not negative, sum 1.
    pub weights: [f32; 4],
}

impl Vertex {
    /// Number of influences, those of weight 0 not counted.
    pub fn influences(&self) -> usize {
        self.weights.iter().filter(|weight| **weight > 0.0).count()
    }
}

impl Default for Vertex {
    /// At the origin, facing +z, white, following palette entry 0.
    fn default() -> Self {
        Self {
            position: Vec3::ZERO,
            normal: Vec3::Z,
            tangent: [1.0, 0.0, 0.0, 1.0],
            uv: [0.0; 2],
            uv1: [0.0; 2],
            color: [255; 4],
            joints: [0; 4],
            weights: [1.0, 0.0, 0.0, 0.0],
        }
    }
}

/// A range of indices with one material.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Primitive {
    /// First index, a multiple of 3.
    pub first_index: u32,
    /// Number of indices, a multiple of 3.
    pub index_count: u32,
    /// Index into [`Model::materials`].
    pub material: u32,
}

/// PBR metallic-roughness, as glTF 2.0 section 3.9 defines it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// sRGB.
    pub base_color_texture: Option<TextureSlot>,
    /// g roughness, b metallic (linear).
    pub metallic_roughness_texture: Option<TextureSlot>,
    /// Tangent space (linear).
    pub normal_texture: Option<TextureSlot>,
    /// r occlusion (linear).
    pub occlusion_texture: Option<TextureSlot>,
    /// sRGB.
    pub emissive_texture: Option<TextureSlot>,
    /// The alpha below which nothing is drawn, of cutouts; glTF's BLEND becomes one.
    pub alpha_cutoff: Option<f32>,
    /// Both sides are drawn and shaded.
    pub double_sided: bool,
    /// The base colour is shown as it is, without light.
    pub unlit: bool,
}

impl Default for Material {
    /// White, rough, not a metal, without textures.
    fn default() -> Self {
        Self {
            name: String::new(),
            base_color: [1.0; 4],
            metallic: 0.0,
            roughness: 1.0,
            emissive: [0.0; 3],
            normal_scale: 1.0,
            occlusion_strength: 1.0,
            base_color_texture: None,
            metallic_roughness_texture: None,
            normal_texture: None,
            occlusion_texture: None,
            emissive_texture: None,
            alpha_cutoff: None,
            double_sided: false,
            unlit: false,
        }
    }
}

impl Material {
    /// All places for textures, with what is in them.
    pub fn texture_slots(&self) -> [Option<TextureSlot>; 5] {
        [
            self.base_color_texture,
            self.metallic_roughness_texture,
            self.normal_texture,
            self.occlusion_texture,
            self.emissive_texture,
        ]
    }
}

/// How a material uses a texture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TextureSlot {
    /// Index into [`Model::textures`].
    pub texture: u32,
    /// Which texture coordinates: 0 for [`Vertex::uv`], 1 for [`Vertex::uv1`].
    pub set: u32,
    /// 2x3, rows: `u' = m[0][0] u + m[0][1] v + m[0][2]`, and v' likewise with `m[1]`.
    pub uv_transform: [[f32; 3]; 2],
}

impl From<u32> for TextureSlot {
    /// The texture by the first coordinates as they are.
    fn from(texture: u32) -> Self {
        Self { texture, set: 0, uv_transform: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] }
    }
}

impl TextureSlot {
    /// Where a vertex looks its colour up.
    pub fn coordinates(&self, vertex: &Vertex) -> [f32; 2] {
        let [u, v] = if self.set == 0 { vertex.uv } else { vertex.uv1 };
        self.uv_transform.map(|row| row[0] * u + row[1] * v + row[2])
    }
}

/// A light that hangs on a bone and shines along the bone's -z.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelLight {
    /// Index into [`Model::bones`].
    pub bone: u32,
    /// The light.
    pub light: Light,
}

/// A light placed in the world; it shines along its -z.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedLight {
    /// Where it is and which way it points; scale is ignored.
    pub world_from_light: Affine3A,
    /// The light.
    pub light: Light,
}

/// A light without shadows, as `KHR_lights_punctual` defines it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Light {
    /// From the asset or the scene file, or made up.
    pub name: String,
    /// Shape of the beam.
    pub kind: LightKind,
    /// Linear RGB times intensity: radiant intensity of a point or spot light (irradiance at 1 m), irradiance of a
    /// directional one. One photometric unit of an asset (candela, lux) counts as one of ours.
    pub intensity: Vec3,
    /// Distance in metres where a point or spot light has faded to nothing; `None`: never.
    pub range_m: Option<f32>,
}

/// Shapes of beams.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum LightKind {
    /// Parallel.
    Directional,
    /// All around.
    Point,
    /// A cone; full inside the inner angle, nothing outside the outer one, measured from the axis, radians.
    Spot {
        /// At least 0.
        inner_cone_rad: f32,
        /// Larger than the inner one, at most a right angle.
        outer_cone_rad: f32,
    },
}

/// A named place to look from.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Unique among cameras.
    pub name: String,
    /// In the stage, looking along -z.
    pub stage_from_eye: Pose,
    /// Vertical field of view, degrees.
    pub fov_deg: f32,
}

/// A named movement of the head in the stage.
#[derive(Clone, Debug)]
pub struct HeadPath {
    /// Unique among head paths.
    pub name: String,
    /// Scale is ignored; looking along -z.
    pub path: Path,
}

/// A transform that moves by keyframes: a clip of a skeleton of one bone.
#[derive(Clone, Debug)]
pub struct Path {
    /// Tracks of bone 0; a channel without one stays at identity.
    pub clip: Clip,
    /// What happens after the last key.
    pub repetition: Repetition,
    /// Added to the scene's time first.
    pub time_shift_s: f32,
    /// Then time is multiplied by this.
    pub speed: f32,
}

/// An image, rows from the top.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Texture {
    /// From the asset.
    pub name: String,
    /// Width and height in texels, both at least 1.
    pub extent_texels: [u32; 2],
    /// `4 * width * height` bytes, RGBA.
    #[serde(with = "bulk")]
    pub rgba8: Vec<u8>,
    /// Whether rgb is sRGB-coded (base colour, emissive) or linear (everything else).
    pub srgb: bool,
    /// How the texture repeats in u and v.
    pub wrap: [Wrap; 2],
}

/// Texture addressing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Wrap {
    /// Repeat.
    Repeat,
    /// Repeat, every second one mirrored.
    Mirror,
    /// Clamp to the edge.
    Clamp,
}

/// A named set of curves.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Clip {
    /// From the asset, or made up.
    pub name: String,
    /// Time of the last key, seconds; keys start at 0 or later.
    pub duration_s: f32,
    /// At most one per bone and channel.
    pub tracks: Vec<Track>,
    /// Curves of morph weights; no morph is in more than one.
    pub morph_tracks: Vec<MorphTrack>,
}

/// The curves of the weights of consecutive morphs, which share their key times.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MorphTrack {
    /// Index into [`Model::morphs`].
    pub first_morph: u32,
    /// Number of morphs, at least one.
    pub morph_count: u32,
    /// Seconds, strictly rising, at least one.
    #[serde(with = "bulk")]
    pub times_s: Vec<f32>,
    /// How to go from key to key.
    pub interpolation: Interpolation,
    /// `morph_count` weights per key; for CUBICSPLINE three times as many: in-tangents, weights, out-tangents.
    #[serde(with = "bulk")]
    pub weights: Vec<f32>,
}

/// One curve of one bone.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Track {
    /// Index into [`Model::bones`].
    pub bone: u32,
    /// Seconds, strictly rising, at least one.
    #[serde(with = "bulk")]
    pub times_s: Vec<f32>,
    /// How to go from key to key.
    pub interpolation: Interpolation,
    /// Key values.
    pub values: TrackValues,
}

/// glTF's three interpolations. CUBICSPLINE stores in-tangent, value, out-tangent per key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Interpolation {
    /// Hold the key.
    Step,
    /// Linear; slerp for rotations.
    Linear,
    /// Hermite with the stored tangents (glTF 2.0 appendix C).
    CubicSpline,
}

/// Values of a curve: one per key, three per key for CUBICSPLINE.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub enum TrackValues {
    /// Metres.
    #[serde(with = "bulk")]
    Translation(Vec<Vec3>),
    /// Quaternions.
    #[serde(with = "bulk")]
    Rotation(Vec<Quat>),
    /// Factors.
    #[serde(with = "bulk")]
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
    pub placement: Affine3A,
    /// Moves the placed instance: `world_from_model = path * placement`.
    pub path: Option<Path>,
    /// Index into the model's clips; `None` holds the rest pose.
    pub clip: Option<usize>,
    /// Added to the scene's time before the clip is looked up.
    pub time_shift_s: f32,
    /// Factor on time.
    pub speed: f32,
    /// What the clip does outside its duration.
    pub repetition: Repetition,
    /// Whether the sun casts its shadow.
    pub casts_shadow: bool,
    /// Whether an application may let it play any clip of its model, and pose it, at run time.
    pub live: bool,
}

impl Instance {
    /// A model placed at the world's origin, still.
    pub fn new(name: impl Into<String>, model: usize) -> Self {
        Self {
            name: name.into(),
            model,
            placement: Affine3A::IDENTITY,
            path: None,
            clip: None,
            time_shift_s: 0.0,
            speed: 1.0,
            repetition: Repetition::Loop,
            casts_shadow: true,
            live: false,
        }
    }

    /// `path * placement` at a time of the scene, by the path's source curves; by its sampled ones:
    /// [`SampledPaths`](animation::sampling::SampledPaths).
    pub fn world_from_model(&self, scene_time_s: f64) -> Affine3A {
        self.path.as_ref().map_or(self.placement, |path| path.transform(scene_time_s) * self.placement)
    }
}

impl Path {
    /// The transform at a time of the scene.
    pub fn transform(&self, scene_time_s: f64) -> Affine3A {
        clip::transform_of_tracks(&self.clip.tracks, Trs::IDENTITY, self.phase_s(scene_time_s)).affine()
    }

    /// How far into its clip the path is at a time of the scene: the shift is added first, then the speed scales, then
    /// the clip repeats.
    pub fn phase_s(&self, scene_time_s: f64) -> f64 {
        let time_s = (scene_time_s + f64::from(self.time_shift_s)) * f64::from(self.speed);
        playback::phase_s(time_s, self.clip.duration_s, self.repetition)
    }
}

/// A directional light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sun {
    /// Unit vector towards the sun.
    pub to_sun: Vec3,
    /// Linear RGB irradiance on a surface that faces the sun.
    pub irradiance: Vec3,
    /// Whether what is in its way throws shadows.
    pub casts_shadows: bool,
}

/// A vertical gradient: the sky seen by the user, and the ambient light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Environment {
    /// Linear RGB radiance straight up.
    pub zenith: Vec3,
    /// Linear RGB radiance at the horizon.
    pub horizon: Vec3,
    /// Linear RGB radiance straight down.
    pub nadir: Vec3,
}

impl Model {
    /// Length of a clip in seconds; 0 for the rest pose.
    pub fn duration_s(&self, clip: Option<usize>) -> f32 {
        clip.map_or(0.0, |clip| self.clips[clip].duration_s)
    }
}

impl Trs {
    /// Changes nothing.
    pub const IDENTITY: Self = Self { translation: Vec3::ZERO, rotation: Quat::IDENTITY, scale: Vec3::ONE };

    /// `translate * rotate * scale`.
    pub fn affine(self) -> Affine3A {
        Affine3A::from_scale_rotation_translation(self.scale, self.rotation, self.translation)
    }
}
