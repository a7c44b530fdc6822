use super::*;
use crate::animation::sampling::{KeyInterpolation, Sampling};
use crate::animation::test_models::{INTERPOLATIONS, one_bone, random_rotation, random_track, random_vector};
use crate::{
    Bone, Clip, Interpolation, Morph, MorphDelta, MorphTrack, PaletteEntry, Track, TrackValues, Trs, Vertex,
};
use glam::Quat;
use rand::{Rng, SeedableRng, rngs::SmallRng};
use std::f32::consts::TAU;

/// The model's first clip.
fn sampled(model: &Model, bound_m: f32, range_share: f32) -> SampledClip {
    sample(model, Some(0), [bound_m, range_share], &Cancel::default()).expect("nobody asks to end")
}

/// The largest distance of any vertex at any of some times, metres.
fn largest_error(model: &Model, clip: &SampledClip, times_s: impl Iterator<Item = f64>) -> f32 {
    let vertices: Vec<u32> = (0..model.vertices.len() as u32).collect();
    let mut largest = 0.0f32;
    for t in times_s {
        let (truth, found) =
            (VertexInputs::of_source(model, Some(0), t), VertexInputs::of_samples(model, clip, t));
        distances(model, &truth, &found, &vertices, |_, distance| largest = largest.max(distance));
    }
    largest
}

/// A chain or tree of bones, all of which swing smoothly, with skinned vertices around each, and a morph target.
fn random_creature(rng: &mut SmallRng, bone_count: u32) -> Model {
    let mut model = Model::default();
    let mut tracks = Vec::new();
    for bone in 0..bone_count {
        let parent = (bone > 0).then(|| rng.random_range(bone.saturating_sub(3)..bone));
        let rest = Trs { translation: random_vector(rng) * 0.2, ..Trs::IDENTITY };
        model.bones.push(Bone { name: format!("b{bone}"), parent, rest });
        model.palette.push(PaletteEntry { bone, bone_from_mesh: Affine3A::IDENTITY });
        for _ in 0..4 {
            let joints = [bone as u16, rng.random_range(0..=bone) as u16, 0, 0];
            let weight = rng.random_range(0.5..1.0);
            let position = random_vector(rng) * 0.1;
            model.vertices.push(Vertex {
                position,
                joints,
                weights: [weight, 1.0 - weight, 0.0, 0.0],
                ..Vertex::default()
            });
        }
        tracks.push(swinging(rng, bone));
    }
    let delta =
        |vertex| MorphDelta { vertex, position: Vec3::Y * 0.3, normal: Vec3::ZERO, tangent: Vec3::ZERO };
    model.morphs.push(Morph { name: "m".into(), rest_weight: 0.0, deltas: (0..3).map(delta).collect() });
    let times_s: Vec<f32> = (0..=60).map(|key| key as f32 / 30.0).collect();
    let weights = times_s.iter().map(|t| 0.5 - 0.5 * (TAU * t / 2.0).cos()).collect();
    let interpolation = Interpolation::Linear;
    let morph_tracks = vec![MorphTrack { first_morph: 0, morph_count: 1, times_s, interpolation, weights }];
    model.clips.push(Clip { name: "c".into(), duration_s: 2.0, tracks, morph_tracks });
    model
}

fn swinging(rng: &mut SmallRng, bone: u32) -> Track {
    let times_s: Vec<f32> = (0..=120).map(|key| key as f32 / 60.0).collect();
    let (axis, phase, hz) =
        (random_vector(rng).normalize(), rng.random_range(0.0..TAU), rng.random_range(1..3));
    let start = random_rotation(rng);
    let turn = |t: &f32| start * Quat::from_axis_angle(axis, 0.5 * (TAU * hz as f32 * t / 2.0 + phase).sin());
    let values = TrackValues::Rotation(times_s.iter().map(turn).collect());
    Track { bone, times_s, interpolation: Interpolation::Linear, values }
}

