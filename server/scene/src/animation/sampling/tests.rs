use super::*;
use crate::animation::clip::source_pose;
use crate::animation::test_models::{INTERPOLATIONS, one_bone, random_track};
use crate::load::{SceneSource, load_scene};
use crate::{Instance, Interpolation, MorphTrack, Path, Repetition, Track, TrackValues};
use glam::Vec3;
use rand::{SeedableRng, rngs::SmallRng};

const TWENTIETH: Sampling = Sampling::Constant { interval_s: 0.05 };

#[test]
fn constant_sampling_has_keys_on_the_source_and_at_the_end() {
    let mut rng = SmallRng::seed_from_u64(3);
    for case in 0..100 {
        let model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], 0));
        let clip = sample(&model, Some(0), TWENTIETH);
        let track = &clip.bones[0][0];
        assert!(track.interval_s <= 0.05 * 1.01, "seed 3, case {case}");
        for (time, value) in track.times_s.iter().zip(&track.values) {
            let truth = source_pose(&model, Some(0), f64::from(*time))[0].translation;
            assert!(value.truncate().abs_diff_eq(truth, 1e-4), "seed 3, case {case}, {time} s");
        }
        if !track.is_constant() {
            assert_eq!(track.times_s.last(), Some(&clip.duration_s), "seed 3, case {case}");
        }
    }
}

#[test]
fn interpolation_hits_its_keys() {
    let mut rng = SmallRng::seed_from_u64(4);
    for case in 0..200 {
        let model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], case / 3 % 3));
        for sampling in [TWENTIETH, Sampling::default()] {
            let clip = sample(&model, Some(0), sampling);
            for track in clip.tracks() {
                for (time, value) in track.times_s.iter().zip(&track.values) {
                    let found = track.evaluate(f64::from(*time));
                    assert!(found.abs_diff_eq(*value, 2e-4), "seed 4, case {case}, {sampling}, {time} s");
                }
            }
        }
    }
}

#[test]
fn neighbouring_rotations_lie_in_one_hemisphere() {
    let mut rng = SmallRng::seed_from_u64(2);
    for case in 0..100 {
        let model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], 1));
        for sampling in [TWENTIETH, Sampling::default()] {
            let clip = sample(&model, Some(0), sampling);
            let keys = &clip.bones[0][1].values;
            assert!(keys.windows(2).all(|pair| pair[0].dot(pair[1]) >= 0.0), "seed 2, case {case}");
        }
    }
}

#[test]
fn flipped_signs_in_the_source_change_nothing() {
    let mut rng = SmallRng::seed_from_u64(5);
    for case in 0..50 {
        let straight = random_track(&mut rng, 0, Interpolation::Linear, 1);
        let mut flipped = straight.clone();
        let TrackValues::Rotation(keys) = &mut flipped.values else { panic!("rotation") };
        keys.iter_mut().skip(1).step_by(2).for_each(|key| *key = -*key);
        for sampling in [TWENTIETH, Sampling::default()] {
            let [a, b] = [&straight, &flipped].map(|t| sample(&one_bone(t.clone()), Some(0), sampling));
            for step in 0..100 {
                let t = f64::from(a.duration_s) * f64::from(step) / 99.0;
                let [a, b] = [&a, &b].map(|clip| clip.local_pose(t)[0].rotation);
                assert!(a.dot(b).abs() > 1.0 - 1e-5, "seed 5, case {case}, {sampling}, {t} s");
            }
        }
    }
}

#[test]
fn four_seconds_are_240_sixtieths() {
    let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::X]);
    let track = Track { bone: 0, times_s: vec![0.0, 4.0], interpolation: Interpolation::Linear, values };
    let clip = sample(&one_bone(track), Some(0), Sampling::Constant { interval_s: 1.0 / 60.0 });
    assert_eq!(clip.bones[0].each_ref().map(|track| track.values.len()), [241, 1, 1]);
}

#[test]
fn rest_pose_and_clip_without_duration_have_one_key() {
    let values = TrackValues::Translation(vec![Vec3::X]);
    let track = Track { bone: 0, times_s: vec![0.0], interpolation: Interpolation::Step, values };
    let model = one_bone(track);
    for sampling in [TWENTIETH, Sampling::default()] {
        for (clip, expected) in [(None, Vec3::ZERO), (Some(0), Vec3::X)] {
            let clip = sample(&model, clip, sampling);
            assert_eq!((clip.key_count(), clip.duration_s), (3, 0.0));
            assert_eq!(clip.local_pose(1.0)[0], Trs { translation: expected, ..Trs::IDENTITY });
        }
    }
}

#[test]
fn a_very_long_clip_is_sampled_more_coarsely() {
    let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::X]);
    let track = Track { bone: 0, times_s: vec![0.0, 86_400.0], interpolation: Interpolation::Linear, values };
    let mut model = one_bone(track);
    model.bones = vec![model.bones[0].clone(); 4096];
    let clip = sample(&model, Some(0), Sampling::Constant { interval_s: 1e-3 });
    assert!(clip.key_count() <= MAX_CONSTANT_KEYS);
}

