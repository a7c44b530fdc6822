//! Poses on the time grid: the local transforms of all bones of an instance at a grid step, for a skeleton without a clip. Each
//! pose can be decoded by itself, whatever was lost before it.
//!
//! A rotation is the three smallest of its four numbers; the largest follows from unit length. A translation is fixed-point
//! within a power of two that the pose has for all its bones. Distant or scaled bones are written in full.

use super::bits::{BitReader, BitWriter};
use crate::ids::InstanceId;
use crate::limits::{MAX_COORDINATE_M, MAX_INSTANCES, MAX_MORPHS, MAX_SAMPLE_RING, MAX_SKELETON_BONES};
use crate::time::GridIndex;
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, put_zigzag};
use std::f64::consts::SQRT_2;

/// Bits of which number of a rotation is the largest.
const LARGEST_BITS: u32 = 2;
/// Bits of each of the others, and steps from 0 to the largest that they can be, 1 / sqrt(2). Zero is one of the values.
const ROTATION_BITS: u32 = 17;
const ROTATION_STEPS: f64 = 65_535.0;
/// Bits of a coordinate of a translation, and steps from 0 to the pose's range.
const TRANSLATION_BITS: u32 = 16;
const TRANSLATION_STEPS: f64 = 32_767.0;
/// The range of a pose is a power of two, from 2 to the power of this less ..
const EXPONENT_BIAS: i32 = 32;
/// .. to that of this, which holds all coordinates.
const MAX_EXPONENT: i32 = 20;
/// Of so many bones one may be written in full so that the others have a smaller range ..
const BONES_PER_FAR_ONE: usize = 32;
/// .. by at least this factor, as a power of two.
const FAR_EXPONENT: i32 = 3;
/// A scale that is nearer to 1 is 1: at 10 m from the bone it moves nothing by more than 0.01 mm.
const SCALE_IS_ONE: f32 = 1e-6;
/// Least bytes of a bone: its bits rounded down.
const LEAST_BONE_BYTES: usize =
    ((LARGEST_BITS + 3 * ROTATION_BITS + 3 * TRANSLATION_BITS + 1) / u8::BITS) as usize;
/// What heads a pose, about, bytes.
const HEAD_BYTES: usize = 9;
const WHAT: &str = "a pose on the grid";

/// The local transform of a bone: as `Trs` of a scene, without a rule for what it is applied to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BonePose {
    /// In units of the parent bone.
    pub translation: [f32; 3],
    /// A quaternion's xyzw, of unit length.
    pub rotation: [f32; 4],
    /// Along the bone's own axes.
    pub scale: [f32; 3],
}

/// A skeleton at a step of the time grid.
#[derive(Clone, Debug, PartialEq)]
pub struct GridPose {
    /// Whose.
    pub instance: InstanceId,
    /// When.
    pub grid: GridIndex,
    /// By bone, in the order of the instance's skeleton.
    pub bones: Vec<BonePose>,
    /// By morph target.
    pub weights: Vec<f32>,
}

/// Bytes that a pose takes on the wire, about.
pub fn pose_bytes(bones: u32, morphs: u32) -> usize {
    (LEAST_BONE_BYTES + 1) * bones as usize + 4 * morphs as usize + HEAD_BYTES
}

/// Appends poses.
pub(super) fn put_poses(out: &mut Vec<u8>, poses: &[GridPose]) {
    put_varint(out, poses.len() as u32);
    poses.iter().for_each(|pose| pose.put(out));
}

/// Reads what [`put_poses`] wrote, to the end.
pub(super) fn take_poses(bytes: &[u8]) -> Result<Vec<GridPose>, WireError> {
    let mut reader = Reader::new("poses on the grid", bytes);
    let most = (MAX_INSTANCES * MAX_SAMPLE_RING) as usize;
    let count = reader.count(most, 5)?;
    let mut poses = Vec::new();
    for _ in 0..count {
        poses.push(GridPose::take(&mut reader)?);
    }
    reader.finish()?;
    Ok(poses)
}

