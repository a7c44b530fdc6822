//! Levels cover their primitives, get coarser, stay closed, and keep their shape where joints bend.

use super::*;
use crate::animation::pose;
use crate::gltf;
use std::sync::OnceLock;

fn dragon() -> &'static Model {
    static DRAGON: OnceLock<Model> = OnceLock::new();
    DRAGON.get_or_init(|| gltf::from_slice(&crate::generate::dragon(), "dragon").expect("our own file"))
}

#[test]
fn measure() {
    let start = std::time::Instant::now();
    let model = dragon();
    println!("generate+import {:?}", start.elapsed());
    println!(
        "{} vertices {} triangles {} prims {} bones {} textures {:?}",
        model.vertices.len(),
        model.indices.len() / 3,
        model.primitives.len(),
        model.bones.len(),
        model.textures.len(),
        model.textures.iter().map(|t| t.extent_texels).collect::<Vec<_>>()
    );
    let start = std::time::Instant::now();
    let bytes = crate::generate::dragon();
    println!("generate {:?}", start.elapsed());
    let start = std::time::Instant::now();
    let _m = gltf::from_slice(&bytes, "d").unwrap();
    println!("import {:?}", start.elapsed());
    let start = std::time::Instant::now();
    let _b = pose::bounds(model, Some(0), 16);
    println!("bounds {:?}", start.elapsed());
    let start = std::time::Instant::now();
    let _b = crate::patches::Patches::build(model.triangles(0));
    println!("patches {:?}", start.elapsed());
    let start = std::time::Instant::now();
    for t in &model.textures {
        std::hint::black_box(crate::mips::chain(t));
    }
    println!("mips {:?}", start.elapsed());
    for poses in [true, false] {
        let start = std::time::Instant::now();
        let source = Source::new(model, Options { poses }).unwrap();
        println!(
            "source {:?}: {} real {} bent, extent {}",
            start.elapsed(),
            source.poses.real.len(),
            source.poses.bent.len(),
            source.extent_m
        );
        let mut t = model.indices.len() / 3;
        while t > 128 {
            let start = std::time::Instant::now();
            let lod = source.simplify(t / 2);
            let time = start.elapsed();
            let start = std::time::Instant::now();
            let per_pose: Vec<f32> = source
                .poses
                .real
                .iter()
                .zip(&source.surfaces)
                .map(|(positions, _)| {
                    let level = Surface::new(triangles(&lod.indices, positions));
                    level
                        .largest_distance(source.vertex_of_corner.iter().map(|v| positions[*v as usize]), 0.0)
                })
                .collect();
            let rms: Vec<f32> = source
                .poses
                .real
                .iter()
                .map(|positions| {
                    let level = Surface::new(triangles(&lod.indices, positions));
                    let all: Vec<f32> = source
                        .vertex_of_corner
                        .iter()
                        .step_by(4)
                        .map(|v| level.distance(positions[*v as usize]))
                        .collect();
                    (all.iter().map(|d| d * d).sum::<f32>() / all.len() as f32).sqrt()
                })
                .collect();
            let e = source.error_m(&lod.indices, 0.0);
            println!(
                "poses {poses} target {} got {} time {time:?} {:?} error {e:.4} max {per_pose:.4?} rms {rms:.5?} edge {:.3}",
                t / 2,
                lod.indices.len() / 3,
                start.elapsed(),
                source.longest_edge_m(&lod.indices)
            );
            if lod.indices.len() / 3 > t * 9 / 10 {
                break;
            }
            t = lod.indices.len() / 3;
        }
    }
}
