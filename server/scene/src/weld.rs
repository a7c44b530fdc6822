//! Merges vertices that are equal in everything, so that neighbouring triangles share them. Patches are found, and vertices
//! streamed, by index.

use super::Vertex;
use std::collections::HashMap;

/// Merges equal vertices, and drops triangles that name a vertex twice and vertices that no triangle names. The order
/// of triangles and the order of first use of vertices stay.
pub fn weld(vertices: &mut Vec<Vertex>, indices: &mut Vec<u32>) {
    weld_within_classes(vertices, indices, |_| 0);
}

/// Like [`weld`], but vertices of different `class` stay apart: those whose morph targets differ, for example.
/// Returns which vertex each one that is left was, so that what belongs to vertices can follow them.
pub fn weld_within_classes(
    vertices: &mut Vec<Vertex>,
    indices: &mut Vec<u32>,
    class: impl Fn(u32) -> u32,
) -> Vec<u32> {
    let mut slots: HashMap<([u32; 21], u32), u32> = HashMap::with_capacity(vertices.len());
    let (mut kept, mut list) = (Vec::with_capacity(vertices.len()), Vec::with_capacity(indices.len()));
    for triangle in indices.chunks_exact(3) {
        let keys = [0, 1, 2].map(|corner| triangle[corner]).map(|v| (key(&vertices[v as usize]), class(v)));
        if keys[0] == keys[1] || keys[1] == keys[2] || keys[2] == keys[0] {
            continue;
        }
        for (corner, key) in keys.into_iter().enumerate() {
            list.push(*slots.entry(key).or_insert_with(|| {
                kept.push(triangle[corner]);
                (kept.len() - 1) as u32
            }));
        }
    }
    (*vertices, *indices) = (kept.iter().map(|vertex| vertices[*vertex as usize]).collect(), list);
    kept
}

/// Every bit of a vertex, with -0 as 0.
fn key(vertex: &Vertex) -> [u32; 21] {
    let mut key = [0; 21];
    let floats = vertex.position.to_array().into_iter().chain(vertex.normal.to_array());
    let floats = floats.chain(vertex.tangent).chain(vertex.uv).chain(vertex.uv1).chain(vertex.weights);
    for (slot, value) in key.iter_mut().zip(floats) {
        *slot = (value + 0.0).to_bits();
    }
    let [a, b, c, d] = vertex.joints.map(u32::from);
    (key[18], key[19], key[20]) = (a << 16 | b, c << 16 | d, u32::from_le_bytes(vertex.color));
    key
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn vertex(x: f32, joint: u16) -> Vertex {
        Vertex { position: Vec3::new(x, 0.0, 0.0), joints: [joint; 4], ..Vertex::default() }
    }

    #[test]
    fn equal_vertices_become_one_and_triangles_stay() {
        let mut vertices: Vec<Vertex> = [0.0, 1.0, 2.0, 2.0, 1.0, -3.0].map(|x| vertex(x, 0)).to_vec();
        let before: Vec<Vec3> = vertices.iter().map(|v| v.position).collect();
        let mut indices = vec![0, 1, 2, 3, 4, 5];
        weld(&mut vertices, &mut indices);
        assert_eq!(vertices.len(), 4);
        let after: Vec<Vec3> = indices.iter().map(|i| vertices[*i as usize].position).collect();
        assert_eq!(after, before);
    }

    #[test]
    fn vertices_that_move_differently_stay_apart() {
        let mut vertices = vec![vertex(0.0, 0), vertex(1.0, 0), vertex(2.0, 0), vertex(0.0, 1)];
        let mut indices = vec![0, 1, 2, 3, 2, 1];
        weld(&mut vertices, &mut indices);
        assert_eq!(vertices.len(), 4);
    }

    #[test]
    fn vertices_of_different_classes_stay_apart() {
        let mut vertices: Vec<Vertex> = [5.0, 0.0, 1.0, 2.0, 2.0, 1.0, -3.0].map(|x| vertex(x, 0)).to_vec();
        let mut indices = vec![1, 2, 3, 4, 5, 6];
        let origins = weld_within_classes(&mut vertices, &mut indices, |vertex| u32::from(vertex == 5));
        assert_eq!((origins, indices), (vec![1, 2, 3, 5, 6], vec![0, 1, 2, 2, 3, 4]));
    }

    #[test]
    fn triangles_without_area_by_index_and_unused_vertices_go() {
        let mut vertices = vec![vertex(0.0, 0), vertex(1.0, 0), vertex(2.0, 0), vertex(-0.0, 0)];
        let mut indices = vec![0, 1, 3];
        weld(&mut vertices, &mut indices);
        assert!(vertices.is_empty() && indices.is_empty());
    }
}
