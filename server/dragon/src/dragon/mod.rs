//! The generated dragon: skeleton, skin, textures and a flying clip, as a GLB file.
//!
//! The shape is made of tubes (`loft`) and thin skins (`sheet`) after the measures in `anatomy`; where limbs meet the
//! trunk their surfaces are moved onto a smooth union (`blend`). Textures are painted from places on the finished
//! surface (`bake`, `paint`). Everything is a pure function of constants, so every call gives the same bytes.

mod anatomy;
mod bake;
mod blend;
mod body;
mod clip;
mod export;
mod head;
mod horn;
mod legs;
mod loft;
mod mesh;
mod paint;
mod rig;
mod sheet;
#[cfg(test)]
mod tests;
mod weights;
mod wings;

use blend::Joint;
use glam::Vec3;
use mesh::{Mesh, Skin};
use rig::Rig;
use weights::Limb;

/// The bytes of a GLB file with a winged, textured, animated dragon.
///
/// It stands on y = 0, 2 m tall, centred above the origin and looking along +z. The one clip, `fly`, takes 4 s and
/// repeats smoothly. The same bytes at every call.
pub fn dragon() -> Vec<u8> {
    let loft = anatomy::spine();
    let mut rig = Rig::new(&loft);
    let mut mesh = skin(&rig, loft);
    let centring = Vec3::new(0.0, anatomy::CENTRING_Y_M, anatomy::CENTRING_Z_M);
    mesh.vertices.iter_mut().for_each(|vertex| vertex.position += centring);
    rig.joints.iter_mut().for_each(|joint| joint.position += centring);
    mesh.tangents();
    export::glb(&rig, &mesh)
}

/// The whole surface with weights and openness.
fn skin(rig: &Rig, spine: loft::Loft) -> Mesh {
    let spine = rig.spine_limb(spine);
    let legs = [legs::Leg::fore(rig), legs::Leg::hind(rig)];
    let wing = wings::Wing::left(rig);
    let limbs = trunk_limbs(rig, &legs, &wing);

    let mut mesh = body::tube(&spine);
    mesh.append(head::skull(&spine));
    mesh.sculpt(&head::skull_bumps());
    Joint {
        own: &spine,
        others: limbs.iter().collect(),
        fillet_m: anatomy::LIMB_FILLET_M,
        changeover_m: anatomy::LIMB_CHANGEOVER_M,
    }
    .apply(&mut mesh);

    let mut left = Mesh::default();
    legs.iter().for_each(|leg| left.append(leg.mesh(rig, &spine)));
    left.append(wing.mesh(rig, &spine));
    mesh.append(left.mirrored(&|joint| rig.mirror[joint]));
    mesh.append(left);
    mesh.append(head::mesh(rig, &spine));
    mesh.append(body::spikes(&spine));
    shade_folds(&mut mesh, &spine, &limbs);
    mesh
}

/// Both sides' legs and wing arms.
fn trunk_limbs(rig: &Rig, legs: &[legs::Leg; 2], wing: &wings::Wing) -> Vec<Limb> {
    let [fore, hind] = legs.each_ref().map(|leg| &leg.limb);
    let fore_right = rig.leg_limb(1, fore.loft.mirrored());
    let hind_right = rig.leg_limb(3, hind.loft.mirrored());
    let wing_right = rig.arm_limb(1, wing.arm.loft.mirrored());
    vec![fore.clone(), fore_right, hind.clone(), hind_right, wing.arm.clone(), wing_right]
}

/// Darkens the hide where trunk and limbs are close to each other.
fn shade_folds(mesh: &mut Mesh, spine: &Limb, limbs: &[Limb]) {
    let lofts: Vec<&loft::Loft> = std::iter::once(spine).chain(limbs).map(|limb| &limb.loft).collect();
    for vertex in mesh.vertices.iter_mut().filter(|vertex| vertex.skin == Skin::Hide) {
        vertex.openness = blend::openness(vertex.position, vertex.normal, &lofts);
    }
}