impl GridPose {
    fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, u32::from(self.instance.0));
        put_zigzag(out, self.grid.0);
        put_varint(out, self.bones.len() as u32);
        put_varint(out, self.weights.len() as u32);
        let exponent = range_exponent(&self.bones);
        out.push((exponent + EXPONENT_BIAS) as u8);
        self.weights.iter().for_each(|weight| out.extend_from_slice(&sound(*weight).to_le_bytes()));
        let mut bits = BitWriter::new(out);
        self.bones.iter().for_each(|bone| put_bone(&mut bits, bone, exponent));
        bits.finish();
    }

    fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let number = check_count(WHAT, reader.varint()? as usize, MAX_INSTANCES as usize - 1)?;
        let (instance, grid) = (InstanceId(number as u16), GridIndex(reader.zigzag()?));
        let bones = reader.count(MAX_SKELETON_BONES as usize, LEAST_BONE_BYTES)?;
        let morphs = reader.count(MAX_MORPHS as usize, 4)?;
        let exponent = i32::from(reader.u8()?) - EXPONENT_BIAS;
        if exponent > MAX_EXPONENT {
            return Err(invalid(WHAT, format!("its range is 2 to the power of {exponent}")));
        }
        let weights = (0..morphs).map(|_| checked(reader.f32()?)).collect::<Result<Vec<f32>, WireError>>()?;
        let bytes = reader.rest();
        let mut bits = BitReader::new(WHAT, bytes);
        let bones = (0..bones).map(|_| take_bone(&mut bits, exponent)).collect::<Result<_, WireError>>()?;
        *reader = Reader::new("poses on the grid", &bytes[bits.bytes_read()..]);
        Ok(Self { instance, grid, bones, weights })
    }
}

/// The least power of two within which translations are, or all but some that are much further away.
fn range_exponent(bones: &[BonePose]) -> i32 {
    let reach =
        |bone: &BonePose| bone.translation.map(|axis| sound(axis).abs()).into_iter().fold(0.0, f32::max);
    let mut reaches: Vec<f32> = bones.iter().map(reach).collect();
    reaches.sort_by(|a, b| b.total_cmp(a));
    let exponent = |place: usize| reaches.get(place).map_or(-EXPONENT_BIAS, |reach| power_above(*reach));
    let [all, most] = [exponent(0), exponent(bones.len().div_ceil(BONES_PER_FAR_ONE))];
    if all - most >= FAR_EXPONENT { most } else { all }
}

fn power_above(reach: f32) -> i32 {
    let exponent = f64::from(reach).log2().ceil();
    exponent.clamp(f64::from(-EXPONENT_BIAS), f64::from(MAX_EXPONENT)) as i32
}

fn range(exponent: i32) -> f64 {
    f64::from(exponent).exp2()
}

fn put_bone(bits: &mut BitWriter<'_>, bone: &BonePose, exponent: i32) {
    let range = range(exponent);
    let is_far = bone.translation.iter().any(|axis| f64::from(sound(*axis).abs()) > range);
    let is_full = is_far || bone.scale.iter().any(|axis| (axis - 1.0).abs() > SCALE_IS_ONE);
    bits.put(u32::from(is_full), 1);
    if is_full {
        let numbers = bone.translation.iter().chain(&bone.scale);
        numbers.for_each(|number| bits.put(sound(*number).to_bits(), u32::BITS));
    } else {
        for axis in bone.translation {
            let steps = (f64::from(sound(axis)) / range * TRANSLATION_STEPS).round();
            bits.put((steps + TRANSLATION_STEPS) as u32, TRANSLATION_BITS);
        }
    }
    put_rotation(bits, bone.rotation);
}

fn take_bone(bits: &mut BitReader<'_>, exponent: i32) -> Result<BonePose, WireError> {
    let (mut translation, mut scale) = ([0.0; 3], [1.0; 3]);
    if bits.take(1)? == 1 {
        for number in translation.iter_mut().chain(&mut scale) {
            *number = checked(f32::from_bits(bits.take(u32::BITS)?))?;
        }
    } else {
        for axis in &mut translation {
            let steps = f64::from(bits.take(TRANSLATION_BITS)?) - TRANSLATION_STEPS;
            *axis = (steps / TRANSLATION_STEPS * range(exponent)) as f32;
        }
    }
    Ok(BonePose { translation, rotation: take_rotation(bits)?, scale })
}

