use crate::BuiltIn;
use glam::Vec3;
use std::collections::BTreeMap;

const PIECES: [BuiltIn; 7] = [
    BuiltIn::Masonry,
    BuiltIn::Paving,
    BuiltIn::Tree,
    BuiltIn::Cypress,
    BuiltIn::Ivy,
    BuiltIn::Pot,
    BuiltIn::Lantern,
];

/// Corners of each triangle, with the normals there.
fn triangles(bytes: &[u8]) -> Vec<[(Vec3, Vec3); 3]> {
    let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(bytes).expect("valid");
    let mut all = Vec::new();
    for primitive in document.meshes().flat_map(|mesh| mesh.primitives()) {
        let reader = primitive.reader(|_| blob.as_deref());
        let positions = reader.read_positions().expect("places").map(Vec3::from);
        let normals = reader.read_normals().expect("normals").map(Vec3::from);
        let vertices: Vec<(Vec3, Vec3)> = positions.zip(normals).collect();
        let indices: Vec<u32> = reader.read_indices().expect("indices").into_u32().collect();
        all.extend(indices.chunks_exact(3).map(|t| [0, 1, 2].map(|corner| vertices[t[corner] as usize])));
    }
    all
}

#[test]
fn every_call_gives_the_same_bytes() {
    for built_in in PIECES {
        assert!(built_in.glb() == built_in.glb(), "{}", built_in.name());
    }
}

#[test]
fn normals_are_of_unit_length_and_triangles_face_their_way() {
    for built_in in PIECES {
        for triangle in triangles(&built_in.glb()) {
            let [a, b, c] = triangle.map(|(position, _)| position);
            let facing = (b - a).cross(c - a).normalize();
            for (position, normal) in triangle {
                assert!((normal.length() - 1.0).abs() < 1e-3, "{} at {position}: {normal}", built_in.name());
            }
            let normal = triangle.iter().map(|(_, normal)| *normal).sum::<Vec3>();
            // Leaves are lit as the crown that they are part of.
            let is_stiff = matches!(built_in, BuiltIn::Masonry | BuiltIn::Paving | BuiltIn::Lantern);
            assert!(!is_stiff || facing.dot(normal) > 0.0, "{} at {a}: {facing}, {normal}", built_in.name());
        }
    }
}

/// An edge that one triangle has and no other shares is the rim of a piece. Amid a wall there is none.
#[test]
fn walls_have_no_gaps_around_their_openings() {
    let key = |at: Vec3| (at * 1e4).round().as_ivec3().to_array();
    let mut edges: BTreeMap<[[i32; 3]; 2], (u32, Vec3)> = BTreeMap::new();
    let far_face = |(position, normal): &(Vec3, Vec3)| (position.z + 9.0).abs() < 1e-3 && normal.z > 0.99;
    for triangle in triangles(&BuiltIn::Masonry.glb()).into_iter().filter(|t| t.iter().all(far_face)) {
        for corner in 0..3 {
            let ends = [triangle[corner].0, triangle[(corner + 1) % 3].0];
            let mut ends_key = ends.map(key);
            ends_key.sort_unstable();
            edges.entry(ends_key).or_insert((0, ends[0].midpoint(ends[1]))).0 += 1;
        }
    }
    let is_rim = |at: &Vec3| {
        let off_gate = (at.x.hypot(at.y.max(2.3) - 2.3) - 1.15).abs();
        let off_niche = ((at.x.abs() - 2.9).hypot(at.y.max(2.3) - 2.3) - 0.55).abs();
        let off_sill = (at.y - 0.45).abs().min((at.y - 1.0).abs());
        off_gate.min(off_niche) < 0.03 || off_sill < 1e-3 || at.x.abs() > 4.999 || at.y < 1e-3 || at.y > 4.599
    };
    let open: Vec<Vec3> = edges.values().filter(|(count, _)| *count == 1).map(|(_, at)| *at).collect();
    assert!(!open.is_empty() && open.iter().all(is_rim), "{:?}", open.iter().find(|at| !is_rim(at)));
}

#[test]
fn patterns_repeat_without_a_seam() {
    for painted in
        [super::paint::stone(), super::paint::flags(), super::paint::tiles(), super::paint::dressed()]
    {
        let mut reader =
            png::Decoder::new(std::io::Cursor::new(painted.color_png)).read_info().expect("a picture");
        let mut texels = vec![0; reader.output_buffer_size().expect("small")];
        let side = reader.next_frame(&mut texels).expect("whole").width as usize;
        let step = |a: [usize; 2], b: [usize; 2]| {
            let of = |[x, y]: [usize; 2]| f64::from(texels[3 * (y * side + x)]);
            (of(a) - of(b)).abs()
        };
        let mean = |x: [usize; 2]| (0..side).map(|y| step([x[0], y], [x[1], y])).sum::<f64>() / side as f64;
        let inside = (1..side).map(|x| mean([x - 1, x])).fold(0.0, f64::max);
        assert!(mean([side - 1, 0]) <= inside, "{} at the seam, {inside} inside", mean([side - 1, 0]));
    }
}