#[test]
fn morph_weights_are_sampled_and_others_rest() {
    let morph = |rest_weight| crate::Morph { name: "m".into(), rest_weight, deltas: Vec::new() };
    let track = MorphTrack {
        first_morph: 1,
        morph_count: 1,
        times_s: vec![0.0, 1.0],
        interpolation: Interpolation::Linear,
        weights: vec![0.0, 1.0],
    };
    let clip = crate::Clip { duration_s: 1.0, morph_tracks: vec![track], ..Default::default() };
    let model = Model { morphs: vec![morph(0.5), morph(0.25)], clips: vec![clip], ..Model::default() };
    assert_eq!(sample(&model, Some(0), TWENTIETH).morph_weights(0.25), [0.5, 0.25]);
    assert_eq!(sample(&model, None, TWENTIETH).morph_weights(0.25), [0.5, 0.25]);
    assert_eq!(sample(&model, Some(0), TWENTIETH).morph_weights(0.75), [0.5, 0.75]);
}

/// Instances of a small model, each on the same path and twice as large as the one before.
fn scene_on_a_path(count: usize) -> Scene {
    let values = TrackValues::Rotation([0.0f32, 1.5, 3.0].map(Quat::from_rotation_y).to_vec());
    let turns = Track { bone: 0, times_s: vec![0.0, 1.0, 2.0], interpolation: Interpolation::Linear, values };
    let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::X * 4.0]);
    let moves = Track { bone: 0, times_s: vec![0.0, 2.0], interpolation: Interpolation::Linear, values };
    let mut clip = one_bone(turns).clips.remove(0);
    clip.tracks.push(moves);
    let path = Path { clip, repetition: Repetition::Loop, time_shift_s: 0.25, speed: 0.5 };
    let mut scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let instance = |index: usize| Instance {
        placement: Affine3A::from_scale(Vec3::splat(2f32.powi(index as i32))),
        path: Some(path.clone()),
        ..Instance::new("i", 0)
    };
    scene.instances = (0..count).map(instance).collect();
    scene
}

#[test]
fn paths_are_sampled_like_clips_and_each_once() {
    let mut scene = scene_on_a_path(2);
    let farthest = |scene: &Scene, sampling: Sampling| {
        let paths = SampledPaths::new(scene, sampling);
        let corner = crate::animation::bounds::model_bounds(&scene.models[0], None).high;
        let distance = |step: u32| {
            let t_s = f64::from(step) * 0.0313;
            let source = scene.instances[1].world_from_model(t_s).transform_point3(corner);
            paths.world_from_model(scene, 1, t_s).transform_point3(corner).distance(source)
        };
        (0..200).map(distance).fold(0.0, f32::max)
    };
    let bounded = farthest(&scene, Sampling::default());
    assert!(bounded < 1.2e-4, "{bounded} m"); // 0.1 mm, and roundings at 4 m
    let constant = farthest(&scene, Sampling::Constant { interval_s: 0.5 });
    assert!(constant > 1e-3, "chords of arcs are off: {constant} m");
    assert_eq!(SampledPaths::new(&scene, TWENTIETH).unique(), 2, "one for each size");
    scene.instances[1].placement = scene.instances[0].placement;
    assert_eq!(SampledPaths::new(&scene, TWENTIETH).unique(), 1);
}

#[test]
fn text_of_a_sampling_can_be_read_back() {
    let constant = |interval_s| Sampling::Constant { interval_s };
    let bounded = |bound_m, range_share| Sampling::ErrorBounded { bound_m, range_share };
    let pairs = [
        ("constant", constant(0.1), "constant:100ms"),
        ("constant:33.3ms", constant(0.0333), "constant:33.3ms"),
        ("constant:0.5s", constant(0.5), "constant:500ms"),
        ("error-bounded", Sampling::default(), "error-bounded:0.1mm,0.2%"),
        ("error-bounded:1cm", bounded(0.01, DEFAULT_RANGE_SHARE), "error-bounded:10mm,0.2%"),
        ("error-bounded:0.5mm,100%", bounded(0.0005, 1.0), "error-bounded:0.5mm,100%"),
    ];
    for (text, value, shown) in pairs {
        assert_eq!(text.parse::<Sampling>(), Ok(value), "{text}");
        assert_eq!(value.to_string(), shown);
        assert_eq!(shown.parse::<Sampling>(), Ok(value));
    }
}

#[test]
fn wrong_sampling_says_what_is_accepted() {
    let wrong =
        ["", "constnt", "constant:", "constant:0ms", "constant:1e9s", "constant:10", "error-bounded:x"];
    for text in wrong.into_iter().chain(["error-bounded:1mm,5", "error-bounded:-1mm", "constant:nanms"]) {
        let error = text.parse::<Sampling>().expect_err(text).to_string();
        assert!(error.contains("0.1mm") || error.contains("33.3ms") || error.contains("0.2%"), "{error}");
    }
    let error = "constnt".parse::<Sampling>().expect_err("misspelt").to_string();
    assert!(error.contains("did you mean"), "{error}");
}

#[test]
fn model_drawn_small_may_err_more_in_its_own_units() {
    assert_eq!(Sampling::bounded(1e-4).in_model(0.01), Sampling::bounded(1e-2));
    assert_eq!(TWENTIETH.in_model(0.01), TWENTIETH);
    assert_eq!(Sampling::bounded(1e-4).in_model(0.0), Sampling::bounded(1e-4));
}
