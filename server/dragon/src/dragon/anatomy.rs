//! The dragon's measures: every hand-placed number of its shape, and the tubes made of them.
//!
//! Model space, metres: y up, the dragon looks along +z, its left is +x. Tables are for the left side.
//! [`CENTRING_Z_M`] moves everything so that the finished mesh lies centred above the origin.

use super::loft::{Loft, Station};
use super::mesh::Island;
use glam::{Vec2, Vec3};

/// Side of the square texture, texels.
pub(super) const TEXTURE_TEXELS: u32 = 1024;

/// Added to z of everything at the end.
pub(super) const CENTRING_Z_M: f32 = 0.379;
/// Added to y of everything at the end: brings the lowest claw to the floor.
pub(super) const CENTRING_Y_M: f32 = -0.002;

/// Tail tip to snout.
pub(super) const SPINE: [Station; 30] = [
    [0.0, 0.600, -2.13, 0.006, 0.005, 0.005],
    [0.0, 0.540, -2.06, 0.060, 0.010, 0.010],
    [0.0, 0.468, -1.97, 0.104, 0.014, 0.014],
    [0.0, 0.432, -1.92, 0.034, 0.017, 0.017],
    [0.0, 0.388, -1.85, 0.022, 0.024, 0.024],
    [0.0, 0.319, -1.70, 0.032, 0.034, 0.034],
    [0.0, 0.275, -1.45, 0.046, 0.049, 0.049],
    [0.0, 0.305, -1.20, 0.065, 0.068, 0.065],
    [0.0, 0.395, -0.95, 0.089, 0.091, 0.087],
    [0.0, 0.515, -0.72, 0.121, 0.122, 0.118],
    [0.0, 0.635, -0.50, 0.162, 0.158, 0.158],
    [0.0, 0.705, -0.28, 0.188, 0.176, 0.190],
    [0.0, 0.750, -0.05, 0.200, 0.186, 0.208],
    [0.0, 0.800, 0.20, 0.220, 0.198, 0.252],
    [0.0, 0.870, 0.42, 0.204, 0.184, 0.258],
    [0.0, 0.985, 0.585, 0.156, 0.148, 0.205],
    [0.0, 1.125, 0.695, 0.120, 0.118, 0.142],
    [0.0, 1.275, 0.748, 0.098, 0.100, 0.110],
    [0.0, 1.420, 0.745, 0.085, 0.088, 0.092],
    [0.0, 1.555, 0.728, 0.077, 0.081, 0.083],
    [0.0, 1.672, 0.758, 0.076, 0.080, 0.078],
    [0.0, 1.758, 0.870, 0.090, 0.085, 0.078],
    [0.0, 1.786, 0.968, 0.106, 0.092, 0.067],
    [0.0, 1.781, 1.048, 0.101, 0.081, 0.053],
    [0.0, 1.760, 1.123, 0.081, 0.062, 0.044],
    [0.0, 1.737, 1.203, 0.070, 0.054, 0.037],
    [0.0, 1.714, 1.282, 0.069, 0.055, 0.034],
    [0.0, 1.696, 1.336, 0.057, 0.046, 0.030],
    [0.0, 1.684, 1.367, 0.032, 0.025, 0.018],
    [0.0, 1.682, 1.374, 0.007, 0.006, 0.005],
];

/// Rows of [`SPINE`] (fractions between rows) where one region goes over into the next.
pub(super) mod spine_row {
    pub const TAIL_ROOT: f32 = 9.6;
    pub const LOIN: f32 = 10.8;
    pub const CHEST: f32 = 13.2;
    pub const NECK_ROOT: f32 = 15.0;
    pub const SKULL: f32 = 20.6;
    pub const NOSTRILS: f32 = 26.6;
}

