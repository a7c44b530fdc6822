//! LODs cover their primitives, get coarser, stay closed, and keep their shape at bent joints.

use super::*;
use crate::animation::pose::source_skin;
use crate::{Material, Vertex, gltf};
use glam::Affine3A;
use std::collections::HashSet;
use std::f32::consts::TAU;
use std::sync::OnceLock;

fn dragon() -> &'static Model {
    static DRAGON: OnceLock<Model> = OnceLock::new();
    DRAGON.get_or_init(|| gltf::from_slice(&shadecast_dragon::dragon(), "dragon").expect("our own file"))
}

fn built(model: &Model) -> Vec<Lod> {
    build(model, &Cancel::default()).expect("nobody asks to end")
}

/// A closed bumpy ball of two materials, whose border runs around it, and with a seam of texture coordinates.
fn ball(rings: u32, sides: u32) -> Model {
    let mut model = Model { materials: vec![Material::default(); 2], ..Model::default() };
    model.bones = vec![crate::Bone { name: "root".into(), parent: None, rest: crate::Trs::IDENTITY }];
    model.palette = vec![crate::PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
    for ring in 0..=rings {
        for side in 0..=sides {
            let (u, v) = (side as f32 / sides as f32, ring as f32 / rings as f32);
            // The last column and the poles are at the very places of the first.
            let turn = if side == sides { 0.0 } else { u * TAU };
            let latitude = v * TAU * 0.5;
            let radius = if ring == 0 || ring == rings { 0.0 } else { latitude.sin() };
            let direction = Vec3::new(radius * turn.cos(), latitude.cos(), radius * turn.sin());
            let bump = 1.0 + 0.05 * (turn * 3.0).sin() * radius * (latitude * 4.0).sin();
            model.vertices.push(Vertex {
                position: direction * bump,
                normal: direction.normalize_or(Vec3::Y),
                uv: [u, v],
                ..Vertex::default()
            });
        }
    }
    for ring in 0..rings {
        for side in 0..sides {
            let a = ring * (sides + 1) + side;
            let (b, c, d) = (a + 1, a + sides + 1, a + sides + 2);
            let (upper, lower) = ([a, b, c], [b, d, c]);
            model.indices.extend(upper.iter().filter(|_| ring > 0));
            model.indices.extend(lower.iter().filter(|_| ring < rings - 1));
        }
    }
    let half = model.indices.len() as u32 / 6 * 3;
    let part = |first_index, index_count, material| Primitive { first_index, index_count, material };
    model.primitives = vec![part(0, half, 0), part(half, model.indices.len() as u32 - half, 1)];
    model
}

/// Directed edges between places that have no partner in the other direction.
fn open_edges(model: &Model, indices: &[u32]) -> usize {
    let place = |v: u32| model.vertices[v as usize].position.to_array().map(|x| (x + 0.0).to_bits());
    let mut balance: HashMap<([u32; 3], [u32; 3]), i32> = HashMap::new();
    for t in indices.chunks_exact(3) {
        for (from, to) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
            let (from, to) = (place(from), place(to));
            *balance.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
        }
    }
    balance.values().filter(|sum| **sum != 0).count()
}

#[track_caller]
fn assert_covered(model: &Model, lod: &Lod) {
    let mut next = 0;
    assert_eq!(lod.primitives.len(), model.primitives.len());
    for (primitive, of_model) in lod.primitives.iter().zip(&model.primitives) {
        assert_eq!((primitive.first_index, primitive.material), (next, of_model.material));
        assert!(primitive.index_count.is_multiple_of(3));
        next += primitive.index_count;
        let range = |p: &Primitive, all: &[u32]| {
            all[p.first_index as usize..][..p.index_count as usize].iter().copied().collect::<HashSet<u32>>()
        };
        let own = range(of_model, &model.indices);
        assert!(range(primitive, &lod.indices).is_subset(&own), "vertices of its own primitive only");
    }
    assert_eq!(next as usize, lod.indices.len());
}

#[test]
fn levels_cover_their_primitives_and_get_coarser() {
    let model = ball(48, 64);
    let lods = built(&model);
    assert!(lods.len() >= 4, "{}", lods.len());
    let (mut count, mut error_m) = (model.indices.len(), 0.0);
    for lod in &lods {
        assert_covered(&model, lod);
        assert!(lod.indices.len() < count && lod.error_m >= error_m, "{} {}", lod.indices.len(), lod.error_m);
        (count, error_m) = (lod.indices.len(), lod.error_m);
    }
    assert!(lods[0].error_m > 0.0 && lods[0].error_m < 0.01, "{}", lods[0].error_m);
}

#[test]
fn what_was_closed_stays_closed_across_seams_and_materials() {
    let model = ball(48, 64);
    assert_eq!(open_edges(&model, &model.indices), 0);
    for (level, lod) in built(&model).iter().enumerate() {
        assert_eq!(open_edges(&model, &lod.indices), 0, "level {}", level + 1);
    }
}

#[test]
fn two_runs_give_the_same_levels() {
    let model = ball(24, 32);
    assert_eq!(built(&model), built(&model));
}

#[test]
fn small_and_broken_models_have_no_levels() {
    assert!(built(&Model::default()).is_empty());
    assert!(built(&ball(4, 4)).is_empty());
    let mut flat = ball(24, 32);
    flat.vertices.iter_mut().for_each(|vertex| vertex.position = Vec3::ONE);
    assert!(built(&flat).is_empty());
    flat.vertices.iter_mut().for_each(|vertex| vertex.position = Vec3::INFINITY);
    assert!(built(&flat).is_empty());
}

/// Root mean square and largest distance of the full detail's vertices from a level, in a pose.
fn deviation(model: &Model, lod: &Lod, clip: Option<usize>, t_s: f64) -> (f32, f32) {
    let skinned = source_skin(model, clip, t_s, Affine3A::IDENTITY);
    let positions: Vec<Vec3> = skinned.iter().map(|vertex| vertex.position).collect();
    let surface = Surface::new(triangles(&lod.indices, &positions));
    let distances: Vec<f32> = positions.iter().step_by(5).map(|p| surface.distance(*p)).collect();
    let squares: f32 = distances.iter().map(|d| d * d).sum();
    ((squares / distances.len() as f32).sqrt(), distances.into_iter().fold(0.0, f32::max))
}

#[test]
fn the_dragons_levels_are_as_good_in_flight_as_at_rest() {
    let model = dragon();
    let cancel = Cancel::default();
    let source = |poses| Source::new(model, Options { poses }, &cancel).expect("nobody asks to end");
    let [with, without] = [true, false].map(|poses| source(poses).expect("large enough"));
    let (level, other) = (with.simplify(9448), without.simplify(9448));
    assert_covered(model, &level);
    let (rest_rms, _) = deviation(model, &level, None, 0.0);
    let bound_m = with.error_m(&level.indices, 0.0).unwrap();
    // Moments that are none of those that the simplifier was given.
    for t_s in [0.37, 1.21, 2.9] {
        let (rms, max) = deviation(model, &level, Some(0), t_s);
        let (other_rms, other_max) = deviation(model, &other, Some(0), t_s);
        assert!(rms < 1.12 * rest_rms, "{rms} m in flight, {rest_rms} m at rest");
        assert!(max < 1.1 * bound_m, "{max} m, measured bound {bound_m} m");
        assert!(
            rms < 0.96 * other_rms && max < 0.75 * other_max,
            "{rms} {max} m, {other_rms} {other_max} m without poses"
        );
    }
}
