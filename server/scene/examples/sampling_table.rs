//! Keys, bytes, worst errors and time of error-bounded sampling, for several bounds.
//!
//! `cargo run --release -p shadecast-scene --example sampling_table -- dragon` or any asset.

use shadecast_scene::animation::sampling::{self, SampledClip, Sampling};
use shadecast_scene::animation::{error::Subject, pose};
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{Model, Scene};
use std::time::Instant;

const BOUNDS_MM: [f32; 4] = [0.1, 0.2, 0.5, 1.0];
const SHARES: [f32; 2] = [1.0, sampling::DEFAULT_RANGE_SHARE];
/// Times at which vertices are compared: more than sampling itself looks at, and none of them a round part of a second.
const TIMES_PER_S: f64 = 487.0;

fn main() {
    let scenes: Vec<String> = std::env::args().skip(1).collect();
    let scenes = if scenes.is_empty() { vec!["dragon".to_owned()] } else { scenes };
    for name in scenes {
        let source: SceneSource = name.parse().expect("a scene");
        match load_scene(&source) {
            Ok(scene) => table(&name, &scene),
            Err(error) => println!("{name}: {error}"),
        }
    }
}

fn table(name: &str, scene: &Scene) {
    for (index, model) in scene.models.iter().enumerate() {
        let world_scale = sampling::world_scale(scene, index);
        for clip in 0..model.clips.len() {
            println!("{name}, clip {clip} '{}'", model.clips[clip].name);
            println!("  bound mm  share %   keys     bytes  worst/bound  between/bound   s");
            for share in SHARES {
                for bound_mm in BOUNDS_MM {
                    row(model, clip, world_scale, bound_mm, share);
                }
            }
        }
    }
}

fn row(model: &Model, clip: usize, world_scale: f32, bound_mm: f32, range_share: f32) {
    let sampling = Sampling::ErrorBounded { bound_m: bound_mm * 1e-3, range_share }.in_model(world_scale);
    let start = Instant::now();
    let sampled = sampling::sample(model, Some(clip), sampling);
    let seconds = start.elapsed().as_secs_f64();
    let subject = Subject { model, clip, sampled: &sampled, world_scale };
    let at_keys_mm = subject.resampling().vertices.map_or(0.0, |errors| errors.max_mm);
    let between_m = world_scale * between(model, clip, &sampled);
    println!(
        "  {bound_mm:8.1} {:8.1} {:6} {:9} {:12.3} {:14.3} {seconds:5.2}",
        range_share * 100.0,
        sampled.key_count(),
        sampled.byte_count(),
        at_keys_mm / f64::from(bound_mm),
        between_m * 1e3 / bound_mm,
    );
}

/// The largest distance of any skinned vertex from the original; morphs are left out.
fn between(model: &Model, clip: usize, sampled: &SampledClip) -> f32 {
    let count = (f64::from(sampled.duration_s) * TIMES_PER_S) as u32;
    let at = |index: u32| {
        let t_s = f64::from(index) / TIMES_PER_S;
        let truth = pose::source_palette(model, Some(clip), t_s);
        let found = pose::palette(model, &pose::global_pose(model, &sampled.local_pose(t_s)));
        let distance = |vertex: &shadecast_scene::Vertex| {
            let place = |palette| {
                pose::blend(palette, vertex.joints, vertex.weights).transform_point3a(vertex.position.into())
            };
            place(&truth).distance(place(&found))
        };
        model.vertices.iter().map(distance).fold(0.0, f32::max)
    };
    (0..count).map(at).fold(0.0, f32::max)
}