pub(super) const JAW: [Station; 8] = [
    [0.0, 1.721, 0.847, 0.046, 0.023, 0.028],
    [0.0, 1.706, 0.903, 0.076, 0.025, 0.037],
    [0.0, 1.675, 0.980, 0.085, 0.021, 0.041],
    [0.0, 1.638, 1.079, 0.071, 0.016, 0.034],
    [0.0, 1.606, 1.178, 0.055, 0.014, 0.028],
    [0.0, 1.583, 1.265, 0.051, 0.014, 0.025],
    [0.0, 1.574, 1.315, 0.034, 0.014, 0.018],
    [0.0, 1.574, 1.333, 0.007, 0.005, 0.005],
];

pub(super) const TONGUE: [Station; 5] = [
    [0.0, 1.691, 0.956, 0.023, 0.010, 0.010],
    [0.0, 1.671, 1.065, 0.030, 0.010, 0.010],
    [0.0, 1.657, 1.162, 0.028, 0.009, 0.009],
    [0.0, 1.643, 1.232, 0.021, 0.007, 0.007],
    [0.0, 1.629, 1.275, 0.006, 0.003, 0.003],
];

pub(super) const HIND_LEG: [Station; 10] = [
    [0.087, 0.696, -0.400, 0.084, 0.126, 0.126],
    [0.158, 0.639, -0.375, 0.118, 0.168, 0.158],
    [0.230, 0.522, -0.285, 0.109, 0.149, 0.138],
    [0.273, 0.413, -0.215, 0.078, 0.092, 0.088],
    [0.279, 0.319, -0.285, 0.059, 0.063, 0.078],
    [0.275, 0.222, -0.405, 0.045, 0.048, 0.053],
    [0.275, 0.135, -0.385, 0.041, 0.043, 0.043],
    [0.277, 0.080, -0.335, 0.048, 0.046, 0.042],
    [0.279, 0.044, -0.295, 0.052, 0.036, 0.036],
    [0.281, 0.034, -0.262, 0.020, 0.014, 0.014],
];

pub(super) const FORE_LEG: [Station; 10] = [
    [0.092, 0.823, 0.350, 0.079, 0.105, 0.105],
    [0.168, 0.748, 0.385, 0.103, 0.139, 0.126],
    [0.237, 0.611, 0.362, 0.086, 0.111, 0.109],
    [0.275, 0.478, 0.315, 0.063, 0.074, 0.080],
    [0.286, 0.363, 0.345, 0.051, 0.057, 0.063],
    [0.288, 0.235, 0.390, 0.043, 0.045, 0.047],
    [0.288, 0.137, 0.410, 0.041, 0.042, 0.042],
    [0.290, 0.080, 0.428, 0.047, 0.046, 0.042],
    [0.292, 0.044, 0.460, 0.051, 0.036, 0.036],
    [0.292, 0.034, 0.490, 0.020, 0.014, 0.014],
];

/// Fillet where a limb joins the trunk, metres.
pub(super) const LIMB_FILLET_M: f32 = 0.07;
/// Bone weights change over from trunk to limb in this zone, to either side, metres.
pub(super) const LIMB_CHANGEOVER_M: f32 = 0.085;

/// Rows of a leg's table where its four bones begin; the last one ends with the table.
pub(super) const LEG_BONE_ROWS: [f32; 4] = [0.7, 3.0, 5.2, 7.6];

/// Directions of the toes in the floor's plane, degrees from forwards to the outside. The last one is the spur.
pub(super) const TOE_YAW_DEG: [f32; 4] = [-26.0, 4.0, 34.0, 172.0];
/// Lengths of the toes, metres, without claws.
pub(super) const TOE_LENGTH_M: [f32; 4] = [0.118, 0.135, 0.118, 0.085];

/// The wing's plane: a runs outwards, b forwards, in metres from the shoulder.
pub(super) struct WingPlane {
    pub shoulder: Vec3,
    pub outwards: Vec3,
    pub forwards: Vec3,
    pub up: Vec3,
}

