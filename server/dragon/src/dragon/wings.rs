//! The left wing: arm, four fingers, thumb claw, and the membranes between them.

use super::anatomy::{
    self, FLANK, LIMB_CHANGEOVER_M, LIMB_FILLET_M, WING_ARM, WING_ELBOW_ROW, WING_WRIST_ROW, WingPlane,
    island,
};
use super::blend::Joint;
use super::horn::Horn;
use super::loft::Loft;
use super::mesh::{Island, Mesh, Skin, Tube};
use super::rig::{FINGERS, Rig};
use super::sheet::{Sheet, thin_rim};
use super::weights::{Chain, Limb, Shading, Weights};
use crate::curve::{arch, catmull_rom, smoothstep};
use glam::{Vec2, Vec3};

const ARM_EDGE_M: f32 = 0.0225;
const FINGER_EDGE_M: f32 = 0.0330;
const MEMBRANE_EDGE_M: f32 = 0.034;
const MEMBRANE_ROWS: usize = 23;
const MEMBRANE_THICKNESS_M: f32 = 0.006;
/// How far the rim is drawn in between two finger tips, as a share of the finger.
const SCALLOP: f32 = 0.17;
/// How far the skin bellies out between two fingers, metres.
const BILLOW_M: f32 = 0.026;
/// From arm to rim, for the painter, metres.
const ARM_MEMBRANE_M: f32 = 0.70;

pub(super) struct Wing {
    plane: WingPlane,
    pub arm: Limb,
    fingers: Vec<Chain>,
}

impl Wing {
    pub fn left(rig: &Rig) -> Self {
        let plane = WingPlane::left();
        let arm = rig.arm_limb(0, anatomy::wing_arm(&plane));
        let fingers = (0..FINGERS).map(|finger| rig.finger_chain(0, finger)).collect();
        Self { plane, arm, fingers }
    }

    pub fn mesh(&self, rig: &Rig, spine: &Limb) -> Mesh {
        let mut mesh = self.arm_mesh(spine);
        (0..FINGERS).for_each(|finger| mesh.append(self.finger_mesh(finger)));
        (0..FINGERS - 1).for_each(|finger| mesh.append(self.hand_membrane(finger)));
        mesh.append(self.arm_membrane(spine));
        mesh.append(self.leading_membrane(spine));
        mesh.append(self.thumb(rig));
        mesh
    }

    fn arm_mesh(&self, spine: &Limb) -> Mesh {
        let mut mesh = bone_tube(&self.arm.loft, ARM_EDGE_M, island::WING_ARM);
        let joint = Joint {
            own: &self.arm,
            others: vec![spine],
            fillet_m: LIMB_FILLET_M,
            changeover_m: LIMB_CHANGEOVER_M,
        };
        joint.apply(&mut mesh);
        mesh
    }

    fn finger_mesh(&self, finger: usize) -> Mesh {
        let loft = anatomy::finger_loft(&self.plane, finger);
        let length_m = loft.length_m();
        let mut mesh = bone_tube(&loft, FINGER_EDGE_M, island::FINGER);
        mesh.set_weights(|place| self.fingers[finger].weights(loft.nearest_m(place) / length_m));
        mesh.smooth_normals();
        mesh
    }

    /// Between two fingers: rows are arcs around the wrist.
    fn hand_membrane(&self, first: usize) -> Mesh {
        let place = |s: f32, t: f32| {
            let s = s * (1.0 - SCALLOP * arch(t));
            let between = self.finger(first, s).lerp(self.finger(first + 1, s), t);
            between + self.plane.up * (BILLOW_M * arch(t) * s)
        };
        let weights = |s: f32, t: f32| {
            let s = s * (1.0 - SCALLOP * arch(t));
            Weights::mix(&self.fingers[first].weights(s), &self.fingers[first + 1].weights(s), t)
        };
        let bone_m = |_: f32, t: f32, width_m: f32| t.min(1.0 - t) * width_m;
        self.membrane(Sheet { place: &place, weights: Some(&weights), bone_m: &bone_m, ..self.sheet() })
    }

    /// Between arm, last finger and flank: a Coons patch whose rim is drawn in.
    fn arm_membrane(&self, spine: &Limb) -> Mesh {
        let last = FINGERS - 1;
        let flank = |s: f32| Vec3::from_array(catmull_rom(&FLANK, 2.0 * s));
        let (loin, tip) = (flank(1.0), self.finger(last, 1.0));
        let rim = |t: f32| loin.lerp(tip, t);
        let corner = [flank(0.0), self.arm_place(1.0)];
        // Places run from the finger (t = 0) to the flank (t = 1); the patch counts the other way.
        let place = |s: f32, t: f32| {
            let (s, t) = (s * (1.0 - 1.3 * SCALLOP * arch(t)), 1.0 - t);
            let across = self.arm_place(t).lerp(rim(t), s);
            let along = flank(s).lerp(self.finger(last, s), t);
            let corners = corner[0].lerp(corner[1], t).lerp(loin.lerp(tip, t), s);
            across + along - corners + self.plane.up * (BILLOW_M * arch(t) * s)
        };
        let weights = |s: f32, t: f32| {
            let at_flank = spine.weights(flank(s));
            let below = Weights::mix(&self.fingers[last].weights(s), &at_flank, t);
            Weights::mix(&below, &self.arm_weights(1.0 - t), (1.0 - s).powi(2))
        };
        let bone_m = |s: f32, t: f32, width_m: f32| (t * width_m).min(s * ARM_MEMBRANE_M);
        self.membrane(Sheet { place: &place, weights: Some(&weights), bone_m: &bone_m, ..self.sheet() })
    }

