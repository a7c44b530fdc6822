//! The head: skull, jaw, tongue, teeth, eyes, horns, ears.

use super::anatomy::{self, island, spine_row};
use super::blend::Joint;
use super::body;
use super::horn::Horn;
use super::loft::Loft;
use super::mesh::{Bump, Mesh, Rows, Skin, Tube, Vertex};
use super::rig::{EAR, EYE, Rig};
use super::sheet::{Sheet, thin_rim};
use super::weights::{Limb, Shading, Weights};
use crate::curve::{arch, lerp, smoothstep};
use glam::{Vec2, Vec3, Vec4};
use std::f32::consts::{PI, TAU};

const JAW_EDGE_M: f32 = 0.0165;
const EYE_RADIUS_M: f32 = 0.029;
/// How much of the radius the eye looks to the front rather than to the side.
const EYE_FORWARDS: f32 = 0.45;

/// Everything from where the neck ends. Left and right are both in it.
pub(super) fn mesh(rig: &Rig, spine: &Limb) -> Mesh {
    let jaw = rig.jaw_limb(Loft::new(&anatomy::JAW, Vec3::X));
    let mut mesh = jaw_mesh(&jaw, spine);
    mesh.append(tongue(rig));

    let mut left = Mesh::default();
    let head = Weights::one(rig.head);
    for horn in horns().into_iter().chain(upper_teeth(&spine.loft)) {
        left.append(rigid(horn.mesh(), &head));
    }
    for tooth in lower_teeth(&jaw.loft) {
        let weights = jaw.weights(tooth.base);
        left.append(rigid(tooth.mesh(), &weights));
    }
    left.append(rigid(ear(), &Weights::one(rig.ears[0])));
    left.append(eye(&Weights::one(rig.eyes[0])));
    left.append(rigid(eyelid(), &head));

    mesh.append(left.mirrored(&|joint| rig.mirror[joint]));
    mesh.append(left);
    mesh.append(nose_horn(rig, spine));
    mesh
}

/// The skull's skin; it belongs to the trunk's tube and shares its last ring.
pub(super) fn skull(spine: &Limb) -> Mesh {
    let loft = &spine.loft;
    let from_m = loft.length_at_station(spine_row::SKULL);
    let mouth_from_m = loft.length_at_station(21.6);
    Tube {
        loft,
        from_m,
        to_m: loft.length_m(),
        edge_m: &|s_m| body::edge_m(loft, s_m),
        caps: [false, true],
        island: island::HEAD,
        skin: Skin::Hide,
        paint: &|s_m, angle| {
            let low = smoothstep(0.80, 0.93, 0.5 - 0.5 * angle.cos());
            Shading::TRUNK.hide_paint(
                s_m,
                angle,
                1.0,
                low * smoothstep(mouth_from_m, mouth_from_m + 0.05, s_m),
            )
        },
    }
    .mesh()
}

/// Brows, eye sockets, cheeks, nostrils; both sides.
pub(super) fn skull_bumps() -> Vec<Bump> {
    let bump = |x: f32, y: f32, z: f32, rx: f32, ry: f32, rz: f32, height_m: f32| {
        [x, -x].map(|x| Bump { centre: Vec3::new(x, y, z), radius_m: Vec3::new(rx, ry, rz), height_m })
    };
    [
        bump(0.070, 1.850, 1.015, 0.032, 0.023, 0.067, 0.0230), // brow
        bump(0.090, 1.809, 1.010, 0.034, 0.023, 0.034, -0.0138), // socket
        bump(0.098, 1.760, 0.968, 0.034, 0.030, 0.069, 0.0115), // cheek
        bump(0.046, 1.740, 1.359, 0.023, 0.018, 0.028, 0.0149), // nostril rim
        bump(0.051, 1.733, 1.382, 0.009, 0.009, 0.011, -0.0126), // nostril
        bump(0.023, 1.798, 1.192, 0.016, 0.034, 0.103, 0.0069), // ridges of the snout
    ]
    .concat()
}

fn jaw_mesh(jaw: &Limb, spine: &Limb) -> Mesh {
    let mut mesh = Tube {
        loft: &jaw.loft,
        from_m: 0.0,
        to_m: jaw.loft.length_m(),
        edge_m: &|_| JAW_EDGE_M,
        caps: [true, true],
        island: island::JAW,
        skin: Skin::Hide,
        paint: &|s_m, angle| {
            let ventral = 0.5 - 0.5 * angle.cos();
            let mouth = (1.0 - smoothstep(0.07, 0.2, ventral)) * smoothstep(0.03, 0.08, s_m);
            Shading::TRUNK.hide_paint(s_m, angle, 1.0, mouth)
        },
    }
    .mesh();
    Joint { own: jaw, others: vec![spine], fillet_m: 0.022, changeover_m: 0.022 }.apply(&mut mesh);
    mesh
}

