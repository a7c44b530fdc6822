//! One leg of the left side: limb, toes, claws.

use super::anatomy::{self, LIMB_CHANGEOVER_M, LIMB_FILLET_M, island};
use super::blend::Joint;
use super::horn::Horn;
use super::loft::Station;
use super::mesh::{Island, Mesh, Skin, Tube};
use super::rig::{Rig, TOES};
use super::weights::{Limb, Shading, Weights};
use glam::{Vec2, Vec3};

const LEG_EDGE_M: f32 = 0.0265;
const TOE_EDGE_M: f32 = 0.0200;
const TOE_FILLET_M: f32 = 0.018;

/// A leg of the left side: `leg` is 0 (fore) or 2 (hind), as in [`Rig::legs`].
pub(super) struct Leg {
    index: usize,
    island: Island,
    pub limb: Limb,
    toes: Vec<Limb>,
}

impl Leg {
    pub fn fore(rig: &Rig) -> Self {
        Self::new(rig, 0, &anatomy::FORE_LEG, island::FORE_LEG)
    }

    pub fn hind(rig: &Rig) -> Self {
        Self::new(rig, 2, &anatomy::HIND_LEG, island::HIND_LEG)
    }

    fn new(rig: &Rig, index: usize, stations: &'static [Station], island: Island) -> Self {
        let limb = rig.leg_limb(index, super::loft::Loft::new(stations, Vec3::X));
        let toes = (0..TOES).map(|toe| rig.toe_limb(index, toe, anatomy::toe(stations, toe))).collect();
        Self { index, island, limb, toes }
    }

    pub fn mesh(&self, rig: &Rig, spine: &Limb) -> Mesh {
        let mut mesh = self.shank(spine);
        for toe in 0..TOES {
            mesh.append(self.toe(toe));
            mesh.append(self.claw(rig, toe));
        }
        mesh
    }

    fn shank(&self, spine: &Limb) -> Mesh {
        let mut mesh = tube(&self.limb, LEG_EDGE_M, self.island, 0.0);
        let others = std::iter::once(spine).collect();
        let joint =
            Joint { own: &self.limb, others, fillet_m: LIMB_FILLET_M, changeover_m: LIMB_CHANGEOVER_M };
        joint.apply(&mut mesh);
        mesh
    }

    fn toe(&self, toe: usize) -> Mesh {
        let limb = &self.toes[toe];
        let mut mesh = tube(limb, TOE_EDGE_M, island::TOE, 0.6);
        let others = vec![&self.limb];
        Joint { own: limb, others, fillet_m: TOE_FILLET_M, changeover_m: 0.02 }.apply(&mut mesh);
        mesh
    }

    fn claw(&self, rig: &Rig, toe: usize) -> Mesh {
        let loft = &self.toes[toe].loft;
        let end = loft.section(0.86 * loft.length_m());
        let forwards = Vec3::new(end.along.x, 0.0, end.along.z).normalize();
        let length_m = 0.36 * anatomy::TOE_LENGTH_M[toe] + 0.024;
        let base = end.centre + Vec3::Y * 0.006;
        let mut mesh = Horn {
            base,
            reach: forwards * length_m + Vec3::Y * 0.022,
            // The tip comes down to the floor.
            bend: Vec3::Y * (0.003 - base.y - 0.022),
            radii_m: Vec2::new(0.0145, 0.0165),
            side: end.side,
            edge_m: 0.0200,
            dark_base: 0.55,
        }
        .mesh();
        let joint = Weights::one(rig.legs[self.index].toes[toe][1]);
        mesh.set_weights(|_| joint.clone());
        mesh.smooth_normals();
        mesh
    }
}

fn tube(limb: &Limb, edge_m: f32, island: Island, grain: f32) -> Mesh {
    Tube {
        loft: &limb.loft,
        from_m: 0.0,
        to_m: limb.loft.length_m(),
        edge_m: &|_| edge_m,
        caps: [true, true],
        island,
        skin: Skin::Hide,
        paint: &|s_m, angle| Shading::LEG.hide_paint(s_m, angle, grain, 0.0),
    }
    .mesh()
}