/// Angle of the resting wing above the horizon, degrees.
const WING_RISE_DEG: f32 = 24.0;
/// How far the leading edge is above the trailing one, degrees.
const WING_PITCH_DEG: f32 = 9.0;
/// Height of the wing's vault between root and tip, metres.
const WING_VAULT_M: f32 = 0.085;

impl WingPlane {
    pub fn left() -> Self {
        let rise = WING_RISE_DEG.to_radians();
        let outwards = Vec3::new(rise.cos(), rise.sin(), 0.0);
        let forwards = glam::Quat::from_axis_angle(outwards, -WING_PITCH_DEG.to_radians()) * Vec3::Z;
        Self { shoulder: Vec3::new(0.12, 0.970, 0.32), outwards, forwards, up: forwards.cross(outwards) }
    }

    /// A place on the vaulted wing surface, raised by `lift_m`.
    pub fn place(&self, plan: Vec2, lift_m: f32) -> Vec3 {
        let reach = plan.length().min(1.0);
        let vault = WING_VAULT_M * 4.0 * reach * (1.0 - reach);
        self.shoulder + self.outwards * plan.x + self.forwards * plan.y + self.up * (vault + lift_m)
    }

    /// The inverse of [`Self::place`], without the height.
    pub fn plan(&self, place: Vec3) -> Vec2 {
        let offset = place - self.shoulder;
        Vec2::new(offset.dot(self.outwards), offset.dot(self.forwards))
    }
}

/// Upper arm and forearm: a, b, radius. Elbow and wrist are rows 3 and 5.
pub(super) const WING_ARM: [[f32; 3]; 7] = [
    [-0.070, 0.000, 0.050],
    [0.000, 0.000, 0.060],
    [0.100, -0.050, 0.052],
    [0.215, -0.095, 0.041],
    [0.295, 0.040, 0.036],
    [0.365, 0.175, 0.030],
    [0.385, 0.205, 0.012],
];
pub(super) const WING_ELBOW_ROW: usize = 3;
pub(super) const WING_WRIST_ROW: usize = 5;

/// Finger tips (a, b), leading one first; it is 1 m from the shoulder.
pub(super) const FINGER_TIPS: [[f32; 2]; 4] =
    [[0.992, 0.126], [0.890, -0.440], [0.575, -0.790], [0.195, -0.860]];
/// How far the fingers bow, forwards for the first, to the outside for the others, metres.
pub(super) const FINGER_BOW_M: [f32; 4] = [0.090, 0.085, 0.085, 0.075];
/// Where the four bones of a finger begin, as shares of its length.
pub(super) const FINGER_BONES: [f32; 4] = [0.0, 0.28, 0.53, 0.77];
/// Where the membrane is grown to the body: shoulder, flank, loin.
pub(super) const FLANK: [[f32; 3]; 3] =
    [[0.110, 0.965, 0.320], [0.125, 0.892, 0.020], [0.105, 0.800, -0.360]];

/// Islands of the texture, see `tests::islands_do_not_overlap`.
pub(super) mod island {
    use super::{Island, Vec2};

    const fn at(x: f32, centre_y: f32, texels_per_m: f32) -> Island {
        Island { origin: Vec2::new(x, centre_y), texels_per_m }
    }

