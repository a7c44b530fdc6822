use super::*;
use crate::animation::pose;
use crate::surface::Surface;
use rand::{Rng, SeedableRng, rngs::SmallRng};

fn vertex(position: Vec3, joint: u16) -> Vertex {
    Vertex {
        position,
        normal: Vec3::Y,
        uv: [position.x, position.z],
        joints: [joint, 9, 9, 9],
        ..Vertex::default()
    }
}

/// A bumpy sheet of random cell sizes. `seams`: each triangle has vertices of its own, in two primitives.
fn sheet(rng: &mut SmallRng, side: usize, seams: bool) -> Model {
    let mut axis = || {
        let mut at = 0.0;
        let mut step = || {
            at += rng.random_range(0.05f32..3.0);
            at
        };
        (0..=side).map(|_| step()).collect::<Vec<_>>()
    };
    let (xs, zs) = (axis(), axis());
    let mut grid = Vec::new();
    for z in &zs {
        for x in &xs {
            grid.push(vertex(Vec3::new(*x, rng.random_range(0.0..0.5), *z), rng.random_range(0..5)));
        }
    }
    let mut indices = Vec::new();
    for row in 0..side as u32 {
        for column in 0..side as u32 {
            let corner = row * (side as u32 + 1) + column;
            let below = corner + side as u32 + 1;
            indices.extend([corner, below, corner + 1, corner + 1, below, below + 1]);
        }
    }
    let half = (indices.len() / 6 * 3) as u32;
    let rest = indices.len() as u32 - half;
    let mut model = Model { vertices: grid, indices, ..Model::default() };
    if seams {
        model.vertices = model.indices.iter().map(|index| model.vertices[*index as usize]).collect();
        model.indices = (0..model.vertices.len() as u32).collect();
    }
    model.primitives = vec![
        Primitive { first_index: 0, index_count: half, material: 0 },
        Primitive { first_index: half, index_count: rest, material: 1 },
    ];
    model
}

fn triangles(model: &Model) -> impl Iterator<Item = [Vec3; 3]> {
    corners(&model.indices).map(|triangle| triangle.map(|index| model.vertices[index as usize].position))
}

fn area(model: &Model) -> f64 {
    triangles(model).map(|[a, b, c]| f64::from((b - a).cross(c - a).length()) * 0.5).sum()
}

type Key = [u32; 3];

/// Edges by their end positions, with the number of triangles on them.
fn edges(model: &Model) -> HashMap<(Key, Key), usize> {
    let key = |position: Vec3| position.to_array().map(f32::to_bits);
    let mut counts = HashMap::new();
    for [a, b, c] in triangles(model) {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            let (from, to) = (key(from), key(to));
            *counts.entry((from.min(to), from.max(to))).or_default() += 1;
        }
    }
    counts
}

/// Length of the edges that belong to one triangle only. A T-junction makes edges of the interior such.
fn border_length(model: &Model) -> f64 {
    let length = |(a, b): &(Key, Key)| {
        let at = |key: &Key| Vec3::from_array(key.map(f32::from_bits));
        f64::from(at(a).distance(at(b)))
    };
    edges(model).iter().filter(|(_, count)| **count == 1).map(|(edge, _)| length(edge)).sum()
}

#[test]
fn no_edge_is_long_area_stays_and_no_t_junction_opens() {
    let mut rng = SmallRng::seed_from_u64(31);
    for case in 0..40 {
        let seams = case % 2 == 1;
        let mut model = sheet(&mut rng, 1 + case % 7, seams);
        let (area_before, border_before) = (area(&model), border_length(&model));
        let stats = split_long_edges(&mut model, 0.5);
        assert!(stats.complete, "seed 31, case {case}");
        let longest = triangles(&model).flat_map(|[a, b, c]| [a.distance(b), b.distance(c), c.distance(a)]);
        assert!(longest.fold(0.0, f32::max) <= 0.5, "seed 31, case {case}");
        assert!((area(&model) / area_before - 1.0).abs() < 1e-4, "seed 31, case {case}");
        assert!((border_length(&model) / border_before - 1.0).abs() < 1e-4, "seed 31, case {case}");
        assert!(edges(&model).values().all(|count| *count <= 2), "seed 31, case {case}");
    }
}