    /// In front of the elbow, from the neck's root to the wrist.
    fn leading_membrane(&self, spine: &Limb) -> Mesh {
        const ROWS: usize = 15;
        let root = Vec3::new(0.095, 0.985, 0.430);
        let wrist = self.arm_place(1.0);
        // Here rows run along the arm (s), places from the leading edge (t = 0) back to the arm (t = 1).
        let edge = |s: f32| {
            let inwards = self.plane.forwards * (-0.045 * arch(s));
            root.lerp(wrist, s) + inwards + self.plane.up * (0.5 * BILLOW_M * arch(s))
        };
        let place = |s: f32, t: f32| edge(s).lerp(self.arm_place(s), t);
        let at_root = spine.weights(root);
        let weights =
            |s: f32, t: f32| Weights::mix(&self.arm_weights(s), &at_root, (1.0 - s).powi(2) * (1.0 - t));
        let bone_m = |_: f32, t: f32, width_m: f32| (1.0 - t) * width_m;
        let thickness_m = |_: f32, t: f32| MEMBRANE_THICKNESS_M * smoothstep(0.0, 0.25, t);
        let sheet = Sheet { place: &place, weights: Some(&weights), bone_m: &bone_m, ..self.sheet() };
        self.membrane(Sheet { rows: ROWS, thickness_m: &thickness_m, ..sheet })
    }

    /// What all membranes of the wing have in common; place and bones are the caller's.
    fn sheet(&self) -> Sheet<'_> {
        Sheet {
            place: &|_, _| Vec3::ZERO,
            texel: &|_, _| Vec2::ZERO,
            rows: MEMBRANE_ROWS,
            edge_m: MEMBRANE_EDGE_M,
            thickness_m: &|s, _| MEMBRANE_THICKNESS_M * thin_rim(s),
            bone_m: &|_, _, _| 0.0,
            weights: None,
        }
    }

    fn membrane(&self, sheet: Sheet) -> Mesh {
        let texel = |at: Vec3, layer: usize| {
            let plan = self.plane.plan(at);
            island::WING[layer] + Vec2::new(plan.x, -plan.y) * island::WING_TEXELS_PER_M
        };
        Sheet { texel: &texel, ..sheet }.mesh()
    }

    fn thumb(&self, rig: &Rig) -> Mesh {
        let wrist = self.arm_place(1.0);
        let mut mesh = Horn {
            base: wrist - self.plane.forwards * 0.012,
            reach: self.plane.forwards * 0.075 - self.plane.outwards * 0.012,
            bend: self.plane.outwards * 0.035 - self.plane.up * 0.012,
            radii_m: Vec2::splat(0.017),
            side: self.plane.up,
            edge_m: 0.012,
            dark_base: 0.6,
        }
        .mesh();
        let hand = Weights::one(rig.wings[0].hand);
        mesh.set_weights(|_| hand.clone());
        mesh.smooth_normals();
        mesh
    }

    fn finger(&self, index: usize, share: f32) -> Vec3 {
        anatomy::finger(&self.plane, index, share)
    }

    /// Shoulder (0) over elbow to wrist (1).
    fn arm_place(&self, share: f32) -> Vec3 {
        self.arm.loft.section(self.arm_length_m(share)).centre
    }

    fn arm_weights(&self, share: f32) -> Weights {
        self.arm.weights_at(self.arm_length_m(share))
    }

    fn arm_length_m(&self, share: f32) -> f32 {
        const _: () = assert!(WING_ELBOW_ROW < WING_WRIST_ROW && WING_WRIST_ROW < WING_ARM.len());
        self.arm.loft.length_at_station(1.0 + (WING_WRIST_ROW - 1) as f32 * share)
    }
}

fn bone_tube(loft: &Loft, edge_m: f32, island: Island) -> Mesh {
    Tube {
        loft,
        from_m: 0.0,
        to_m: loft.length_m(),
        edge_m: &|_| edge_m,
        caps: [true, true],
        island,
        skin: Skin::Hide,
        paint: &|s_m, angle| Shading::WING.hide_paint(s_m, angle, 0.0, 0.0),
    }
    .mesh()
}