fn put_rotation(bits: &mut BitWriter<'_>, rotation: [f32; 4]) {
    let rotation = rotation.map(f64::from);
    let length = rotation.iter().map(|number| number * number).sum::<f64>().sqrt();
    let is_sound = length.is_finite() && length > 0.0;
    let rotation = if is_sound { rotation.map(|number| number / length) } else { [0.0, 0.0, 0.0, 1.0] };
    let largest = (0..4).fold(0, |a, b| if rotation[b].abs() > rotation[a].abs() { b } else { a });
    bits.put(largest as u32, LARGEST_BITS);
    // Of a rotation and its negative, which are the same, the one whose largest number is positive.
    let sign = rotation[largest].signum();
    for other in (0..4).filter(|other| *other != largest) {
        let steps = (rotation[other] * sign * SQRT_2 * ROTATION_STEPS).round();
        bits.put((steps + ROTATION_STEPS).clamp(0.0, 2.0 * ROTATION_STEPS) as u32, ROTATION_BITS);
    }
}

fn take_rotation(bits: &mut BitReader<'_>) -> Result<[f32; 4], WireError> {
    let largest = bits.take(LARGEST_BITS)? as usize;
    let (mut rotation, mut squares) = ([0.0; 4], 0.0);
    for other in (0..4).filter(|other| *other != largest) {
        let number = (f64::from(bits.take(ROTATION_BITS)?) - ROTATION_STEPS) / ROTATION_STEPS / SQRT_2;
        squares += number * number;
        rotation[other] = number as f32;
    }
    if squares > 1.0 {
        return Err(invalid(WHAT, "a rotation is of more than unit length"));
    }
    rotation[largest] = (1.0 - squares).sqrt() as f32;
    Ok(rotation)
}

/// A number that [`checked`] takes: what is none becomes 0, what is too far away comes nearer.
fn sound(number: f32) -> f32 {
    if number.is_nan() { 0.0 } else { number.clamp(-MAX_COORDINATE_M, MAX_COORDINATE_M) }
}