fn tongue(rig: &Rig) -> Mesh {
    let limb = rig.tongue_limb(Loft::new(&anatomy::TONGUE, Vec3::X));
    let mut mesh = Tube {
        loft: &limb.loft,
        from_m: 0.0,
        to_m: limb.loft.length_m(),
        edge_m: &|_| 0.0155,
        caps: [false, true],
        island: island::TONGUE,
        skin: Skin::Hide,
        paint: &|s_m, angle| Shading::TRUNK.hide_paint(s_m, angle, 1.0, 2.0),
    }
    .mesh();
    mesh.set_weights(|place| limb.weights(place));
    mesh.smooth_normals();
    mesh
}

/// A great horn, two behind the cheek, one at the jaw's corner.
fn horns() -> Vec<Horn> {
    let horn = |base: [f32; 3], reach: [f32; 3], bend: [f32; 3], radius_m: f32| Horn {
        base: Vec3::from_array(base),
        reach: Vec3::from_array(reach),
        bend: Vec3::from_array(bend),
        radii_m: Vec2::splat(radius_m),
        side: Vec3::X,
        edge_m: (0.62 * radius_m).max(0.013),
        dark_base: 0.75,
    };
    vec![
        horn([0.053, 1.825, 0.922], [0.063, 0.081, -0.333], [0.034, 0.0945, -0.011], 0.033),
        horn([0.087, 1.770, 0.876], [0.086, -0.006, -0.127], [-0.011, 0.034, -0.034], 0.018),
        horn([0.081, 1.733, 0.887], [0.069, -0.040, -0.092], [-0.009, 0.023, -0.023], 0.015),
        horn([0.067, 1.848, 0.985], [0.021, 0.046, -0.057], [0.000, 0.007, -0.021], 0.015),
    ]
}

fn nose_horn(rig: &Rig, spine: &Limb) -> Mesh {
    let section = spine.loft.section(spine.loft.length_at_station(spine_row::NOSTRILS - 0.6));
    let horn = Horn {
        base: section.rim(0.0) - section.up * 0.008,
        reach: section.up * 0.048 - section.along * 0.006,
        bend: section.along * -0.022,
        radii_m: Vec2::new(0.010, 0.017),
        side: Vec3::X,
        edge_m: 0.009,
        dark_base: 0.7,
    };
    rigid(horn.mesh(), &Weights::one(rig.head))
}

/// Teeth of the left side along the upper lip; the first is a fang.
fn upper_teeth(spine: &Loft) -> Vec<Horn> {
    const TEETH: usize = 8;
    let tooth = |i: usize| {
        let share = i as f32 / (TEETH - 1) as f32;
        let section = spine.section(spine.length_at_station(lerp(27.3, 23.6, share)));
        let length_m = if i == 1 { 0.042 } else { 0.027 - 0.008 * share };
        tooth(section.rim(0.66 * PI), -section.up, section.along, length_m)
    };
    (0..TEETH).map(tooth).collect()
}

fn lower_teeth(jaw: &Loft) -> Vec<Horn> {
    const TEETH: usize = 7;
    let tooth = |i: usize| {
        let share = i as f32 / (TEETH - 1) as f32;
        let section = jaw.section(jaw.length_at_station(lerp(6.0, 3.2, share)));
        let length_m = if i == 0 { 0.034 } else { 0.022 - 0.006 * share };
        tooth(section.rim(0.40 * PI), section.up, section.along, length_m)
    };
    (0..TEETH).map(tooth).collect()
}

fn tooth(rim: Vec3, out: Vec3, along: Vec3, length_m: f32) -> Horn {
    // Rooted a little inside the lip.
    let inwards = Vec3::X * (-0.10 * rim.x);
    Horn {
        base: rim + inwards - out * (0.35 * length_m),
        reach: out * (1.2 * length_m),
        bend: along * (-0.18 * length_m),
        radii_m: Vec2::splat(0.0035 + 0.10 * length_m),
        side: Vec3::X,
        edge_m: 0.0130,
        dark_base: 0.15,
    }
}