    pub const TRUNK: Island = at(6.0, 224.0, 300.0);
    pub const TAIL: Island = at(6.0, 591.0, 300.0);
    pub const HIND_LEG: Island = at(656.0, 152.0, 300.0);
    pub const FORE_LEG: Island = at(656.0, 428.0, 300.0);
    pub const HEAD: Island = at(656.0, 692.0, 440.0);
    pub const JAW: Island = at(656.0, 926.0, 350.0);
    pub const WING_ARM: Island = at(541.0, 482.0, 140.0);
    pub const FINGER: Island = at(541.0, 522.0, 105.0);
    pub const TOE: Island = at(541.0, 580.0, 400.0);
    pub const TONGUE: Island = at(541.0, 650.0, 220.0);
    pub const EYE: Vec2 = Vec2::new(580.0, 702.0);
    pub const EYE_RADIUS: f32 = 22.0;
    pub const EYELID: Vec2 = Vec2::new(627.0, 702.0);
    pub const EYELID_TEXELS_PER_M: f32 = 260.0;
    pub const HORN: Vec2 = Vec2::new(948.0, 692.0);
    pub const HORN_LENGTH: f32 = 60.0;
    pub const EAR: [Vec2; 2] = [Vec2::new(945.0, 888.0), Vec2::new(945.0, 970.0)];
    pub const EAR_TEXELS_PER_M: f32 = 260.0;
    pub const WING: [Vec2; 2] = [Vec2::new(36.0, 796.0), Vec2::new(332.0, 796.0)];
    pub const WING_TEXELS_PER_M: f32 = 248.0;
}

/// The tube from tail tip to snout.
pub(super) fn spine() -> Loft {
    Loft::new(&SPINE, Vec3::X)
}

/// Upper arm and forearm of the left wing.
pub(super) fn wing_arm(plane: &WingPlane) -> Loft {
    let station = |row: &[f32; 3]| {
        let centre = plane.place(Vec2::new(row[0], row[1]), 0.0);
        [centre.x, centre.y, centre.z, row[2], row[2], row[2]]
    };
    Loft::new(&WING_ARM.each_ref().map(station), plane.up)
}

/// Centre line of a finger of the left wing; `share` runs from wrist (0) to tip (1).
pub(super) fn finger(plane: &WingPlane, index: usize, share: f32) -> Vec3 {
    let wrist = Vec2::new(WING_ARM[WING_WRIST_ROW][0], WING_ARM[WING_WRIST_ROW][1]);
    let tip = Vec2::from_array(FINGER_TIPS[index]);
    let bow = (tip - wrist).perp().normalize() * FINGER_BOW_M[index];
    let middle = 0.5 * (wrist + tip) + bow;
    let plan = wrist.lerp(middle, share).lerp(middle.lerp(tip, share), share);
    plane.place(plan, 0.0)
}

/// The tube around a finger.
pub(super) fn finger_loft(plane: &WingPlane, index: usize) -> Loft {
    const ROWS: usize = 9;
    const ROOT_RADIUS_M: f32 = 0.021;
    const TIP_RADIUS_M: f32 = 0.004;
    let station = |row: usize| {
        let share = row as f32 / (ROWS - 1) as f32;
        let centre = finger(plane, index, share);
        let radius = crate::curve::lerp(ROOT_RADIUS_M, TIP_RADIUS_M, share.powf(0.7));
        [centre.x, centre.y, centre.z, radius, radius, radius]
    };
    let stations: [Station; ROWS] = std::array::from_fn(station);
    Loft::new(&stations, plane.up)
}

/// A toe of the left side, from inside the foot to the root of its claw.
pub(super) fn toe(leg: &[Station], index: usize) -> Loft {
    let yaw = TOE_YAW_DEG[index].to_radians();
    let forwards = Vec3::new(yaw.sin(), 0.0, yaw.cos());
    let foot = &leg[leg.len() - 2];
    let base = Vec3::new(foot[0], 0.042, foot[2] - 0.012);
    let station = |share: f32, y: f32, radius: f32| {
        let centre = base + forwards * (share * TOE_LENGTH_M[index]);
        [centre.x, y, centre.z, radius, radius, radius]
    };
    let rows = [
        station(0.0, 0.040, 0.026),
        station(0.35, 0.044, 0.027),
        station(0.7, 0.036, 0.024),
        station(0.95, 0.025, 0.022),
        station(1.08, 0.020, 0.014),
        station(1.12, 0.019, 0.005),
    ];
    Loft::new(&rows, forwards.cross(Vec3::Y) * -1.0)
}
