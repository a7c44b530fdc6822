mod first_fit;

use super::*;
use crate::{SceneError, fbx, gltf};
use glam::Vec3;
use rand::{Rng, SeedableRng, rngs::SmallRng};
use std::collections::HashMap;
use std::path::Path;

fn build(model: &Model) -> Patches {
    Patches::build(model.triangles(0), &Cancel::default()).expect("nobody asks to end")
}

/// A rough sheet of `side` x `side` squares, cut along random diagonals, with holes; the right half is of another material.
fn sheet(seed: u64, side: u32) -> Model {
    let mut rng = SmallRng::seed_from_u64(seed);
    let mut vertex = |i: u32| {
        let mut off = || rng.random_range(-0.3..0.3);
        let position = Vec3::new((i % (side + 1)) as f32 + off(), off(), (i / (side + 1)) as f32 + off());
        Vertex { position, ..Vertex::default() }
    };
    let vertices = (0..(side + 1) * (side + 1)).map(&mut vertex).collect();
    let mut halves = [Vec::new(), Vec::new()];
    for (x, z) in (0..side).flat_map(|z| (0..side).map(move |x| (x, z))) {
        let a = z * (side + 1) + x;
        let (b, c, d) = (a + 1, a + side + 1, a + side + 2);
        let cut = if rng.random_bool(0.5) { [[a, c, b], [b, c, d]] } else { [[a, c, d], [a, d, b]] };
        let half = &mut halves[usize::from(2 * x >= side)];
        cut.into_iter().filter(|_| rng.random_bool(0.95)).for_each(|triangle| half.extend(triangle));
    }
    let [left, right] = halves.each_ref().map(|half| half.len() as u32);
    let primitive = |first_index, index_count, material| Primitive { first_index, index_count, material };
    Model {
        vertices,
        indices: halves.concat(),
        primitives: vec![primitive(0, left, 3), primitive(left, right, 1)],
        ..Model::default()
    }
}

/// Triangles of any three of a few vertices: sides that many share, backs, slivers, points.
fn rubbish(seed: u64, triangles: usize) -> Model {
    let mut rng = SmallRng::seed_from_u64(seed);
    let mut coordinate = || if rng.random_bool(0.1) { 1e18 } else { f32::from(rng.random_range(-2..3i8)) };
    let mut vertex =
        || Vertex { position: Vec3::from_array([(); 3].map(|()| coordinate())), ..Vertex::default() };
    let vertices = (0..12).map(|_| vertex()).collect();
    let indices: Vec<u32> = (0..3 * triangles).map(|_| rng.random_range(0..12)).collect();
    let whole = Primitive { first_index: 0, index_count: indices.len() as u32, material: 0 };
    Model { vertices, indices, primitives: vec![whole], ..Model::default() }
}

/// The assets that lie beside the project, and the dragon.
fn assets() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets");
    let load = |name: &str| -> Result<Model, SceneError> {
        let path = folder.join(name);
        if name.ends_with("fbx") { fbx::load(&path) } else { gltf::load(&path) }
    };
    let names = ["CesiumMan.glb", "DamagedHelmet.glb", "Suzanne.glb", "maya_human_ik_7400_binary.fbx"];
    let there = names.into_iter().filter(|name| folder.join(name).exists());
    let dragon = gltf::from_slice(&shadecast_dragon::dragon(), "dragon").expect("built in");
    there.map(|name| load(name).expect(name)).chain([dragon]).collect()
}

fn turned([a, b, c]: [u32; 3]) -> [u32; 3] {
    [[a, b, c], [b, c, a], [c, a, b]].into_iter().min().expect("three")
}

/// Every triangle is in one patch, with its winding and material, and `patch_of_triangle` names that.
#[track_caller]
fn check_division(model: &Model, patches: &Patches) {
    let mut in_patches: HashMap<(u32, [u32; 3]), u32> = HashMap::new();
    for (number, patch) in (0..).zip(&patches.patches) {
        for corners in patch.kind.triangles() {
            let corners = corners.map(|corner| patch.vertices[usize::from(corner)]);
            *in_patches.entry((number, turned(corners))).or_default() += 1;
        }
        let unused = &patch.vertices[patch.kind.vertex_count()..];
        assert!(unused.iter().all(|vertex| *vertex == patch.vertices[0]), "{patch:?}");
    }
    let materials = model.primitives.iter().flat_map(|p| vec![p.material; p.index_count as usize / 3]);
    let triangles = model.indices.chunks_exact(3).zip(materials).zip(&patches.patch_of_triangle);
    for ((corners, material), number) in triangles {
        let key = (*number, turned([corners[0], corners[1], corners[2]]));
        let left = in_patches.get_mut(&key).filter(|left| **left > 0);
        *left.unwrap_or_else(|| panic!("patch {number} lacks {corners:?}")) -= 1;
        assert_eq!(patches.patches[*number as usize].material, material);
    }
    assert!(in_patches.values().all(|left| *left == 0), "a patch has what the model has not");
}

