//! The scene in GPU memory, each thing once however many models and instances use it, and the numbers of its parts.

pub(crate) mod drawing;
pub(crate) mod geometry;
pub(crate) mod gloss;
pub mod lights;
pub(crate) mod materials;
pub(crate) mod meshes;
pub mod motion_library;
pub mod numbering;
pub(crate) mod rasters;
pub(crate) mod shine;
pub mod skins;
pub mod views;

use crate::animation::buffers::AnimationBuffers;
use crate::animation::manager::AnimationManager;
use crate::scene::gloss::Gloss;
use crate::scene::lights::SunView;
use crate::scene::motion_library::MotionLibrary;
use crate::scene::motion_library::MotionOption;
use crate::scene::shine::StillLight;
use crate::scene::skins::{SkinnedMesh, Skinning, SkinningArrays, SkinningBuffers};
use crate::support::upload;
use materials::{MaterialArrays, Materials};
use meshes::{Mesh, MeshArrays, Meshes};
use numbering::{InstanceSize, Numbering, ScenePatch};
use shadecast_gpu::{Gpu, GpuError};
use shadecast_protocol::limits::MAX_LIGHTS;
use shadecast_scene::animation::bounds::{self, Bounds};
use shadecast_scene::animation::played::PlayedBounds;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::identity::ContentHash;
use shadecast_scene::patches::Patch;
use shadecast_scene::process::Loading;
use shadecast_scene::{Cancel, Cancelled, Instance, Model, Scene};
use shadecast_shaders::generated::{EXTENTS_COMP, SKIN_COMP};
use std::collections::HashMap;
use std::sync::Arc;

/// A model's place in the shared buffers.
#[derive(Debug)]
pub struct ModelGpu {
    /// Its mesh, which other models may share.
    pub mesh: Mesh,
    /// What moves the mesh's vertices.
    pub skin: SkinnedMesh,
    /// First entry in the material buffer.
    pub material_base: u32,
}

impl std::ops::Deref for ModelGpu {
    type Target = Mesh;

    fn deref(&self) -> &Mesh {
        &self.mesh
    }
}

/// How a scene is brought to the GPU.
#[derive(Clone, Copy, Debug, Default)]
pub struct SceneOptions {
    /// How clips become keys.
    pub sampling: Sampling,
    /// How vertices are skinned.
    pub skinning: Skinning,
    /// How clients are told of motion.
    pub motion: MotionOption,
    /// How often the sides of the shadow map are doubled, for measurements: 0 in the product.
    pub shadow_doublings: u32,
}

/// Why a scene was not brought to a device.
#[derive(Debug, thiserror::Error)]
pub enum SceneGpuError {
    /// The device, or a scene that is too large for it.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Somebody asked to end.
    #[error("loading was interrupted")]
    Cancelled(#[from] Cancelled),
}

/// All of it.
pub struct SceneGpu {
    /// The scene it was made from.
    pub scene: Scene,
    /// By model.
    pub models: Vec<ModelGpu>,
    /// Numbers of patches and vertices, and the instances' places among them.
    pub numbering: Numbering,
    /// By instance: a box in the world that it never leaves, whatever it plays and over its path; empty without vertices.
    pub world_bounds: Vec<Bounds>,
    /// By instance: a box in its model's space that it never leaves, whatever it plays; empty without vertices.
    pub played_bounds: Vec<Bounds>,
    /// Vertices, triangles and patches.
    pub meshes: Meshes,
    /// Materials and textures.
    pub materials: Materials,
    /// How vertices are skinned.
    pub skinning: Skinning,
    /// What skinning reads beside the vertices.
    pub skins: SkinningBuffers,
    /// By model and material, what of it depends on the eye.
    pub gloss: Vec<Vec<Gloss>>,
    /// The light that stays.
    pub still_light: StillLight,
    /// Skeletons and clips.
    pub animation: AnimationBuffers,
    /// What clients can be told of its motion.
    pub motion: MotionLibrary,
    shadow_extent_texels: u32,
}

impl SceneGpu {
    /// Uploads `scene`, its clips sampled.
    ///
    /// # Errors
    /// Memory, or more than the device can bind.
    pub fn new(gpu: &Arc<Gpu>, scene: Scene, options: &SceneOptions) -> Result<Self, SceneGpuError> {
        Self::cached(gpu, scene, options, &Loading::plain())
    }

    /// As [`Self::new`], with clips that were sampled before taken from the cache, until somebody asks to end.
    ///
    /// # Errors
    /// Those of [`Self::new`], and that somebody asked to end.
    pub fn cached(
        gpu: &Arc<Gpu>,
        scene: Scene,
        options: &SceneOptions,
        loading: &Loading,
    ) -> Result<Self, SceneGpuError> {
        let manager = AnimationManager::new(&scene, options.sampling, loading)?;
        let mut arrays = Arrays::new(options.skinning);
        let with_mesh = scene.models.iter().zip(&manager.materials);
        let models: Vec<_> = with_mesh.map(|(model, material)| arrays.add(model, material.mesh)).collect();
        check_groups(gpu, &models)?;
        let numbering = number(&scene, &models);
        let played_bounds = played_bounds(&scene, &loading.cancel)?;
        let world_bounds = scene.instances.iter().zip(&played_bounds);
        let world_bounds =
            world_bounds.map(|(instance, played)| bounds::instance_bounds(instance, *played)).collect();
        let surplus = lights::surplus(&scene);
        if surplus > 0 {
            tracing::warn!("{surplus} lights are left out: a scene has at most {MAX_LIGHTS} beside the sun");
        }
        Ok(Self {
            materials: arrays.materials.upload(gpu, &loading.cancel)?,
            meshes: arrays.meshes.upload(gpu)?,
            skinning: options.skinning,
            skins: arrays.skins.upload(gpu)?,
            motion: MotionLibrary::new(&scene, &manager, &numbering, options.motion),
            animation: AnimationBuffers::new(gpu, manager)?,
            shadow_extent_texels: lights::SHADOW_EXTENT_TEXELS << options.shadow_doublings,
            gloss: gloss(&scene),
            still_light: lights::still(&scene),
            scene,
            models,
            numbering,
            world_bounds,
            played_bounds,
        })
    }

