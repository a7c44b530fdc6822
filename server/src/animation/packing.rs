//! Packed positions and frames on the GPU: 8 bytes each. A position has 21 bits per axis within a box that its instance never
//! leaves. A normal and a tangent are points of an octahedron (Meyer et al., "On Floating-Point Normal Vectors", 2010). Pure;
//! `saved.glsl` does the same.

use glam::{Vec2, Vec3, Vec4, vec2};
use shadecast_scene::animation::bounds::Bounds;
use shadecast_shaders::constants::POSITION_BITS;
use shadecast_shaders::generated::BoxGpu;

/// Bytes of a position, or of a normal with its tangent.
pub const SAVED_BYTES: u64 = 8;
/// Largest of the numbers that an axis is told by.
const MOST: f32 = ((1 << POSITION_BITS) - 1) as f32;
/// The box is larger than the bounds by this part of them, and by so many metres: bounds are those of rounded numbers.
const MARGIN: f32 = 1e-3;
const MARGIN_M: f32 = 1e-5;
/// Largest number of a coordinate on the octahedron, of a normal and of a tangent, which leaves a bit for the bitangent's side.
const NORMAL_MOST: f32 = 32767.0;
const TANGENT_MOST: f32 = 16383.0;

/// The box that positions within `bounds` are packed in.
pub(crate) fn packing_box(bounds: Bounds) -> BoxGpu {
    if bounds.is_empty() {
        return BoxGpu { origin_m: [0.0; 4], step_m: [1.0; 4] };
    }
    let margin = MARGIN_M + MARGIN * (bounds.high - bounds.low).max_element();
    let bounds = bounds.grown(margin);
    let step_m = (bounds.high - bounds.low) / MOST;
    BoxGpu { origin_m: bounds.low.extend(0.0).to_array(), step_m: step_m.extend(0.0).to_array() }
}

/// A position, metres, in a box.
pub(crate) fn pack_position(within: &BoxGpu, position: Vec3) -> [u32; 2] {
    let (origin, step) = (Vec4::from(within.origin_m).truncate(), Vec4::from(within.step_m).truncate());
    let [x, y, z] = ((position - origin) / step)
        .round()
        .clamp(Vec3::ZERO, Vec3::splat(MOST))
        .to_array()
        .map(|at| at as u32);
    [x | y << POSITION_BITS, y >> (32 - POSITION_BITS) | z << (2 * POSITION_BITS - 32)]
}

/// The position that was packed, to half a step of the box.
pub fn unpack_position(within: &BoxGpu, [low, high]: [u32; 2]) -> Vec3 {
    let mask = (1 << POSITION_BITS) - 1;
    let y = low >> POSITION_BITS | high << (32 - POSITION_BITS);
    let at = [low, y, high >> (2 * POSITION_BITS - 32)].map(|bits| (bits & mask) as f32);
    Vec4::from(within.origin_m).truncate() + Vec3::from(at) * Vec4::from(within.step_m).truncate()
}

/// A normal and a tangent of unit length, whose `w` is the bitangent's side.
pub(crate) fn pack_frame(normal: Vec3, tangent: Vec4) -> [u32; 2] {
    let [nx, ny] = octahedral(normal).to_array().map(|at| (at * NORMAL_MOST).round() as i32 as u32 & 0xffff);
    let [tx, ty] = octahedral(tangent.truncate())
        .to_array()
        .map(|at| ((at * TANGENT_MOST).round() as i32 + TANGENT_MOST as i32) as u32);
    let side = u32::from(tangent.w < 0.0);
    [nx | ny << 16, tx | ty << 15 | side << 30]
}

/// The normal and the tangent that were packed.
pub fn unpack_frame([low, high]: [u32; 2]) -> (Vec3, Vec4) {
    let normal = [low as u16, (low >> 16) as u16].map(|at| f32::from(at as i16) / NORMAL_MOST);
    let tangent = [high & 0x7fff, high >> 15 & 0x7fff].map(|at| (at as f32 - TANGENT_MOST) / TANGENT_MOST);
    let side = if high >> 30 & 1 == 1 { -1.0 } else { 1.0 };
    (direction(normal.into()), direction(tangent.into()).extend(side))
}

/// A direction as a point of the square that an octahedron unfolds to, -1..1.
fn octahedral(direction: Vec3) -> Vec2 {
    let at = direction / direction.abs().element_sum().max(1e-20);
    if at.z >= 0.0 { at.truncate() } else { folded(at.truncate()) }
}

fn direction(at: Vec2) -> Vec3 {
    let z = 1.0 - at.abs().element_sum();
    let beside = if z >= 0.0 { at } else { folded(at) };
    beside.extend(z).normalize()
}

/// What lies on the lower half, outside of the upper half's edges.
fn folded(at: Vec2) -> Vec2 {
    let side = |at: f32| if at >= 0.0 { 1.0 } else { -1.0 };
    vec2((1.0 - at.y.abs()) * side(at.x), (1.0 - at.x.abs()) * side(at.y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    #[test]
    fn positions_come_back_to_half_a_step_anywhere_in_the_box() {
        let mut rng = SmallRng::seed_from_u64(12);
        for case in 0..2000 {
            let mut point =
                |size: f32| Vec3::from_array(std::array::from_fn(|_| rng.random_range(-size..size)));
            let bounds = Bounds::around([point(30.0), point(30.0), point(1e-3)]);
            let within = packing_box(bounds);
            let at = bounds.low.lerp(bounds.high, rng.random_range(0.0..=1.0));
            let error = (unpack_position(&within, pack_position(&within, at)) - at).abs();
            let step = Vec4::from(within.step_m).truncate();
            assert!((error - 0.5 * step).max_element() < 1e-5, "seed 12, case {case}: {error}, step {step}");
            assert!(step.max_element() < 60.0 * 1.01 / MOST);
        }
    }

    #[test]
    fn what_is_outside_of_the_box_lands_on_its_border() {
        let within = packing_box(Bounds { low: Vec3::ZERO, high: Vec3::ONE });
        let at = unpack_position(&within, pack_position(&within, Vec3::new(9.0, -9.0, 0.5)));
        assert!((at - Vec3::new(1.0, 0.0, 0.5)).abs().max_element() < 3e-3, "{at}");
    }

    #[test]
    fn a_box_around_one_point_or_nothing_is_no_trouble() {
        let point = Vec3::new(3.0, -2.0, 7.0);
        let within = packing_box(Bounds::around([point]));
        assert!(unpack_position(&within, pack_position(&within, point)).distance(point) < 1e-6);
        assert_eq!(packing_box(Bounds::EMPTY).step_m, [1.0; 4]);
    }

    #[test]
    fn frames_come_back_within_a_ten_thousandth() {
        let mut rng = SmallRng::seed_from_u64(13);
        for case in 0..5000 {
            let mut unit =
                || Vec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).normalize();
            let (normal, tangent, side) = (unit(), unit(), if case % 2 == 0 { 1.0 } else { -1.0 });
            let (back, turned) = unpack_frame(pack_frame(normal, tangent.extend(side)));
            assert!(back.distance(normal) < 1e-4, "seed 13, case {case}: {normal} {back}");
            assert!(turned.truncate().distance(tangent) < 1.5e-4, "seed 13, case {case}: {tangent} {turned}");
            assert_eq!(turned.w, side);
        }
        for axis in [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z] {
            let (back, turned) = unpack_frame(pack_frame(axis, axis.extend(1.0)));
            assert!(back.distance(axis) < 1e-6 && turned.truncate().distance(axis) < 1e-6, "{axis}");
        }
    }
}
