//! The skeleton: 136 joints with their places, and typed access to them.

use super::anatomy::{self, FINGER_BONES, LEG_BONE_ROWS, WingPlane, spine_row};
use super::loft::{Loft, Station};
use super::weights::{Chain, Limb, Shading};
use glam::{Quat, Vec2, Vec3};

pub(super) const SPINE_JOINTS: usize = 3;
pub(super) const NECK_JOINTS: usize = 10;
pub(super) const TAIL_JOINTS: usize = 22;
pub(super) const TOES: usize = 4;
pub(super) const FINGERS: usize = 4;

/// One joint in the pose in which the skin was made.
#[derive(Clone, Debug)]
pub(super) struct Joint {
    pub name: String,
    pub parent: Option<usize>,
    /// Model space, metres.
    pub position: Vec3,
    /// Model from joint; y points along the bone.
    pub rotation: Quat,
}

#[derive(Clone, Debug)]
pub(super) struct Leg {
    /// Upper leg, lower leg, ankle, foot.
    pub bones: [usize; 4],
    pub toes: [[usize; 2]; TOES],
}

#[derive(Clone, Debug)]
pub(super) struct Wing {
    pub root: usize,
    pub upper: usize,
    pub fore: usize,
    pub hand: usize,
    pub fingers: [[usize; 4]; FINGERS],
}

/// Joints by meaning. Pairs are left, right; legs are fore left, fore right, hind left, hind right.
#[derive(Clone, Debug)]
pub(super) struct Rig {
    pub joints: Vec<Joint>,
    /// For each joint the one on the other side (itself in the middle).
    pub mirror: Vec<usize>,
    pub root: usize,
    pub pelvis: usize,
    pub spine: [usize; SPINE_JOINTS],
    pub chest: usize,
    pub ribs: usize,
    pub neck: [usize; NECK_JOINTS],
    pub head: usize,
    pub jaw: [usize; 2],
    pub tongue: [usize; 2],
    pub eyes: [usize; 2],
    pub ears: [usize; 2],
    pub tail: [usize; TAIL_JOINTS],
    pub legs: [Leg; 4],
    pub wings: [Wing; 2],
}

/// Centre of the left eye.
pub(super) const EYE: Vec3 = Vec3::new(0.081, 1.816, 1.008);
/// Root of the left ear.
pub(super) const EAR: Vec3 = Vec3::new(0.090, 1.775, 0.887);

impl Rig {
    pub fn new(spine: &Loft) -> Self {
        Builder { joints: Vec::new() }.build(spine)
    }

    /// The trunk's tube with the chain of joints from tail tip to head.
    pub fn spine_limb(&self, loft: Loft) -> Limb {
        let marks = SpineMarks::new(&loft);
        let tail = (0..TAIL_JOINTS).rev().map(|i| (marks.tail_m(i + 1), self.tail[i]));
        let trunk = [self.pelvis, self.spine[0], self.spine[1], self.spine[2], self.chest];
        let trunk = (0..trunk.len()).map(|i| (marks.trunk_m(i), trunk[i]));
        let neck = (0..NECK_JOINTS).map(|i| (marks.neck_m(i), self.neck[i]));
        let head = [(marks.neck_m(NECK_JOINTS), self.head)];
        let (mut bounds_m, joints): (Vec<f32>, Vec<usize>) =
            tail.chain(trunk).chain(neck).chain(head).unzip();
        bounds_m.push(loft.length_m());
        let breath = (self.ribs, loft.length_at_station(13.0), 0.38, 0.8);
        Limb {
            loft,
            chain: Chain { bounds_m, joints, softness: 0.5 },
            breath: Some(breath),
            shading: Shading::TRUNK,
        }
    }

    pub fn leg_limb(&self, leg: usize, loft: Loft) -> Limb {
        let mut bounds_m: Vec<f32> = LEG_BONE_ROWS.map(|row| loft.length_at_station(row)).to_vec();
        bounds_m[0] = 0.0;
        bounds_m.push(loft.length_m());
        Limb::new(
            loft,
            Chain { bounds_m, joints: self.legs[leg].bones.to_vec(), softness: 0.35 },
            Shading::LEG,
        )
    }

    pub fn toe_limb(&self, leg: usize, toe: usize, loft: Loft) -> Limb {
        let bounds_m = vec![0.0, 0.55 * loft.length_m(), loft.length_m()];
        Limb::new(
            loft,
            Chain { bounds_m, joints: self.legs[leg].toes[toe].to_vec(), softness: 0.4 },
            Shading::LEG,
        )
    }

    pub fn arm_limb(&self, wing: usize, loft: Loft) -> Limb {
        let row = |row: f32| loft.length_at_station(row);
        let bounds_m = vec![
            0.0,
            row(1.6),
            row(anatomy::WING_ELBOW_ROW as f32),
            row(anatomy::WING_WRIST_ROW as f32),
            loft.length_m(),
        ];
        let wing = &self.wings[wing];
        let joints = vec![wing.root, wing.upper, wing.fore, wing.hand];
        Limb::new(loft, Chain { bounds_m, joints, softness: 0.45 }, Shading::WING)
    }

