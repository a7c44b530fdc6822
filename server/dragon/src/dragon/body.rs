//! Trunk, neck and tail with their dorsal spikes.

use super::anatomy::{island, spine_row};
use super::horn::Horn;
use super::loft::Loft;
use super::mesh::{Mesh, Skin, Tube};
use super::weights::{Limb, Shading};
use crate::curve::{lerp, smoothstep};
use glam::{Vec2, Vec3};

/// Wanted edge lengths, metres.
const TRUNK_EDGE_M: f32 = 0.0300;
const TAIL_EDGE_M: f32 = 0.0235;
const SKULL_EDGE_M: f32 = 0.0150;

/// Wanted edge length at a length along the spine, metres: finer towards tail tip and head.
pub(super) fn edge_m(spine: &Loft, s_m: f32) -> f32 {
    let hips_m = spine.length_at_station(spine_row::TAIL_ROOT);
    let (neck_m, skull_m) = (spine.length_at_station(18.0), spine.length_at_station(spine_row::SKULL + 0.6));
    let tail = lerp(TAIL_EDGE_M, TRUNK_EDGE_M, smoothstep(0.5 * hips_m, hips_m, s_m));
    lerp(tail, SKULL_EDGE_M, smoothstep(neck_m, skull_m, s_m))
}

/// Tail and trunk up to the skull; the head goes on where this ends.
pub(super) fn tube(spine: &Limb) -> Mesh {
    let loft = &spine.loft;
    let hips_m = loft.length_at_station(spine_row::TAIL_ROOT);
    let skull_m = loft.length_at_station(spine_row::SKULL);
    // The head's scales are finer; the neck goes over to them.
    let grain = |s_m: f32| smoothstep(skull_m - 0.25, skull_m, s_m);
    let stretch = |from_m, to_m, caps, island| {
        Tube {
            loft,
            from_m,
            to_m,
            edge_m: &|s_m| edge_m(loft, s_m),
            caps,
            island,
            skin: Skin::Hide,
            paint: &|s_m, angle| Shading::TRUNK.hide_paint(s_m, angle, grain(s_m), 0.0),
        }
        .mesh()
    };
    let mut mesh = stretch(0.0, hips_m, [true, false], island::TAIL);
    mesh.append(stretch(hips_m, skull_m, [false, false], island::TRUNK));
    mesh
}

/// A row of flat spikes along the back, from the neck to the end of the tail.
pub(super) fn spikes(spine: &Limb) -> Mesh {
    let loft = &spine.loft;
    let (first_m, last_m) = (loft.length_at_station(5.2), loft.length_at_station(21.2));
    let mut mesh = Mesh::default();
    let mut s_m = first_m;
    while s_m < last_m {
        let height_m = spike_height(loft.section(s_m).centre, (s_m - first_m) / (last_m - first_m));
        let mut spike = spike(spine, s_m, height_m).mesh();
        let weights = spine.weights_at(s_m);
        spike.set_weights(|_| weights.clone());
        spike.smooth_normals();
        mesh.append(spike);
        s_m += 0.052 + 0.55 * height_m;
    }
    mesh
}

/// Small at both ends, highest over the shoulders, with a second rise behind the head.
fn spike_height(centre: Vec3, share: f32) -> f32 {
    let grown = lerp(0.030, 0.105, smoothstep(0.0, 0.62, share));
    let neck = lerp(1.0, 0.68, smoothstep(0.68, 0.85, share));
    // Between the wing roots there is less room.
    let wings = 1.0 - 0.25 * (-((centre.z - 0.3) / 0.14).powi(2)).exp();
    grown * neck * wings
}

fn spike(spine: &Limb, s_m: f32, height_m: f32) -> Horn {
    let section = spine.loft.section(s_m);
    let sunk = 0.22 * height_m;
    Horn {
        base: section.rim(0.0) - section.up * sunk + section.along * (0.12 * height_m),
        reach: section.up * (height_m + sunk) - section.along * (0.35 * height_m),
        bend: section.along * (-0.35 * height_m),
        radii_m: Vec2::new(0.17, 0.40) * height_m,
        side: Vec3::X,
        edge_m: 0.45 * height_m,
        dark_base: 0.9,
    }
}