#[test]
fn random_creatures_stay_within_the_bound() {
    let mut rng = SmallRng::seed_from_u64(31);
    for case in 0..6 {
        let count = rng.random_range(2..14);
        let model = random_creature(&mut rng, count);
        for bound_m in [1e-2, 1e-3, 1e-4] {
            let clip = sampled(&model, bound_m, 1.0);
            // Source keys, and between them.
            let error = largest_error(&model, &clip, (0..=480).map(|step| f64::from(step) / 240.0));
            assert!(error <= bound_m * 1.02, "seed 31, case {case}: {error} m beyond {bound_m} m");
        }
    }
}

#[test]
fn random_curves_of_every_interpolation_are_kept_within_the_bound() {
    let mut rng = SmallRng::seed_from_u64(32);
    for case in 0..120 {
        let mut model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], case / 3 % 3));
        model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
        model.vertices =
            (0..8).map(|_| Vertex { position: random_vector(&mut rng), ..Vertex::default() }).collect();
        let clip = sampled(&model, 1e-3, 1.0);
        let times: Vec<f64> = model.clips[0].tracks[0].times_s.iter().map(|time| f64::from(*time)).collect();
        // The keys, and places between neighbours: but for splines, whose tangents break at their keys here.
        let parts = if INTERPOLATIONS[case % 3] == Interpolation::CubicSpline { 1 } else { 12 };
        let between = times.windows(2).flat_map(|pair| {
            (1..parts).map(move |part| pair[0] + (pair[1] - pair[0]) * f64::from(part) / f64::from(parts))
        });
        let error = largest_error(&model, &clip, times.iter().copied().chain(between));
        assert!(error <= 1.05e-3, "seed 32, case {case}: {error} m");
    }
}

#[test]
fn first_and_last_key_are_the_clips_ends_exactly() {
    let mut rng = SmallRng::seed_from_u64(33);
    let model = random_creature(&mut rng, 8);
    let clip = sampled(&model, 1e-3, 1.0);
    let (first, last) = (pose::source_pose(&model, Some(0), 0.0), pose::source_pose(&model, Some(0), 2.0));
    for (bone, [_, rotation, _]) in clip.bones.iter().enumerate() {
        for (key, truth) in [(0, first[bone].rotation), (rotation.values.len() - 1, last[bone].rotation)] {
            let found = Quat::from_vec4(rotation.values[key]);
            assert!(found == truth || -found == truth, "seed 33, bone {bone}: {found} instead of {truth}");
        }
        assert_eq!(rotation.times_s.last(), Some(&2.0), "seed 33, bone {bone}");
    }
}

#[test]
fn linear_source_is_reproduced_with_its_own_keys() {
    let corners = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 2.0, 0.0), Vec3::NEG_Y, Vec3::ZERO];
    let times_s = vec![0.0, 0.3, 1.1, 1.9, 4.0];
    let values = TrackValues::Translation(corners.to_vec());
    let mut model =
        one_bone(Track { bone: 0, times_s: times_s.clone(), interpolation: Interpolation::Linear, values });
    model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
    model.vertices = vec![Vertex::default()];
    let clip = sampled(&model, 1e-4, 1.0);
    let track = &clip.bones[0][0];
    assert_eq!((track.interpolation, &track.times_s), (KeyInterpolation::Linear, &times_s));
    let differ = |(a, b): (&glam::Vec4, Vec3)| !a.abs_diff_eq(b.extend(0.0), 1e-6);
    assert!(!track.values.iter().zip(corners).any(differ), "{:?}", track.values);
}

