//! From an asset to a model ready for display, each expensive step through the [`Cache`].
//!
//! There are two steps, because the second depends on the model's size in the scene: the import (files to curves, vertices and
//! texels), and its [refinement](refine) (long edges split, coarser LODs, patches).

use crate::animation::sampling::{SampledClip, Sampling, sample_until};
use crate::cache::{Cache, Key};
use crate::cancel::{Cancel, Cancelled};
use crate::check::{self, Unsound};
use crate::error::SceneError;
use crate::import::{self, Warnings};
use crate::limits::{self, Note};
use crate::patches::Patches;
use crate::references::Folder;
use crate::split::{SplitStats, split_until};
use crate::{Bone, Clip, Lod, Material, Model, Morph, PaletteEntry, Primitive, Vertex, bulk, gltf, lod};
use serde::{Deserialize, Serialize};
use shadecast_dragon::BuiltIn;
use std::path::{Path, PathBuf};

/// How scenes are loaded.
#[derive(Clone, Debug)]
pub struct Loading {
    /// Where expensive results are kept.
    pub cache: Cache,
    /// Whether coarser levels of detail are made.
    pub lods: bool,
    /// Ends loading soon after it was asked, with [`Cancelled`].
    pub cancel: Cancel,
}

impl Loading {
    /// Nothing is kept, and no coarser levels are made: for tests, and for programs that need only the full detail.
    pub fn plain() -> Self {
        Self { cache: Cache::disabled(), lods: false, cancel: Cancel::default() }
    }

    /// Everything, kept in `cache`.
    pub fn complete(cache: Cache) -> Self {
        Self { cache, lods: true, cancel: Cancel::default() }
    }

    /// The same until `cancel` is asked.
    #[must_use]
    pub fn until(self, cancel: &Cancel) -> Self {
        Self { cancel: cancel.clone(), ..self }
    }
}

/// A generated model.
///
/// # Errors
/// None but [`Cancelled`], unless the generator and the importer disagree.
pub fn built_in(model: BuiltIn, loading: &Loading) -> Result<Model, SceneError> {
    let import = || {
        let bytes = model.glb();
        loading.cancel.check()?;
        gltf::from_slice(&bytes, &format!("built-in {}", model.name()))
    };
    loading.cancel.check()?;
    loading.cache.try_get_or_compute(&Key::new("built-in", 1).value(&model.name()), check::model, import)
}

/// What an importer makes, with what it has to say about it at every start.
type Imported = (Model, Warnings);

/// The model that an importer makes of a file and of those that the file refers to.
///
/// # Errors
/// The importer's.
pub(crate) fn import(
    cache: &Cache,
    path: &Path,
    importer: impl FnOnce(&Path) -> Result<Imported, SceneError>,
) -> Result<Model, SceneError> {
    let (model, warnings) = imported(cache, path, importer)?;
    import::report(&warnings, &path.display().to_string());
    Ok(model)
}

fn imported(
    cache: &Cache,
    path: &Path,
    importer: impl FnOnce(&Path) -> Result<Imported, SceneError>,
) -> Result<Imported, SceneError> {
    // A file that cannot be read is the importer's to complain about.
    let readable = if cache.folder().is_some() { Asset::read(path) } else { None };
    let Some(asset) = readable else { return importer(path) };
    let known: Option<Vec<Reference>> = cache.find(&asset.files_key(), |_| Ok(()));
    let key = known.map(|files| asset.key(files.iter().map(|file| (file, asset.hash_of(file)))));
    if let Some(known) = key.and_then(|key| cache.find(&key, check_imported)) {
        cache.count_hit();
        return Ok(known);
    }
    let (result, notes) = limits::noting_files(|| importer(path));
    let imported = result?;
    cache.count_miss();
    asset.keep(cache, notes, &imported);
    Ok(imported)
}

/// A file to be imported.
struct Asset {
    path: PathBuf,
    folder: Folder,
    hash: [u8; 32],
}

/// A file that an asset asked for, by its name in the asset's folder, and how much of it.
type Reference = (PathBuf, u64);

impl Asset {
    fn read(path: &Path) -> Option<Self> {
        let hash = limits::hash_start(path, limits::MAX_FILE_BYTES)?;
        Some(Self { path: path.to_owned(), folder: Folder::of(path), hash })
    }

    /// Of the list of files that the asset refers to.
    fn files_key(&self) -> Key {
        Key::new("files", 1).bytes(&self.hash).value(&self.name())
    }

    /// The file's name is the model's, and says which importer it takes.
    fn name(&self) -> String {
        self.path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// Of what a file holds now, found by the rule by which the importer finds it.
    fn hash_of(&self, (name, most_bytes): &Reference) -> Option<[u8; 32]> {
        let found = self.folder.find(name.to_str()?).ok()?;
        limits::hash_start(&found.real, *most_bytes)
    }

    fn key<'a>(&self, files: impl Iterator<Item = (&'a Reference, Option<[u8; 32]>)>) -> Key {
        let key = Key::new("asset", 1).bytes(&self.hash).value(&self.name());
        files.fold(key, |key, file| key.value(&file))
    }

    /// Keeps the model under the hashes of what the importer read, whatever the files hold by now.
    fn keep(&self, cache: &Cache, notes: Vec<Note>, imported: &Imported) {
        let (own, others): (Vec<Note>, Vec<Note>) =
            notes.into_iter().partition(|note| note.path == self.path);
        if own.iter().any(|note| note.hash != Some(self.hash)) {
            return; // it changed while it was read
        }
        let inside =
            |path: PathBuf| path.strip_prefix(self.folder.path()).map(Path::to_owned).unwrap_or(path);
        let (files, hashes): (Vec<Reference>, Vec<_>) =
            others.into_iter().map(|note| ((inside(note.path), note.most_bytes), note.hash)).unzip();
        cache.keep(&self.files_key(), &files);
        cache.keep(&self.key(files.iter().zip(hashes)), imported);
    }
}

