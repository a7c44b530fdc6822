//! Clips as clients get them, against those that the server has.

use super::*;
use crate::scene::numbering::InstanceSize;
use glam::Vec4;
use shadecast_protocol::motion::clip::{ClipChunk, chunk_at};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::process::Loading;
use std::path::Path as FilePath;

/// Farthest that a vertex may be from where the server has it because of how its keys are sent, metres in the world.
const BOUND_M: f32 = 2e-5;
/// Phases of a clip that are looked at.
const PHASES: u32 = 50;

struct Sent {
    scene: Scene,
    manager: AnimationManager,
    library: MotionLibrary,
}

impl Sent {
    fn new(source: &SceneSource) -> Self {
        let scene = load_scene(source).unwrap();
        let manager = AnimationManager::new(&scene, Sampling::default(), &Loading::plain()).unwrap();
        let size = |(index, instance): (usize, &shadecast_scene::Instance)| {
            let model = &scene.models[instance.model];
            InstanceSize {
                model: instance.model,
                patches: vec![1],
                vertices: model.vertices.len() as u32,
                is_animated: scene.moves(index),
                palette: model.palette.len() as u32,
                bones: model.bones.len() as u32,
                morphs: model.morphs.len() as u32,
            }
        };
        let numbering = Numbering::new(&scene.instances.iter().enumerate().map(size).collect::<Vec<_>>());
        let library = MotionLibrary::new(&scene, &manager, &numbering, MotionOption::Clip);
        Self { scene, manager, library }
    }

    /// A chunk as it is sent, and its bytes.
    fn message(&self, clip: ClipId, index: u32) -> (ClipChunk, Vec<u8>) {
        let chunk = ClipChunk { clip, index, first_word: 64, tracks: self.library.chunk(clip, index) };
        let news = MotionNews::Chunk(chunk.clone());
        (chunk, MotionMessage { sequence: 0, news }.encode())
    }

    /// A chunk as it arrives, as a clip in the order of the model.
    fn arrived(&self, clip: ClipId, index: u32) -> SampledClip {
        let MotionNews::Chunk(chunk) = MotionMessage::decode(&self.message(clip, index).1).unwrap().news
        else {
            panic!("a chunk is no longer one");
        };
        let LibraryClip { sampled, old_of_new, info, .. } = &self.library.clips[clip.index()];
        let mut tracks = chunk.tracks.into_iter().map(sampled_track);
        let mut bones = sampled.bones.clone();
        for old in old_of_new.iter() {
            bones[*old as usize] = std::array::from_fn(|_| tracks.next().unwrap());
        }
        SampledClip { duration_s: info.duration_s, bones, morphs: tracks.collect() }
    }

    /// The largest distance of a vertex from where the server has it, metres in the world, in any clip of a model.
    fn worst_m(&self, model: usize) -> f32 {
        let clips = self.manager.materials[model].clips.iter();
        clips.map(|clip| self.worst_of_clip_m(model, ClipId(*clip as u32))).fold(0.0, f32::max)
    }

    fn worst_of_clip_m(&self, model: usize, clip: ClipId) -> f32 {
        let (duration_s, scale) = (self.library.clip(clip).duration_s, world_scale(&self.scene, model));
        let chunks: Vec<_> = (0..chunk_count(duration_s)).map(|index| self.arrived(clip, index)).collect();
        let of_server = &self.library.clips[clip.index()].sampled;
        let mut worst_m = 0.0f32;
        for phase in 0..=PHASES {
            let at_s = f64::from(duration_s) * f64::from(phase) / f64::from(PHASES);
            let of_client = &chunks[chunk_at(at_s, duration_s) as usize];
            let [expected, found] =
                [of_server, of_client].map(|clip| positions(&self.scene.models[model], clip, at_s));
            let distances = expected.iter().zip(&found).map(|(a, b)| scale * a.distance(*b));
            worst_m = distances.fold(worst_m, f32::max);
        }
        worst_m
    }

    /// Bytes of all chunks of all clips of a model that play.
    fn bytes(&self, model: usize) -> usize {
        let clips = self.manager.materials[model].clips.iter().skip(1).map(|clip| ClipId(*clip as u32));
        let of = |clip: ClipId| -> usize {
            let chunks = 0..chunk_count(self.library.clip(clip).duration_s);
            chunks.map(|index| self.message(clip, index).1.len()).sum()
        };
        clips.map(of).sum()
    }
}