/// A fan of skin behind the cheek.
fn ear() -> Mesh {
    const RAYS: [Vec3; 4] = [
        Vec3::new(0.098, 0.115, -0.086),
        Vec3::new(0.144, 0.063, -0.138),
        Vec3::new(0.132, -0.023, -0.144),
        Vec3::new(0.081, -0.075, -0.098),
    ];
    let ray = |t: f32| {
        let at = t * (RAYS.len() - 1) as f32;
        let i = (at as usize).min(RAYS.len() - 2);
        let scallop = 1.0 - 0.22 * arch(at - i as f32);
        (RAYS[i].lerp(RAYS[i + 1], at - i as f32), scallop)
    };
    let place = |s: f32, t: f32| {
        let (ray, scallop) = ray(t);
        let root = EAR + Vec3::new(-0.014, 0.030 - 0.060 * t, 0.012);
        root + ray * (s * scallop)
    };
    let bone_m = |_: f32, t: f32, width_m: f32| {
        let at = t * (RAYS.len() - 1) as f32;
        (at - at.round()).abs() * width_m / (RAYS.len() - 1) as f32
    };
    let texel = |at: Vec3, layer: usize| {
        let offset = at - EAR;
        let back = (offset.x * offset.x + offset.z * offset.z).sqrt() * -offset.z.signum();
        island::EAR[layer] + Vec2::new(back, -offset.y) * island::EAR_TEXELS_PER_M
    };
    Sheet {
        place: &place,
        texel: &texel,
        rows: 9,
        edge_m: 0.020,
        thickness_m: &|s, _| 0.006 * thin_rim(s),
        bone_m: &bone_m,
        weights: None,
    }
    .mesh()
}

/// Where an eye looks, what is up for it, and what is to its side.
struct Gaze {
    sight: Vec3,
    upright: Vec3,
    sideways: Vec3,
}

impl Gaze {
    fn left() -> Self {
        let sight = Vec3::new(1.0, 0.10, EYE_FORWARDS).normalize();
        let upright = (Vec3::Y - sight * sight.y).normalize();
        Self { sight, upright, sideways: upright.cross(sight) }
    }
}

/// Part of a ball around an axis, in rings from the pole; `vertex` gets the direction and the two angles.
fn ball(
    axis: Vec3,
    zero: Vec3,
    reach: f32,
    [rings, spokes]: [usize; 2],
    vertex: &dyn Fn(Vec3, f32, f32) -> Vertex,
) -> Mesh {
    let across = axis.cross(zero);
    let at = |ring: usize, spoke: usize| {
        let off = reach * ring as f32 / rings as f32;
        // The last spoke lies exactly on the first.
        let around = TAU * (spoke % spokes) as f32 / spokes as f32;
        let rim = zero * around.cos() + across * around.sin();
        vertex(axis * off.cos() + rim * off.sin(), off, around)
    };
    let mut rows = Rows::default();
    rows.push([(0.5, at(0, 0))]);
    for ring in 1..=rings {
        rows.push((0..=spokes).map(|spoke| (spoke as f32 / spokes as f32, at(ring, spoke))));
    }
    rows.into_mesh()
}

/// A ball whose texture is laid out around the line of sight; what is deep inside the skull is left out.
fn eye(weights: &Weights) -> Mesh {
    const REACH: f32 = 0.8 * PI;
    let gaze = Gaze::left();
    let vertex = |normal: Vec3, off: f32, around: f32| {
        let (sin, cos) = around.sin_cos();
        let texel = island::EYE + Vec2::new(cos, -sin) * (island::EYE_RADIUS * off / REACH);
        let paint = Vec4::new(off, off * cos, off * sin, 0.0);
        Vertex::new(EYE + normal * EYE_RADIUS_M, texel, Skin::Eye, paint)
    };
    rigid(ball(gaze.sight, gaze.sideways, REACH, [7, 14], &vertex), weights)
}

/// A shell over the upper part of the eye, drawn down in front.
fn eyelid() -> Mesh {
    const REACH: f32 = 0.46 * PI;
    const RADIUS_M: f32 = 1.09 * EYE_RADIUS_M;
    let gaze = Gaze::left();
    let axis = (gaze.upright - 0.12 * gaze.sight + 0.30 * gaze.sideways).normalize();
    let zero = (gaze.sight - axis * axis.dot(gaze.sight)).normalize();
    let vertex = |normal: Vec3, off: f32, around: f32| {
        let offset = Vec2::from_angle(around) * (off * RADIUS_M);
        let texel = island::EYELID + offset * island::EYELID_TEXELS_PER_M;
        Vertex::new(
            EYE + normal * RADIUS_M,
            texel,
            Skin::Hide,
            Shading::TRUNK.hide_paint(0.0, 0.35 * PI, 1.0, 0.0),
        )
    };
    ball(axis, zero, REACH, [5, 14], &vertex)
}

fn rigid(mut mesh: Mesh, weights: &Weights) -> Mesh {
    mesh.set_weights(|_| weights.clone());
    mesh.smooth_normals();
    mesh
}