    /// Weights along a finger; lengths are shares of it, 0 wrist to 1 tip.
    pub fn finger_chain(&self, wing: usize, finger: usize) -> Chain {
        let mut bounds_m = FINGER_BONES.to_vec();
        bounds_m.push(1.0);
        Chain { bounds_m, joints: self.wings[wing].fingers[finger].to_vec(), softness: 0.5 }
    }

    pub fn jaw_limb(&self, loft: Loft) -> Limb {
        let bounds_m = vec![0.0, 0.6 * loft.length_m(), loft.length_m()];
        Limb::new(loft, Chain { bounds_m, joints: self.jaw.to_vec(), softness: 0.3 }, Shading::TRUNK)
    }

    pub fn tongue_limb(&self, loft: Loft) -> Limb {
        let bounds_m = vec![0.0, 0.5 * loft.length_m(), loft.length_m()];
        Limb::new(loft, Chain { bounds_m, joints: self.tongue.to_vec(), softness: 0.4 }, Shading::TRUNK)
    }
}

/// Lengths along the spine where joints sit.
struct SpineMarks {
    tail_root_m: f32,
    loin_m: f32,
    chest_m: f32,
    neck_root_m: f32,
    skull_m: f32,
}

impl SpineMarks {
    fn new(spine: &Loft) -> Self {
        Self {
            tail_root_m: spine.length_at_station(spine_row::TAIL_ROOT),
            loin_m: spine.length_at_station(spine_row::LOIN),
            chest_m: spine.length_at_station(spine_row::CHEST),
            neck_root_m: spine.length_at_station(spine_row::NECK_ROOT),
            skull_m: spine.length_at_station(spine_row::SKULL),
        }
    }

    /// Front end of tail joint `i`; its rear end is that of the next.
    fn tail_m(&self, i: usize) -> f32 {
        self.tail_root_m * (1.0 - i as f32 / TAIL_JOINTS as f32)
    }

    /// Rear end of pelvis, the spine joints and the chest.
    fn trunk_m(&self, i: usize) -> f32 {
        match i {
            0 => self.tail_root_m,
            i => self.loin_m + (self.chest_m - self.loin_m) * (i - 1) as f32 / SPINE_JOINTS as f32,
        }
    }

    /// Lower end of neck joint `i`; the last is the skull.
    fn neck_m(&self, i: usize) -> f32 {
        self.neck_root_m + (self.skull_m - self.neck_root_m) * i as f32 / NECK_JOINTS as f32
    }
}

struct Builder {
    joints: Vec<Joint>,
}

impl Builder {
    fn build(mut self, spine_loft: &Loft) -> Rig {
        let marks = SpineMarks::new(spine_loft);
        let on_spine = |s_m: f32| spine_loft.section(s_m).centre;
        let hips = on_spine(0.5 * (marks.tail_root_m + marks.loin_m));
        let root = self.add("root", None, hips);
        let pelvis = self.add("pelvis", Some(root), hips);
        let spine = self.chain("spine", pelvis, |i| on_spine(marks.trunk_m(i + 1)));
        let chest = self.add("chest", Some(spine[SPINE_JOINTS - 1]), on_spine(marks.chest_m));
        let ribs = self.add("ribs", Some(chest), on_spine(spine_loft.length_at_station(13.0)));
        let neck = self.chain("neck", chest, |i| on_spine(marks.neck_m(i)));
        let head = self.add("head", Some(neck[NECK_JOINTS - 1]), on_spine(marks.skull_m));
        let jaw_place = [Vec3::new(0.000, 1.729, 0.876), Vec3::new(0.000, 1.614, 1.157)];
        let jaw = self.chain("jaw", head, |i| jaw_place[i]);
        let tongue_place = [Vec3::new(0.000, 1.691, 0.968), Vec3::new(0.000, 1.663, 1.134)];
        let tongue = self.chain("tongue", jaw[0], |i| tongue_place[i]);
        let eyes = SIDES.map(|side| self.add(&format!("eye_{}", side.name), Some(head), side.of(EYE)));
        let ears = SIDES.map(|side| self.add(&format!("ear_{}", side.name), Some(head), side.of(EAR)));
        let tail = self.chain("tail", pelvis, |i| on_spine(marks.tail_m(i)));
        let [fore_left, fore_right] = SIDES.map(|side| self.leg("fore", chest, side, &anatomy::FORE_LEG));
        let [hind_left, hind_right] = SIDES.map(|side| self.leg("hind", pelvis, side, &anatomy::HIND_LEG));
        let legs = [fore_left, fore_right, hind_left, hind_right];
        let wings = SIDES.map(|side| self.wing(chest, side));
        self.orient();
        let (joints, mirror) = (self.joints.clone(), self.mirror());
        Rig {
            joints,
            mirror,
            root,
            pelvis,
            spine,
            chest,
            ribs,
            neck,
            head,
            jaw,
            tongue,
            eyes,
            ears,
            tail,
            legs,
            wings,
        }
    }