/// Whether a model that was kept is one that an importer could have made.
fn check_imported((model, _): &Imported) -> Result<(), Unsound> {
    check::model(model)
}

/// What [`refine`] looks at.
#[derive(Serialize)]
struct Unrefined<'a> {
    #[serde(serialize_with = "bulk::serialize")]
    vertices: &'a [Vertex],
    #[serde(serialize_with = "bulk::serialize")]
    indices: &'a [u32],
    primitives: &'a [Primitive],
    morphs: &'a [Morph],
    materials: &'a [Material],
    bones: &'a [Bone],
    palette: &'a [PaletteEntry],
    clips: &'a [Clip],
}

/// What [`refine`] makes.
#[derive(Serialize, Deserialize)]
struct Refined {
    #[serde(with = "bulk")]
    vertices: Vec<Vertex>,
    #[serde(with = "bulk")]
    indices: Vec<u32>,
    primitives: Vec<Primitive>,
    morphs: Vec<Morph>,
    lods: Vec<Lod>,
    patches: Vec<Patches>,
    split: Option<SplitStats>,
}

impl Refined {
    /// Whether it is something that could have been made of `source`.
    fn check(&self, source: &Model) -> Result<(), Unsound> {
        check::Geometry {
            vertices: &self.vertices,
            indices: &self.indices,
            primitives: &self.primitives,
            lods: &self.lods,
            patches: &self.patches,
            morphs: &self.morphs,
            palette: source.palette.len(),
            materials: source.materials.len(),
        }
        .check()?;
        check::same_count(self.morphs.len(), source.morphs.len(), "morph targets")?;
        check::same_count(self.primitives.len(), source.primitives.len(), "primitives")
    }
}

/// Splits edges longer than `longest_edge_m` in mesh space, `None` leaves them; makes coarser levels, where they are
/// wanted, and the patches of all levels.
///
/// # Errors
/// Somebody asked to end; the model is then lost.
pub fn refine(
    model: &mut Model,
    longest_edge_m: Option<f32>,
    loading: &Loading,
) -> Result<Option<SplitStats>, Cancelled> {
    let mut source = std::mem::take(model);
    let unrefined = Unrefined {
        vertices: &source.vertices,
        indices: &source.indices,
        primitives: &source.primitives,
        morphs: &source.morphs,
        materials: &source.materials,
        bones: &source.bones,
        palette: &source.palette,
        clips: &source.clips,
    };
    let is_worth_it = loading.cache.folder().is_some();
    let refined = if is_worth_it {
        let key = Key::new("refined", 2).value(&(longest_edge_m, loading.lods)).value(&unrefined);
        let check = |refined: &Refined| refined.check(&source);
        loading.cache.try_get_or_compute(&key, check, || compute(&source, longest_edge_m, loading))?
    } else {
        compute(&source, longest_edge_m, loading)?
    };
    (source.vertices, source.indices) = (refined.vertices, refined.indices);
    (source.primitives, source.morphs) = (refined.primitives, refined.morphs);
    (source.lods, source.patches) = (refined.lods, refined.patches);
    *model = source;
    Ok(refined.split)
}

/// What sampling a clip looks at.
#[derive(Serialize)]
struct Unsampled<'a> {
    #[serde(serialize_with = "bulk::serialize")]
    vertices: &'a [Vertex],
    morphs: &'a [Morph],
    bones: &'a [Bone],
    palette: &'a [PaletteEntry],
    clip: Option<&'a Clip>,
    sampling: Sampling,
}

/// A clip of the model (`None`: its rest pose) as [`sample`](crate::animation::sampling::sample) makes it, through the
/// cache.
///
/// # Errors
/// Somebody asked to end.
pub fn sampled(
    model: &Model,
    clip: Option<usize>,
    sampling: Sampling,
    loading: &Loading,
) -> Result<SampledClip, Cancelled> {
    let sample = || sample_until(model, clip, sampling, &loading.cancel);
    // A rest pose takes no time.
    if loading.cache.folder().is_none() || clip.is_none() {
        return sample();
    }
    let unsampled = Unsampled {
        vertices: &model.vertices,
        morphs: &model.morphs,
        bones: &model.bones,
        palette: &model.palette,
        clip: clip.map(|clip| &model.clips[clip]),
        sampling,
    };
    let check = |sampled: &SampledClip| check::sampled_clip(sampled, model, clip);
    loading.cache.try_get_or_compute(&Key::new("clip", 1).value(&unsampled), check, sample)
}

fn compute(source: &Model, longest_edge_m: Option<f32>, loading: &Loading) -> Result<Refined, Cancelled> {
    let cancel = &loading.cancel;
    let mut model = source.clone();
    let split = longest_edge_m.map(|longest_m| split_until(&mut model, longest_m, cancel)).transpose()?;
    model.lods = if loading.lods { lod::build(&model, cancel)? } else { Vec::new() };
    let patches = |level: usize| Patches::build(model.triangles(level), cancel);
    let patches = (0..=model.lods.len()).map(patches).collect::<Result<_, _>>()?;
    let Model { vertices, indices, primitives, morphs, lods, .. } = model;
    Ok(Refined { vertices, indices, primitives, morphs, lods, patches, split })
}

#[cfg(test)]
mod tests;