#[test]
fn vertices_at_one_place_keep_moving_together_across_a_seam() {
    let mut rng = SmallRng::seed_from_u64(32);
    let mut model = sheet(&mut rng, 5, true);
    split_long_edges(&mut model, 0.4);
    let mut seen: HashMap<Key, (Vec<u16>, [u32; 4])> = HashMap::new();
    for vertex in &model.vertices {
        let used = vertex.joints.into_iter().zip(vertex.weights).filter(|(_, weight)| *weight > 0.0);
        let influences = (used.map(|(joint, _)| joint).collect(), vertex.weights.map(f32::to_bits));
        let first = seen.entry(vertex.position.to_array().map(f32::to_bits)).or_insert(influences.clone());
        assert_eq!(*first, influences, "seed 32, at {}", vertex.position);
        assert!((vertex.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5, "seed 32");
    }
}

#[test]
fn splitting_and_morphing_commute() {
    let mut rng = SmallRng::seed_from_u64(36);
    let mut model = sheet(&mut rng, 3, false);
    let delta = |vertex: u32| MorphDelta {
        vertex,
        position: Vec3::new(0.0, 0.3 * vertex as f32, 0.1),
        normal: Vec3::X * 0.1,
        tangent: Vec3::ZERO,
    };
    let deltas = (0..model.vertices.len() as u32).step_by(3).map(delta).collect();
    model.morphs = vec![Morph { name: "m".into(), rest_weight: 0.0, deltas }];
    let whole = pose::morphed(&model, &[1.0]).into_owned();
    let first_middle = model.vertices.len();
    split_long_edges(&mut model, 0.5);
    let deltas = &model.morphs[0].deltas;
    assert!(deltas.windows(2).all(|pair| pair[0].vertex < pair[1].vertex), "seed 36");
    let after = pose::morphed(&model, &[1.0]);
    let xz = |v: &Vertex| (v.uv[0], v.uv[1]);
    assert_eq!(
        whole.iter().map(xz).collect::<Vec<_>>(),
        model.vertices[..first_middle].iter().map(xz).collect::<Vec<_>>()
    );
    // Splitting is linear interpolation: every middle lies on the morphed surface of the unsplit model.
    let corners: Vec<[Vec3; 3]> = corners(&sheet(&mut SmallRng::seed_from_u64(36), 3, false).indices)
        .map(|t| t.map(|v| whole[v as usize].position))
        .collect();
    let surface = Surface::new(corners);
    for vertex in &after[first_middle..] {
        assert!(surface.distance(vertex.position) < 1e-4, "seed 36: {}", vertex.position);
    }
}

#[test]
fn winding_primitives_and_coordinates_are_kept() {
    let mut rng = SmallRng::seed_from_u64(33);
    let mut model = sheet(&mut rng, 4, false);
    split_long_edges(&mut model, 0.3);
    assert!(triangles(&model).all(|[a, b, c]| (b - a).cross(c - a).y > 0.0), "seed 33");
    let [first, second] = &model.primitives[..] else { panic!("two primitives") };
    assert_eq!((first.first_index, first.material, second.material), (0, 0, 1));
    assert_eq!(second.first_index, first.index_count);
    assert_eq!((first.index_count + second.index_count) as usize, model.indices.len());
    for vertex in &model.vertices {
        let expected = [vertex.position.x, vertex.position.z];
        assert!((vertex.uv[0] - expected[0]).abs() < 1e-4 && (vertex.uv[1] - expected[1]).abs() < 1e-4);
    }
}

#[test]
fn short_edges_are_left_alone() {
    let mut model = sheet(&mut SmallRng::seed_from_u64(34), 6, false);
    let before = (model.vertices.clone(), model.indices.clone());
    let stats = split_long_edges(&mut model, 100.0);
    assert_eq!((model.vertices, model.indices), before);
    assert_eq!(stats.triangles_before, stats.triangles_after);
}

#[test]
fn an_absurdly_large_model_stays_coarse() {
    let mut model = sheet(&mut SmallRng::seed_from_u64(35), 2, false);
    model.vertices.iter_mut().for_each(|vertex| vertex.position *= 1e9);
    let stats = split_long_edges(&mut model, 0.5);
    assert!(!stats.complete && model.indices.len() <= MAX_INDICES);
}