    fn add(&mut self, name: &str, parent: Option<usize>, position: Vec3) -> usize {
        self.joints.push(Joint { name: name.to_owned(), parent, position, rotation: Quat::IDENTITY });
        self.joints.len() - 1
    }

    fn chain<const N: usize>(
        &mut self,
        name: &str,
        parent: usize,
        place: impl Fn(usize) -> Vec3,
    ) -> [usize; N] {
        let mut parent = parent;
        std::array::from_fn(|i| {
            parent = self.add(&format!("{name}_{}", i + 1), Some(parent), place(i));
            parent
        })
    }

    fn leg(&mut self, name: &str, parent: usize, side: Side, stations: &[Station]) -> Leg {
        const BONES: [&str; 4] = ["upper", "lower", "ankle", "foot"];
        let loft = Loft::new(stations, Vec3::X);
        let mut parent = parent;
        let bones = std::array::from_fn(|i| {
            let place = loft.section(loft.length_at_station(LEG_BONE_ROWS[i])).centre;
            parent = self.add(&format!("{name}_{}_{}", BONES[i], side.name), Some(parent), side.of(place));
            parent
        });
        let toes = std::array::from_fn(|toe| {
            let loft = anatomy::toe(stations, toe);
            let place = |i: usize| side.of(loft.section((0.12 + 0.43 * i as f32) * loft.length_m()).centre);
            let first = self.add(&format!("{name}_toe_{}_1_{}", toe + 1, side.name), Some(parent), place(0));
            [first, self.add(&format!("{name}_toe_{}_2_{}", toe + 1, side.name), Some(first), place(1))]
        });
        Leg { bones, toes }
    }

    fn wing(&mut self, chest: usize, side: Side) -> Wing {
        let plane = WingPlane::left();
        let arm = |row: usize| {
            let [a, b, _] = anatomy::WING_ARM[row];
            side.of(plane.place(Vec2::new(a, b), 0.0))
        };
        let name = |part: &str| format!("wing_{part}_{}", side.name);
        let root = self.add(&name("root"), Some(chest), side.of(plane.shoulder));
        let upper = self.add(&name("upper"), Some(root), arm(1).lerp(arm(2), 0.6));
        let fore = self.add(&name("fore"), Some(upper), arm(anatomy::WING_ELBOW_ROW));
        let hand = self.add(&name("hand"), Some(fore), arm(anatomy::WING_WRIST_ROW));
        let fingers = std::array::from_fn(|finger| {
            let mut parent = hand;
            std::array::from_fn(|bone| {
                let place = side.of(anatomy::finger(&plane, finger, FINGER_BONES[bone]));
                parent = self.add(&name(&format!("finger_{}_{}", finger + 1, bone + 1)), Some(parent), place);
                parent
            })
        });
        Wing { root, upper, fore, hand, fingers }
    }

    /// Turns every joint's y along its bone: to the first child, or on from the parent where there is none.
    fn orient(&mut self) {
        for i in 0..self.joints.len() {
            let here = self.joints[i].position;
            let child = self.joints.iter().find(|joint| joint.parent == Some(i) && joint.position != here);
            let parent = self.joints[i].parent.map(|parent| self.joints[parent].position);
            let along = match (child, parent) {
                (Some(child), _) => child.position - here,
                (None, Some(parent)) => here - parent,
                (None, None) => Vec3::Y,
            };
            self.joints[i].rotation = along
                .try_normalize()
                .map_or(Quat::IDENTITY, |along| Quat::from_rotation_arc(Vec3::Y, along).normalize());
        }
    }

    fn mirror(&self) -> Vec<usize> {
        let other = |name: &str| match (name.strip_suffix("_l"), name.strip_suffix("_r")) {
            (Some(stem), _) => format!("{stem}_r"),
            (_, Some(stem)) => format!("{stem}_l"),
            _ => name.to_owned(),
        };
        let find = |joint: &Joint| self.joints.iter().position(|o| o.name == other(&joint.name));
        self.joints.iter().enumerate().map(|(i, joint)| find(joint).unwrap_or(i)).collect()
    }
}

#[derive(Clone, Copy)]
struct Side {
    name: &'static str,
    sign: f32,
}

const SIDES: [Side; 2] = [Side { name: "l", sign: 1.0 }, Side { name: "r", sign: -1.0 }];

impl Side {
    fn of(self, place: Vec3) -> Vec3 {
        Vec3::new(self.sign * place.x, place.y, place.z)
    }
}