#[test]
fn interpolation_with_the_fewest_keys_is_chosen() {
    let of = |values: fn(f32) -> f32, interpolation| {
        let times_s: Vec<f32> = (0..=120).map(|key| key as f32 / 60.0).collect();
        let values = TrackValues::Translation(times_s.iter().map(|t| Vec3::X * values(*t)).collect());
        let mut model = one_bone(Track { bone: 0, times_s, interpolation, values });
        model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
        model.vertices = vec![Vertex::default()];
        sampled(&model, 1e-4, 1.0).bones[0][0].clone()
    };
    // The straight lines between the source's keys are 27 micrometres beside the sine.
    let sine = of(|t| 0.02 * (TAU * t).sin(), Interpolation::Linear);
    assert_eq!(sine.interpolation, KeyInterpolation::Cubic);
    assert!(sine.values.len() <= 20, "{} keys", sine.values.len());
    let ramp = of(|t| t, Interpolation::Linear);
    assert_eq!((ramp.interpolation, ramp.values.len()), (KeyInterpolation::Linear, 2));
    let blink = of(|t| if (0.5..0.7).contains(&t) { 1.0 } else { 0.0 }, Interpolation::Step);
    assert_eq!((blink.interpolation, blink.values.len()), (KeyInterpolation::Step, 3));
    let still = of(|t| 1e-6 * (TAU * t).sin(), Interpolation::Linear);
    assert_eq!(still.values.len(), 1);
}

#[test]
fn wide_turns_between_keys_are_followed_in_every_quarter() {
    let turns = [0.0, 2.5, 0.3, 2.9].map(Quat::from_rotation_z);
    let values = TrackValues::Rotation(turns.to_vec());
    let times_s = vec![0.0, 1.0, 2.0, 3.0];
    let mut model = one_bone(Track { bone: 0, times_s, interpolation: Interpolation::Linear, values });
    model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
    model.vertices = vec![Vertex { position: Vec3::X, ..Vertex::default() }];
    let clip = sampled(&model, 1e-4, 1.0);
    let error = largest_error(&model, &clip, (0..=3000).map(|ms| f64::from(ms) * 1e-3));
    assert!(error <= 1.05e-4, "{error} m");
}

#[test]
fn share_of_range_bounds_curves_that_hardly_move_a_vertex() {
    let mut rng = SmallRng::seed_from_u64(34);
    let mut model = one_bone(swinging(&mut rng, 0));
    model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
    model.vertices = vec![Vertex { position: Vec3::X * 1e-4, ..Vertex::default() }];
    let worst = |share: f32| {
        let clip = sampled(&model, 1e-2, share);
        let angle = |step: u32| {
            let t = f64::from(step) / 120.0;
            pose::source_pose(&model, Some(0), t)[0].rotation.angle_between(clip.local_pose(t)[0].rotation)
        };
        (0..=240).map(angle).fold(0.0, f32::max)
    };
    // The swing has a range of 1 radian.
    assert!(worst(0.002) <= 0.0025, "{}", worst(0.002));
    assert!(worst(1.0) > 0.1, "{}", worst(1.0));
}

#[test]
fn dragon_keeps_its_bound_with_a_third_of_the_bytes_of_its_source() {
    let model = crate::gltf::from_slice(&shadecast_dragon::dragon(), "dragon").expect("built in");
    let clip = super::super::sample(&model, Some(0), Sampling::default());
    let error = largest_error(&model, &clip, (0..=68).map(|step| f64::from(step) / 17.0));
    assert!(error <= 1.02e-4, "{error} m");
    // Its curves have 60 keys a second, which a constant interval of a 60th keeps.
    let source = super::super::sample(&model, Some(0), Sampling::Constant { interval_s: 1.0 / 60.0 });
    let share = clip.byte_count() as f32 / source.byte_count() as f32;
    assert!(share < 0.4, "{} of {} bytes", clip.byte_count(), source.byte_count());
}

/// A hand that goes to and fro in straight lines: the smooth curve through its corners and the middles between them
/// leaves the lines everywhere else.
#[test]
fn cubic_through_points_of_straight_lines_is_not_taken_for_them() {
    let mut rng = SmallRng::seed_from_u64(35);
    for case in 0..40 {
        let times_s: Vec<f32> = (0..=24).map(|key| key as f32 / 24.0).collect();
        let height = |key: u32| if key.is_multiple_of(2) { 0.0 } else { rng.random_range(0.8..1.0f32) };
        let values = TrackValues::Translation((0..=24).map(height).map(|y| Vec3::Y * y).collect());
        let mut model = one_bone(Track { bone: 0, times_s, interpolation: Interpolation::Linear, values });
        model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
        model.vertices = vec![Vertex::default()];
        for bound_m in [1e-4, 1e-2, 5e-2, 0.1] {
            let clip = sampled(&model, bound_m, 1.0);
            let error = largest_error(&model, &clip, (0..=960).map(|step| f64::from(step) / 960.0));
            assert!(error <= bound_m * 1.05, "seed 35, case {case}: {error} m beyond {bound_m} m");
        }
    }
}