fn sampled_track(track: ChunkTrack) -> SampledTrack {
    let numbers = |numbers: Vec<[f32; 4]>| numbers.into_iter().map(Vec4::from).collect();
    SampledTrack {
        interpolation: match track.kind {
            TrackKind::Step => KeyInterpolation::Step,
            TrackKind::Linear => KeyInterpolation::Linear,
            TrackKind::Cubic => KeyInterpolation::Cubic,
        },
        interval_s: 0.0,
        times_s: track.times_s,
        values: numbers(track.values),
        tangents: numbers(track.tangents),
    }
}

/// The vertices of a model in its own space.
fn positions(model: &Model, clip: &SampledClip, at_s: f64) -> Vec<glam::Vec3> {
    let palette = pose::palette(model, &pose::global_pose(model, &clip.local_pose(at_s)));
    let vertices = pose::morphed(model, &clip.morph_weights(at_s));
    let at = |vertex: &shadecast_scene::Vertex| {
        pose::blend(&palette, vertex.joints, vertex.weights).transform_point3(vertex.position)
    };
    vertices.iter().map(at).collect()
}

/// Real models, where they are there; the project ships none.
fn assets(names: &[&str]) -> Vec<SceneSource> {
    let folder = FilePath::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/assets");
    let paths = names.iter().map(|name| folder.join(name));
    let (there, missing): (Vec<_>, Vec<_>) = paths.partition(|path| path.exists());
    missing.iter().for_each(|path| eprintln!("SKIPPED: no {}", path.display()));
    there.into_iter().map(SceneSource::File).collect()
}

#[track_caller]
fn assert_exact(source: &SceneSource) -> usize {
    let sent = Sent::new(source);
    let moving = (0..sent.scene.models.len()).filter(|model| !sent.scene.models[*model].clips.is_empty());
    let mut bytes = 0;
    for model in moving {
        let worst_m = sent.worst_m(model);
        bytes += sent.bytes(model);
        println!("{source:?}: {bytes} bytes, at most {:.2} um off", worst_m * 1e6);
        assert!(worst_m <= BOUND_M, "{source:?}: {worst_m} m");
        assert!(worst_m > 0.0, "nothing was rounded: the test shows nothing");
    }
    bytes
}

#[test]
fn the_keys_of_a_dragon_are_exact_and_small() {
    let bytes = assert_exact(&SceneSource::Dragons(1));
    assert!(bytes < 70_000, "{bytes} bytes of keys: in single precision they are 174,632");
}

#[test]
fn the_keys_of_real_models_are_exact() {
    let names = ["Fox.glb", "CesiumMan.glb", "RiggedSimple.glb", "MorphStressTest.gltf"];
    for source in assets(&names) {
        assert_exact(&source);
    }
}

#[test]
fn words_are_known_before_a_chunk_is_cut() {
    let sent = Sent::new(&SceneSource::Dragons(1));
    for clip in (0..sent.library.clips.len()).map(|clip| ClipId(clip as u32)) {
        for index in 0..chunk_count(sent.library.clip(clip).duration_s) {
            let (chunk, _) = sent.message(clip, index);
            assert_eq!(sent.library.chunk_words(clip, index), chunk.words(), "chunk {index} of {clip:?}");
        }
    }
}

#[test]
fn chunks_arrive_as_they_were_cut_and_have_the_same_of_the_keys_that_they_share() {
    let sent = Sent::new(&SceneSource::Dragons(1));
    let clip = ClipId(sent.manager.materials[sent.scene.instances[0].model].clips[1] as u32);
    // By curve and time.
    let mut known = HashMap::new();
    let mut shared = 0;
    for index in 0..chunk_count(sent.library.clip(clip).duration_s) {
        let (chunk, bytes) = sent.message(clip, index);
        let news = MotionMessage::decode(&bytes).unwrap().news;
        assert_eq!(news, MotionNews::Chunk(chunk.clone()), "chunk {index}");
        for (number, track) in chunk.tracks.iter().enumerate().filter(|(_, track)| track.values.len() > 1) {
            for (key, time_s) in track.times_s.iter().enumerate() {
                let now = (track.values[key], track.tangents.get(key).copied());
                shared += usize::from(known.contains_key(&(number, time_s.to_bits())));
                assert_eq!(*known.entry((number, time_s.to_bits())).or_insert(now), now, "track {number}");
            }
        }
    }
    assert!(shared > 1000, "{shared} keys are in more than one chunk");
}
