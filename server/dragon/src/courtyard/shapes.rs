//! Flat and turned pieces of masonry. Texture coordinates are metres of the world, so patterns run on from piece to piece.

use crate::surface::{Surface, surface};
use glam::{Vec2, Vec3};
use std::f32::consts::TAU;

/// Longest side of a cell, metres: with its diagonal still a patch that the atlas likes.
pub(super) const CELL_M: f32 = 0.35;

/// A rectangle that faces the side from which `right` runs to the right where `up` runs up; `texture_m` is a texture's side.
pub(super) fn rectangle(corner: Vec3, right: Vec3, up: Vec3, texture_m: f32) -> Surface {
    let points = |side: Vec3| (side.length() / CELL_M).ceil() as u16 + 1;
    let mut made = surface(points(right), points(up), |u, v| corner + right * u + up * v);
    let (across, along) = (right.normalize(), up.normalize());
    let place = |at: &Vec3| Vec2::new(at.dot(across), -at.dot(along)) / texture_m;
    made.uvs = made.positions.iter().map(place).collect();
    made
}

/// A box without its lower side.
pub(super) fn block(low: Vec3, high: Vec3, texture_m: f32) -> Surface {
    let size = high - low;
    let [x, y, z] = [Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z];
    let mut all = rectangle(low + z, x, y, texture_m);
    all.append(rectangle(low + x, -x, y, texture_m));
    all.append(rectangle(low + x + z, -z, y, texture_m));
    all.append(rectangle(low, z, y, texture_m));
    all.append(rectangle(low + y + z, x, -z, texture_m));
    all
}

/// A four-sided roof over a square of side `2 * half_m` around `middle`, whose y is that of the eaves.
pub(super) fn pyramid(middle: Vec3, half_m: f32, height_m: f32, texture_m: f32) -> Surface {
    let mut all = Surface::default();
    for side in 0..4u8 {
        let turn = glam::Quat::from_rotation_y(f32::from(side) * TAU / 4.0);
        let (out, right) = (turn * Vec3::Z, turn * Vec3::X);
        let points = (2.0 * half_m / CELL_M).ceil() as u16 + 1;
        let point = |u: f32, v: f32| {
            middle
                + out * (half_m * (1.0 - v))
                + right * (half_m * (2.0 * u - 1.0) * (1.0 - v))
                + Vec3::Y * (height_m * v)
        };
        let mut made = surface(points, points, point);
        let normal = (Vec3::Y * half_m + out * height_m).normalize();
        made.normals = vec![normal; made.positions.len()];
        let up = normal.cross(right);
        made.uvs =
            made.positions.iter().map(|at| Vec2::new(at.dot(right), -at.dot(up)) / texture_m).collect();
        all.append(made);
    }
    all
}

/// A body of revolution about the y axis through `foot`; of each point of its outline the radius and the height, upwards on
/// the outer side. Edges of the outline stay sharp.
pub(super) fn turned(foot: Vec3, outline: &[[f32; 2]], around: u16, texture_m: f32) -> Surface {
    let mut all = Surface::default();
    for pair in outline.windows(2) {
        let [[r0, y0], [r1, y1]] = [pair[0], pair[1]];
        let length_m = (r1 - r0).hypot(y1 - y0);
        let along = (length_m / CELL_M).ceil() as u16 + 1;
        let point = |u: f32, v: f32| {
            let (sin, cos) = (TAU * u).sin_cos();
            let radius = r0 + (r1 - r0) * v;
            foot + Vec3::new(radius * sin, y0 + (y1 - y0) * v, radius * cos)
        };
        let mut made = surface(around + 1, along, point);
        // Of a cone, everywhere along a line to its tip, and at the tip too.
        let slope = Vec2::new(y1 - y0, r0 - r1) / length_m;
        let columns = usize::from(around) + 1;
        for (index, normal) in made.normals.iter_mut().enumerate() {
            let (sin, cos) = (TAU * (index % columns) as f32 / f32::from(around)).sin_cos();
            *normal = Vec3::new(slope.x * sin, slope.y, slope.x * cos);
        }
        let around_m = TAU * r0.max(r1);
        let base = Vec2::new(0.0, -y0 / texture_m);
        made.uvs.iter_mut().for_each(|uv| *uv = base + *uv * Vec2::new(around_m, length_m) / texture_m);
        all.append(made);
    }
    all
}

/// A round bar through `points`, with the radius at each; smooth.
pub(super) fn bar(points: &[(Vec3, f32)], around: u16, texture_m: f32) -> Surface {
    let last = points.len() - 1;
    let at = |v: f32| {
        let place = (v * last as f32).clamp(0.0, last as f32);
        let index = (place as usize).min(last - 1);
        let (a, b, t) = (points[index], points[index + 1], place - index as f32);
        (a.0.lerp(b.0, t), a.1 + (b.1 - a.1) * t)
    };
    let axis = (points[last].0 - points[0].0).normalize();
    let across = axis.any_orthonormal_vector();
    let other = axis.cross(across);
    let length_m: f32 = points.windows(2).map(|pair| pair[0].0.distance(pair[1].0)).sum();
    let along = (length_m / 0.25).ceil() as u16 + 1;
    let mut made = surface(around + 1, along.max(points.len() as u16), |u, v| {
        let (middle, radius) = at(v);
        let (sin, cos) = (TAU * u).sin_cos();
        middle + (across * cos + other * sin) * radius
    });
    let around_m = TAU * points[0].1;
    made.uvs.iter_mut().for_each(|uv| *uv *= Vec2::new((around_m / texture_m).ceil(), length_m / texture_m));
    made
}