#[test]
fn looser_bounds_never_take_more_keys_or_bytes() {
    let mut rng = SmallRng::seed_from_u64(36);
    for case in 0..4 {
        let model = random_creature(&mut rng, 12);
        let mut least: HashMap<u32, (usize, usize)> = HashMap::new();
        for bound_m in [1e-4, 2e-4, 5e-4, 1e-3, 2e-3] {
            let mut of_stricter: Option<(usize, usize)> = None;
            for (number, share) in [0.002, 0.02, 1.0].into_iter().enumerate() {
                let clip = sampled(&model, bound_m, share);
                let now = (clip.key_count(), clip.byte_count());
                for stricter in least.get(&(number as u32)).into_iter().chain(&of_stricter) {
                    assert!(
                        now.1 <= stricter.1,
                        "seed 36, case {case}, {bound_m} m, {share}: {now:?} {stricter:?}"
                    );
                }
                least.insert(number as u32, now);
                of_stricter = Some(now);
            }
        }
    }
}

/// Real models: each clip is kept within the bound, at all times that sampling looks at and between them.
#[test]
fn clips_of_real_models_are_kept_within_their_bound() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets");
    let Ok(files) = std::fs::read_dir(&folder) else {
        eprintln!("SKIPPED: no real models in {}", folder.display());
        return;
    };
    let mut paths: Vec<_> = files.filter_map(|file| Some(file.ok()?.path())).collect();
    paths.retain(|path| {
        path.extension().is_some_and(|e| ["glb", "gltf", "fbx"].iter().any(|kind| e == *kind))
    });
    // What the importer refuses, its own tests say.
    paths.retain(|path| !path.to_string_lossy().ends_with("-draco.glb"));
    paths.sort();
    let mut clips = 0;
    for path in paths {
        let scene = crate::load::load_scene(&crate::load::SceneSource::File(path.clone())).expect("it loads");
        for (index, model) in scene.models.iter().enumerate() {
            for clip in 0..model.clips.len() {
                assert_kept(model, clip, super::super::world_scale(&scene, index), &path);
                clips += 1;
            }
        }
    }
    assert!(clips > 0, "{} has no clips", folder.display());
}

#[track_caller]
fn assert_kept(model: &Model, clip: usize, world_scale: f32, path: &std::path::Path) {
    for bound_m in [1e-4, 1e-3].map(|bound_m| bound_m / world_scale) {
        let what = format!("{}, clip {clip}, within {bound_m}", path.display());
        let bounds = [bound_m, super::super::DEFAULT_RANGE_SHARE];
        let Found { clip: found, is_kept } =
            find(model, Some(clip), bounds, &Cancel::default()).expect("nobody asks to end");
        assert!(is_kept, "{what}: given up");
        let moves = pose::animated_vertices(model, Some(clip));
        let vertices: Vec<u32> = (0..moves.len() as u32).filter(|v| moves[*v as usize]).step_by(3).collect();
        for step in 0..600 {
            let t = f64::from(found.duration_s) * (f64::from(step) + 0.37) / 600.0;
            let truth = VertexInputs::of_source(model, Some(clip), t);
            let at = VertexInputs::of_samples(model, &found, t);
            distances(model, &truth, &at, &vertices, |vertex, distance_m| {
                assert!(distance_m <= 1.05 * bound_m, "{what}: vertex {vertex} at {t} s: {distance_m}");
            });
        }
    }
}