/// The triangles of every patch meet along whole sides, about in one direction, and none is stretched too far.
#[track_caller]
fn check_rules(model: &Model, patches: &Patches) {
    let position = |vertex: u32| model.vertices[vertex as usize].position;
    for patch in &patches.patches {
        let triangles: Vec<[u32; 3]> =
            patch.kind.triangles().iter().map(|t| t.map(|c| patch.vertices[usize::from(c)])).collect();
        for pair in triangles.windows(2) {
            let common = pair[0].iter().filter(|vertex| pair[1].contains(vertex)).count();
            assert_eq!(common, 2, "{patch:?}");
            let normal = |[a, b, c]: [u32; 3]| {
                (position(b) - position(a)).cross(position(c) - position(a)).normalize_or_zero()
            };
            assert!(normal(pair[0]).dot(normal(pair[1])) >= 0.599, "{patch:?} bends");
        }
    }
    let worst = patches.report(&model.vertices).worst_stretch;
    assert!(worst <= 1.601, "a stretch of {worst}");
}

#[test]
fn every_triangle_is_in_exactly_one_patch_that_keeps_the_rules() {
    for model in (0..12).map(|seed| sheet(seed, 3 + seed as u32)).chain(assets()) {
        let patches = build(&model);
        check_division(&model, &patches);
        check_rules(&model, &patches);
    }
}

#[test]
fn any_triangles_at_all_are_divided() {
    (0..200)
        .map(|seed| rubbish(seed, seed as usize))
        .for_each(|model| check_division(&model, &build(&model)));
}

#[test]
fn there_are_never_more_patches_than_the_first_that_fit() {
    for model in (0..12).map(|seed| sheet(seed, 4 + seed as u32)).chain(assets()) {
        let (ours, first_fit) = (build(&model), first_fit::build(model.triangles(0)));
        check_division(&model, &first_fit);
        let count = |patches: &Patches| patches.patches.len();
        assert!(
            count(&ours) <= count(&first_fit),
            "{}: {} and {}",
            model.name,
            count(&ours),
            count(&first_fit)
        );
    }
}

#[test]
fn the_dragons_patches_are_few_and_its_strips_many() {
    let dragon = gltf::from_slice(&shadecast_dragon::dragon(), "dragon").expect("built in");
    let (ours, first_fit) = (build(&dragon), first_fit::build(dragon.triangles(0)));
    assert!((ours.patches.len() as f32) < 0.9 * first_fit.patches.len() as f32);
    let [ours, first_fit] = [ours, first_fit].map(|patches| patches.report(&dragon.vertices));
    assert!(ours.count_by_kind[2] > 10 * first_fit.count_by_kind[2], "{ours:?} {first_fit:?}");
    assert!(ours.wasted_share < first_fit.wasted_share, "{ours:?} {first_fit:?}");
}

#[test]
fn the_same_triangles_have_the_same_patches() {
    let model = sheet(5, 20);
    assert_eq!(build(&model), build(&model.clone()));
}

#[test]
fn size_does_not_matter() {
    let model = sheet(6, 12);
    let mut large = model.clone();
    large.vertices.iter_mut().for_each(|vertex| vertex.position *= 1024.0);
    assert_eq!(build(&model), build(&large));
}

#[test]
fn a_flat_grid_becomes_squares_without_waste() {
    let vertex = |i: u32| {
        let position = Vec3::new((i % 9) as f32, 0.0, (i / 9) as f32);
        Vertex { position, ..Vertex::default() }
    };
    let corners = (0..64u32).map(|square| square / 8 * 9 + square % 8);
    let indices: Vec<u32> = corners.flat_map(|a| [a, a + 9, a + 1, a + 1, a + 9, a + 10]).collect();
    let whole = Primitive { first_index: 0, index_count: indices.len() as u32, material: 0 };
    let vertices = (0..81).map(vertex).collect();
    let model = Model { vertices, indices, primitives: vec![whole], ..Model::default() };
    let report = build(&model).report(&model.vertices);
    assert_eq!(report.count_by_kind, [0, 64, 0]);
    assert_eq!((report.triangles_per_patch, report.wasted_share), (2.0, 0.0));
    assert_eq!((report.mean_stretch, report.worst_stretch), (1.0, 1.0));
}

#[test]
fn an_equilateral_triangle_wastes_more_than_half() {
    let corners = [[0.0, 0.0], [1.0, 0.0], [0.5, 0.75f32.sqrt()]];
    let vertex = |[x, y]: [f32; 2]| Vertex { position: Vec3::new(x, y, 0.0), ..Vertex::default() };
    let whole = Primitive { first_index: 0, index_count: 3, material: 0 };
    let vertices = corners.map(vertex).to_vec();
    let model = Model { vertices, indices: vec![0, 1, 2], primitives: vec![whole], ..Model::default() };
    let report = build(&model).report(&model.vertices);
    assert!((report.worst_stretch - 1.5f32.sqrt()).abs() < 1e-5, "{report:?}");
    assert!((report.wasted_share - (1.0 - 0.1875f32.sqrt())).abs() < 1e-5, "{report:?}");
}