    /// A patch of any LOD; its vertices are indices within the model.
    pub fn patch(&self, patch: ScenePatch) -> Patch {
        let (instance, lod) = self.numbering.place_of_patch(patch);
        let range = self.numbering.patches(instance, lod).expect("it holds the patch");
        self.mesh(instance).lods[lod].patches[range.model_number(patch) as usize]
    }

    /// Whether the material of a patch cuts something out.
    pub(crate) fn is_masked(&self, patch: ScenePatch) -> bool {
        let model = self.numbering.instances[self.numbering.instance_of_patch(patch)].model;
        let materials = &self.scene.models[model].materials;
        materials[self.patch(patch).material as usize].alpha_cutoff.is_some()
    }

    /// What of a patch's material depends on the eye; `number`: of its instance.
    pub(crate) fn gloss_of(&self, number: usize, patch: &Patch) -> Gloss {
        self.gloss[self.numbering.instances[number].model][patch.material as usize]
    }

    /// Whether any material cuts something out.
    pub(crate) fn has_masks(&self) -> bool {
        let materials = self.scene.models.iter().flat_map(|model| &model.materials);
        materials.into_iter().any(|material| material.alpha_cutoff.is_some())
    }

    /// The mesh of an instance.
    pub fn mesh(&self, instance: usize) -> &Mesh {
        &self.models[self.numbering.instances[instance].model].mesh
    }

    /// The instances that cast shadows.
    pub(crate) fn casters(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.numbering.instances.len()).filter(|index| self.scene.instances[*index].casts_shadow)
    }

    /// Whether an instance is ever elsewhere than at first.
    pub(crate) fn moves(&self, index: usize) -> bool {
        self.numbering.instances[index].is_animated
    }

    /// The sun's view of the casters; `None` where it casts no shadows.
    pub(crate) fn sun_view(&self) -> Option<SunView> {
        let sun = self.scene.sun;
        let casters = self.casters().map(|index| self.world_bounds[index]);
        if sun.casts_shadows { SunView::around(sun.to_sun, casters, self.shadow_extent_texels) } else { None }
    }
}

/// What goes into the shared buffers, collected model by model.
struct Arrays<'a> {
    meshes: MeshArrays,
    skins: SkinningArrays,
    materials: MaterialArrays<'a>,
    /// Meshes that are there already.
    known: HashMap<ContentHash, (Mesh, SkinnedMesh)>,
}

impl<'a> Arrays<'a> {
    fn new(skinning: Skinning) -> Self {
        Self {
            meshes: MeshArrays::default(),
            skins: SkinningArrays::new(skinning),
            materials: MaterialArrays::default(),
            known: HashMap::new(),
        }
    }

    fn add(&mut self, model: &'a Model, hash: ContentHash) -> ModelGpu {
        let material_base = self.materials.add(model);
        let new = || {
            let (skin, morphs) = self.skins.add(model);
            (self.meshes.add(model, &morphs), skin)
        };
        let (mesh, skin) = self.known.entry(hash).or_insert_with(new).clone();
        ModelGpu { mesh, skin, material_base }
    }
}

fn gloss(scene: &Scene) -> Vec<Vec<Gloss>> {
    let light = lights::brightness(scene);
    let of_model = |model: &Model| {
        model.materials.iter().map(|material| Gloss::of(material, &model.textures, light)).collect()
    };
    scene.models.iter().map(of_model).collect()
}

/// That each model can be worked on in one dispatch.
fn check_groups(gpu: &Gpu, models: &[ModelGpu]) -> Result<(), GpuError> {
    models.iter().try_for_each(|model| {
        let patches = model.lods.iter().map(|lod| lod.patches.len()).max().unwrap_or(0);
        upload::check_groups(gpu, "patches", patches as u32, &EXTENTS_COMP)?;
        upload::check_groups(gpu, "vertices", model.vertex_count, &SKIN_COMP)
    })
}

fn number(scene: &Scene, models: &[ModelGpu]) -> Numbering {
    let size = |(index, instance): (usize, &Instance)| {
        let (source, model) = (&scene.models[instance.model], &models[instance.model]);
        InstanceSize {
            model: instance.model,
            patches: model.lods.iter().map(|lod| lod.patches.len() as u32).collect(),
            vertices: model.vertex_count,
            is_animated: scene.moves(index),
            palette: source.palette.len() as u32,
            bones: source.bones.len() as u32,
            morphs: source.morphs.len() as u32,
        }
    };
    Numbering::new(&scene.instances.iter().enumerate().map(size).collect::<Vec<_>>())
}

/// The boxes of all instances in their models' spaces; each clip of each model is looked at once.
fn played_bounds(scene: &Scene, cancel: &Cancel) -> Result<Vec<Bounds>, Cancelled> {
    let mut played = PlayedBounds::new(scene);
    let mut of = |index: usize| {
        cancel.check()?;
        Ok(played.of(index))
    };
    (0..scene.instances.len()).map(&mut of).collect()
}
