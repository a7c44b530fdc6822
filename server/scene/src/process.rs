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

/// The generated dragon.
///
/// # Errors
/// None but [`Cancelled`], unless the generator and the importer disagree.
pub fn built_in_dragon(loading: &Loading) -> Result<Model, SceneError> {
    let import = || {
        let bytes = shadecast_dragon::dragon();
        loading.cancel.check()?;
        gltf::from_slice(&bytes, "built-in dragon")
    };
    loading.cancel.check()?;
    loading.cache.try_get_or_compute(&Key::new("dragon", 1), check::model, import)
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
mod tests {
    use super::*;
    use crate::cache::reseal;
    use crate::sound::{effort, exercise};
    use crate::{
        Interpolation, Light, LightKind, ModelLight, MorphDelta, MorphTrack, Texture, Track, TrackValues,
        Wrap, ground,
    };
    use glam::{Quat, Vec3};
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use std::cell::Cell;

    /// An "asset": a file of the names of others; the model's bones are what all of them hold.
    fn importer(calls: &Cell<u32>) -> impl Fn(&Path) -> Result<Imported, SceneError> + '_ {
        move |path| {
            calls.set(calls.get() + 1);
            let read =
                |path: &Path| limits::read_limited(path).map(|bytes| String::from_utf8(bytes).unwrap());
            let own = read(path).map_err(|reason| SceneError::Read { file: "own".into(), reason })?;
            let others =
                own.lines().map(|name| read(&path.with_file_name(name)).unwrap_or_else(|_| "missing".into()));
            let name = [own.replace('\n', " "), others.collect()].concat();
            Ok((Model { name, ..Model::default() }, Warnings::new()))
        }
    }

    struct Folder {
        folder: tempfile::TempDir,
        cache: Cache,
        calls: Cell<u32>,
    }

    impl Folder {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let cache = Cache::new(folder.path().join("cache"));
            let this = Self { folder, cache, calls: Cell::new(0) };
            this.write("a.asset", "b\nc");
            this.write("b", "first");
            this
        }

        fn write(&self, name: &str, text: &str) {
            std::fs::write(self.folder.path().join(name), text).unwrap();
        }

        /// What the import says, and whether the importer had to be asked.
        fn import(&self) -> (String, bool) {
            let before = self.calls.get();
            let path = self.folder.path().join("a.asset");
            let model = import(&self.cache, &path, importer(&self.calls)).unwrap();
            (model.name, self.calls.get() > before)
        }
    }

    #[test]
    fn an_asset_is_imported_once() {
        let folder = Folder::new();
        assert_eq!(folder.import(), ("b cfirstmissing".into(), true));
        assert_eq!(folder.import(), ("b cfirstmissing".into(), false));
        assert_eq!(folder.cache.hits_and_misses(), (1, 1));
    }

    #[test]
    fn a_changed_asset_or_companion_file_is_noticed() {
        let folder = Folder::new();
        folder.import();
        folder.write("b", "second");
        assert_eq!(folder.import(), ("b csecondmissing".into(), true));
        folder.write("c", "there now");
        assert_eq!(folder.import(), ("b csecondthere now".into(), true));
        folder.write("b", "first");
        std::fs::remove_file(folder.folder.path().join("c")).unwrap();
        assert_eq!(folder.import(), ("b cfirstmissing".into(), false));
        folder.write("a.asset", "b");
        assert_eq!(folder.import(), ("bfirst".into(), true));
    }

    #[test]
    fn a_missing_asset_is_the_importers_to_complain_about() {
        let folder = tempfile::tempdir().unwrap();
        let (cache, calls) = (Cache::new(folder.path()), Cell::new(0));
        let missing = folder.path().join("missing.asset");
        assert!(import(&cache, &missing, importer(&calls)).is_err());
        assert_eq!((calls.get(), cache.hits_and_misses()), (1, (0, 0)));
    }

    #[test]
    fn a_refined_model_is_the_same_from_the_cache() {
        let folder = tempfile::tempdir().unwrap();
        let refined = |cache: Cache, longest_edge_m| {
            let mut model = ground::ground(8.0);
            model.name = "ground".into();
            let loading = Loading::complete(cache);
            refine(&mut model, longest_edge_m, &loading).expect("nobody asks to end").expect("asked for");
            (postcard::to_stdvec(&model).unwrap(), loading.cache.hits_and_misses())
        };
        let cached = || Cache::new(folder.path());
        let (plain, _) = refined(Cache::disabled(), Some(0.4));
        assert_eq!(refined(cached(), Some(0.4)), (plain.clone(), (0, 1)));
        assert_eq!(refined(cached(), Some(0.4)), (plain.clone(), (1, 0)));
        let (coarser, figures) = refined(cached(), Some(0.6));
        assert!(coarser.len() < plain.len() && figures == (0, 1));
    }

    /// A ground that swings on one bone.
    fn swinging_ground() -> Model {
        let mut model = ground::ground(4.0);
        let turn = |key: u16| Quat::from_rotation_z(0.3 * f32::from(key).sin());
        let track = Track {
            bone: 0,
            times_s: (0..8u16).map(|key| f32::from(key) * 0.25).collect(),
            interpolation: Interpolation::Linear,
            values: TrackValues::Rotation((0..8).map(turn).collect()),
        };
        model.clips = vec![Clip { duration_s: 1.75, tracks: vec![track], ..Clip::default() }];
        model
    }

    #[test]
    fn cancelled_work_on_a_model_keeps_nothing_half_done() {
        let folder = tempfile::tempdir().unwrap();
        let work = |cancel: &Cancel| {
            let loading = Loading::complete(Cache::new(folder.path())).until(cancel);
            let mut model = swinging_ground();
            refine(&mut model, Some(0.4), &loading)?;
            sampled(&model, Some(0), Sampling::default(), &loading)
        };
        let entries = || std::fs::read_dir(folder.path()).map_or(0, Iterator::count);
        let (mut look, mut looks) = (0, 0);
        while let Err(Cancelled) = work(&Cancel::at_look(look)) {
            // The refined model is kept once it is complete, the sampled clip is not yet.
            assert!(entries() <= 1, "look {look}");
            looks += 1;
            look += 1 + look / 4;
        }
        assert!(looks > 10, "looked at {looks} times");
        assert_eq!(entries(), 2);
    }

    /// Everything that a model can have, in small.
    fn rich() -> Model {
        let mut model = swinging_ground();
        let delta = MorphDelta { vertex: 3, position: Vec3::Y, normal: Vec3::ZERO, tangent: Vec3::ZERO };
        let rest_weight = 0.25;
        model.morphs = vec![Morph { name: "up".into(), rest_weight, deltas: vec![delta] }];
        model.clips[0].morph_tracks = vec![MorphTrack {
            first_morph: 0,
            morph_count: 1,
            times_s: vec![0.0, 1.5],
            interpolation: Interpolation::CubicSpline,
            weights: vec![0.0, 0.0, 1.0, 0.0, 1.0, 0.0],
        }];
        let wrap = [Wrap::Repeat; 2];
        let texture =
            Texture { name: "t".into(), extent_texels: [2, 2], rgba8: vec![9; 16], srgb: true, wrap };
        model.textures = vec![texture];
        model.materials[0].base_color_texture = Some(0.into());
        let kind = LightKind::Spot { inner_cone_rad: 0.1, outer_cone_rad: 0.5 };
        let light = Light { name: "l".into(), kind, intensity: Vec3::ONE, range_m: Some(3.0) };
        model.lights = vec![ModelLight { bone: 0, light }];
        model
    }

    /// Import, refinement and sampling, through the cache, and then a use of what came of it.
    fn load_rich(asset: &Path, cache: Cache) -> (Model, SampledClip) {
        let loading = Loading::complete(cache);
        let importer = |path: &Path| {
            limits::read_limited(path).map_err(|reason| SceneError::Read { file: "own".into(), reason })?;
            Ok((rich(), Warnings::new()))
        };
        let mut model = import(&loading.cache, asset, importer).expect("it imports");
        refine(&mut model, Some(0.7), &loading).expect("nobody asks to end");
        let clip = sampled(&model, Some(0), Sampling::default(), &loading).expect("nobody asks to end");
        (model, clip)
    }

    fn entries(folder: &Path) -> Vec<PathBuf> {
        let mut found: Vec<PathBuf> =
            std::fs::read_dir(folder).unwrap().map(|item| item.unwrap().path()).collect();
        found.sort();
        found
    }

    /// A few bytes changed, taken out or put in.
    fn edit(rng: &mut SmallRng, payload: &mut Vec<u8>) {
        for _ in 0..rng.random_range(1..4) {
            payload.resize(payload.len().max(1), 0);
            let at = rng.random_range(0..payload.len());
            match rng.random_range(0..6) {
                0 => payload[at] ^= 1 << rng.random_range(0..8),
                1 => payload[at] = rng.random(),
                2 => payload[at] = 0xff,
                3 => payload[at] = 0,
                4 => drop(payload.remove(at)),
                _ => payload.insert(at, rng.random()),
            }
        }
    }

    #[test]
    fn forged_cache_entries_are_sound_or_rebuilt() {
        let folder = tempfile::tempdir().unwrap();
        let (asset, cache) = (folder.path().join("a.asset"), folder.path().join("cache"));
        std::fs::write(&asset, "a").unwrap();
        let uncached = load_rich(&asset, Cache::disabled());
        assert_eq!(load_rich(&asset, Cache::new(&cache)).1, uncached.1);
        let whole: Vec<(PathBuf, Vec<u8>)> =
            entries(&cache).into_iter().map(|path| (path.clone(), std::fs::read(path).unwrap())).collect();
        assert_eq!(whole.len(), 4, "files, asset, refined, clip");
        let mut made_anew = 0;
        for seed in 0..80 * u64::from(effort()) {
            let mut rng = SmallRng::seed_from_u64(seed);
            for path in entries(&cache) {
                std::fs::remove_file(path).unwrap();
            }
            whole.iter().for_each(|(path, bytes)| std::fs::write(path, bytes).unwrap());
            let (path, bytes) = &whole[rng.random_range(0..whole.len())];
            reseal(path, |payload| edit(&mut rng, payload));
            let damaged = std::fs::read(path).unwrap();
            let (model, clip) = load_rich(&asset, Cache::new(&cache));
            let context = format!("seed {seed}, {}", path.display());
            assert_eq!(check::model(&model), Ok(()), "{context}");
            assert_eq!(check::sampled_clip(&clip, &model, Some(0)), Ok(()), "{context}");
            exercise(&model);
            let now = std::fs::read(path).unwrap();
            if now != damaged {
                assert_eq!(now, *bytes, "{context}: what was made anew is what there was");
                made_anew += 1;
            }
        }
        assert!(made_anew > 20, "{made_anew} entries were refused");
    }
}
