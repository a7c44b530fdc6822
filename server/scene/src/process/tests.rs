use super::*;
use crate::cache::reseal;
use crate::sound::{effort, exercise};
use crate::{
    Interpolation, Light, LightKind, ModelLight, MorphDelta, MorphTrack, Texture, Track, TrackValues, Wrap,
    ground,
};
use glam::{Quat, Vec3};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use std::cell::Cell;

/// An "asset": a file of the names of others; the model's bones are what all of them hold.
fn importer(calls: &Cell<u32>) -> impl Fn(&Path) -> Result<Imported, SceneError> + '_ {
    move |path| {
        calls.set(calls.get() + 1);
        let read = |path: &Path| limits::read_limited(path).map(|bytes| String::from_utf8(bytes).unwrap());
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
    let texture = Texture { name: "t".into(), extent_texels: [2, 2], rgba8: vec![9; 16], srgb: true, wrap };
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