fn checked(number: f32) -> Result<f32, WireError> {
    match number.abs() <= MAX_COORDINATE_M {
        true => Ok(number),
        false => Err(invalid(WHAT, format!("a number in it is not within {MAX_COORDINATE_M}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Dice, damaged};
    use glam::{Quat, Vec3};

    fn unit(dice: &mut Dice) -> [f32; 4] {
        let mut number = || dice.signed_unit() as f32;
        Quat::from_xyzw(number(), number(), number(), number()).normalize().to_array()
    }

    fn pose(seed: u64, bones: usize, reach: f64, scaled_in: u64) -> GridPose {
        let mut dice = Dice::new(seed);
        let bones = (0..bones).map(|_| BonePose {
            translation: [0; 3].map(|_: i32| (dice.signed_unit() * reach) as f32),
            rotation: unit(&mut dice),
            scale: if dice.once_in(scaled_in) { [1.5, 0.25, -2.0] } else { [1.0; 3] },
        });
        let (bones, weights) = (bones.collect(), vec![0.25, -1.5, 1e-7]);
        GridPose { instance: InstanceId(300), grid: GridIndex(-5), bones, weights }
    }

    fn bytes_of(poses: &[GridPose]) -> Vec<u8> {
        let mut bytes = Vec::new();
        put_poses(&mut bytes, poses);
        bytes
    }

    fn back(pose: &GridPose) -> GridPose {
        take_poses(&bytes_of(std::slice::from_ref(pose))).expect("just encoded").remove(0)
    }

    fn angle(a: &BonePose, b: &BonePose) -> f64 {
        // Of the difference's sine: the cosine of so small an angle says nothing.
        let [a, b] = [a, b].map(|bone| Quat::from_array(bone.rotation).as_dquat().normalize());
        let off = a.conjugate() * b;
        2.0 * off.xyz().length().min(1.0).asin()
    }

    #[test]
    fn poses_come_back_within_half_a_step() {
        for (seed, reach) in [(1, 0.3), (2, 1.0), (3, 70.0), (4, 0.004), (5, 1e6)] {
            let pose = pose(seed, 400, reach, 9);
            let found = back(&pose);
            assert_eq!(
                (found.instance, found.grid, &found.weights),
                (pose.instance, pose.grid, &pose.weights)
            );
            for (bone, found) in pose.bones.iter().zip(&found.bones) {
                let [a, b] = [bone, found].map(|bone| Vec3::from(bone.translation).as_dvec3());
                // A power of two is at most twice as far as it must reach.
                assert!(
                    (a - b).abs().max_element() <= 2.0 * reach / TRANSLATION_STEPS * 0.51,
                    "{bone:?} {found:?}"
                );
                assert!(angle(bone, found) < 3e-5, "{bone:?} {found:?}");
                assert_eq!(bone.scale, found.scale);
            }
        }
    }

    #[test]
    fn a_bone_that_stands_at_rest_comes_back_as_it_was() {
        let rest = BonePose { translation: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], scale: [1.0; 3] };
        let half_turn = BonePose { rotation: [0.0, 1.0, 0.0, 0.0], ..rest };
        let pose = GridPose { bones: vec![rest, half_turn], ..pose(1, 0, 1.0, 2) };
        assert_eq!(back(&pose), pose);
    }

    #[test]
    fn one_bone_far_away_spoils_no_other() {
        let mut pose = pose(8, 60, 0.1, u64::MAX);
        pose.bones[7].translation = [900.0, -3.0, 0.125];
        let found = back(&pose);
        assert_eq!(found.bones[7].translation, pose.bones[7].translation);
        for (bone, found) in pose.bones.iter().zip(&found.bones) {
            let off = Vec3::from(bone.translation).distance(Vec3::from(found.translation));
            assert!(off < 1e-5, "{off}");
        }
    }

    #[test]
    fn a_dragon_takes_less_than_thirteen_bytes_a_bone() {
        let pose = pose(2, 136, 0.4, u64::MAX);
        let bytes = bytes_of(&[GridPose { weights: Vec::new(), ..pose }]).len();
        assert!(bytes < 136 * 13 && bytes <= pose_bytes(136, 0), "{bytes}");
    }

    #[test]
    fn what_no_pose_can_be_is_written_as_one_that_can() {
        let bad = BonePose {
            translation: [f32::NAN, f32::INFINITY, -4e9],
            rotation: [f32::NAN, 0.0, 0.0, 0.0],
            scale: [f32::NEG_INFINITY, 1.0, 1.0],
        };
        let found = back(&GridPose { bones: vec![bad], weights: vec![f32::NAN], ..pose(1, 0, 1.0, 2) });
        assert_eq!(found.bones[0].translation, [0.0, MAX_COORDINATE_M, -MAX_COORDINATE_M]);
        assert_eq!((found.bones[0].rotation, found.weights), ([0.0, 0.0, 0.0, 1.0], vec![0.0]));
    }

    #[test]
    fn damaged_poses_give_values_or_errors() {
        let poses = [pose(3, 40, 2.0, 5), pose(4, 7, 0.1, 2), pose(5, 0, 1.0, 2)];
        let bytes = bytes_of(&poses);
        let is_sound = |pose: &GridPose| {
            pose.bones.iter().all(|bone| {
                let length = bone.rotation.iter().map(|number| number * number).sum::<f32>();
                bone.translation.iter().chain(&bone.scale).all(|number| number.is_finite())
                    && (length - 1.0).abs() < 1e-4
            })
        };
        damaged(&bytes, 7, 20_000, |bytes| {
            assert!(
                take_poses(bytes).is_ok_and(|poses| poses.iter().all(is_sound)) || take_poses(bytes).is_err()
            );
        });
        (0..bytes.len()).for_each(|length| assert!(take_poses(&bytes[..length]).is_err()));
    }
}
