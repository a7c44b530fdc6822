//! Depth of a video's pictures, and positional time-warp by it. Pure.
//!
//! Depth travels as the luma of a video of half as many pixels a side: the inverse of the distance along the view axis, in 8 bits.
//! The client draws a grid with a vertex at each of its pixels, moved to where the head is now. What a gap between two surfaces
//! uncovers looks as the farther one.

use super::warp::tangents;
use crate::measure::metrics::ProbeView;
use crate::measure::triangle::for_each_pixel;
use anyhow::ensure;
use glam::{Vec2, Vec3};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, Pose};

/// Pixels of a picture on a side of a pixel of its depth.
pub(super) const PIXELS: u32 = 2;
/// What is nearer counts as this near, metres.
const NEAREST_M: f32 = 0.4;
/// Chroma of a picture without hues.
const GREY: u8 = 128;
/// A triangle with a side of more than so many pixels of depth lies over a gap.
const GAP: f32 = 2.5;
/// A place at less than this part of its distance before the eye is not drawn.
const LEAST_FORWARD: f32 = 1e-3;
/// The grid goes on beyond its border by this part of its side.
const BEYOND: f32 = 0.5;

/// Depth of a picture.
#[derive(Clone, Debug)]
pub(super) struct Depth {
    extent: [usize; 2],
    /// Inverse distances along the view axis, 1/m, row by row; 0: infinitely far.
    inverse_m: Vec<f32>,
}

/// As it is encoded: of each pixel of depth, what is nearest in it and one pixel of the picture around it. So a surface keeps its whole
/// outline: its grid ends at the middle of a pixel of depth.
///
/// # Errors
/// `extent_pixels`, which is that of the picture, is not `probe`'s, or no multiple of four.
pub(super) fn coded(probe: &ProbeView, extent_pixels: [u32; 2]) -> anyhow::Result<I420> {
    let [width, height] = extent_pixels.map(|side| side / PIXELS);
    let places = probe.width / extent_pixels[0];
    ensure!(
        [probe.width, probe.height] == extent_pixels.map(|side| side * places),
        "depth of {}x{} is not of a picture of {extent_pixels:?} pixels",
        probe.width,
        probe.height
    );
    let around = |at: u32, end: u32| {
        (at * PIXELS * places).saturating_sub(places)..(((at + 1) * PIXELS + 1) * places).min(end)
    };
    let code = |x: u32, y: u32| {
        let columns = around(x, probe.width);
        let row = |y: u32| {
            let first = (y * probe.width) as usize;
            &probe.depth_m[first + columns.start as usize..first + columns.end as usize]
        };
        let within = around(y, probe.height).flat_map(row);
        let nearest_m = within.fold(f32::INFINITY, |a, b| a.min(*b));
        (255.0 * NEAREST_M / nearest_m.max(NEAREST_M)).round() as u8
    };
    let mut bytes: Vec<u8> = (0..height).flat_map(|y| (0..width).map(move |x| code(x, y))).collect();
    bytes.resize(I420::byte_count([width, height]) as usize, GREY);
    Ok(I420::new([width, height], bytes)?)
}

/// How a new picture differs from an old one.
#[derive(Clone, Copy)]
pub(super) struct Change {
    /// From the eye then to the eye now.
    pub now_from_then: Pose,
    /// What the eye saw then.
    pub fov_then: Fov,
    /// What it sees now.
    pub fov_now: Fov,
    /// Of the new picture.
    pub extent_pixels: [u32; 2],
}

/// A corner of the grid as it is seen now.
#[derive(Clone, Copy)]
struct Vertex {
    /// In the new picture, pixels.
    at: Vec2,
    /// 1/m.
    inverse_m: f32,
    /// Part of the old picture that it shows, 0..1 from its upper left corner.
    source: Vec2,
    /// It lies beyond the old picture's border.
    is_beyond: bool,
}

impl Depth {
    /// Of what was decoded.
    pub(super) fn new(picture: &I420) -> Self {
        let inverse_m = |code: &u8| f32::from(*code) / (255.0 * NEAREST_M);
        Self {
            extent: picture.extent_texels().map(|side| side as usize),
            inverse_m: picture.planes()[0].iter().map(inverse_m).collect(),
        }
    }

    /// By pixel of the new picture which part of the old one it shows, 0..1 from its upper left corner; `None` where the grid has
    /// nothing.
    pub(super) fn sources(&self, change: Change) -> Vec<Option<Vec2>> {
        // A column and a row more on each side lie beyond the border.
        let [across, down] = self.extent.map(|side| side + 2);
        let vertices: Vec<Option<Vertex>> = (0..down)
            .flat_map(|row| (0..across).map(move |column| [column, row]))
            .map(|cell| self.vertex(cell, change))
            .collect();
        let span = |fov: Fov| tangents(fov).1 - tangents(fov).0;
        let cells = Vec2::from(self.extent.map(|side| side as f32));
        let cell_pixels = pixels(change.extent_pixels) * span(change.fov_then) / span(change.fov_now) / cells;
        let mut seen = Seen::new(change.extent_pixels);
        for first in (0..down - 1).flat_map(|row| (0..across - 1).map(move |column| row * across + column)) {
            let [a, b, c, d] = [first, first + 1, first + across, first + across + 1];
            for corners in [[a, b, c], [b, d, c]] {
                if let [Some(a), Some(b), Some(c)] = corners.map(|corner| vertices[corner]) {
                    seen.add(without_gap([a, b, c], cell_pixels));
                }
            }
        }
        seen.sources
    }

    /// `None`: behind the eye.
    fn vertex(&self, cell: [usize; 2], change: Change) -> Option<Vertex> {
        let nearest = [0, 1].map(|axis| cell[axis].clamp(1, self.extent[axis]));
        let inverse_m = self.inverse_m[(nearest[1] - 1) * self.extent[0] + nearest[0] - 1];
        let part = [0, 1].map(|axis| match cell[axis] {
            0 => -BEYOND,
            cell if cell > self.extent[axis] => 1.0 + BEYOND,
            cell => (cell as f32 - 0.5) / self.extent[axis] as f32,
        });
        let part = Vec2::from(part);
        let (low, high) = tangents(change.fov_then);
        let tangent = low + part * (high - low);
        // The place times its inverse distance: what is infinitely far has one, too.
        let place = change.now_from_then.orientation * Vec3::new(tangent.x, -tangent.y, -1.0)
            + inverse_m * change.now_from_then.position;
        if place.z > -LEAST_FORWARD {
            return None;
        }
        let (low, high) = tangents(change.fov_now);
        let tangent = Vec2::new(place.x, -place.y) / -place.z;
        Some(Vertex {
            at: (tangent - low) / (high - low) * pixels(change.extent_pixels),
            inverse_m: inverse_m / -place.z,
            source: part.clamp(Vec2::ZERO, Vec2::ONE),
            is_beyond: nearest != cell,
        })
    }
}

pub(super) fn pixels(extent_pixels: [u32; 2]) -> Vec2 {
    Vec2::from(extent_pixels.map(|side| side as f32))
}

/// A triangle over a gap between two surfaces shows what is farthest of it.
fn without_gap(corners: [Vertex; 3], cell_pixels: Vec2) -> [Vertex; 3] {
    let [a, b, c] = corners;
    let is_long = |a: Vertex, b: Vertex| {
        !a.is_beyond && !b.is_beyond && ((a.at - b.at) / cell_pixels).abs().max_element() > GAP
    };
    if !(is_long(a, b) || is_long(b, c) || is_long(c, a)) {
        return corners;
    }
    let farther = |a: Vertex, b: Vertex| if b.inverse_m < a.inverse_m { b } else { a };
    let farthest = farther(farther(a, b), c);
    corners.map(|corner| Vertex { at: corner.at, ..farthest })
}

/// What is nearest by pixel.
struct Seen {
    extent: [usize; 2],
    inverse_m: Vec<f32>,
    sources: Vec<Option<Vec2>>,
}

impl Seen {
    fn new(extent_pixels: [u32; 2]) -> Self {
        let extent = extent_pixels.map(|side| side as usize);
        let count = extent[0] * extent[1];
        Self { extent, inverse_m: vec![f32::NEG_INFINITY; count], sources: vec![None; count] }
    }

    /// Adds a triangle that faces the eye.
    fn add(&mut self, [a, b, c]: [Vertex; 3]) {
        if (b.at - a.at).perp_dot(c.at - a.at) < 0.0 {
            return;
        }
        for_each_pixel([a.at, b.at, c.at], self.extent, |pixel, [of_a, of_b, of_c]| {
            let inverse_m = of_a * a.inverse_m + of_b * b.inverse_m + of_c * c.inverse_m;
            if inverse_m > self.inverse_m[pixel] {
                self.inverse_m[pixel] = inverse_m;
                self.sources[pixel] = Some(of_a * a.source + of_b * b.source + of_c * c.source);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    const SIDE: u32 = 64;

    fn fov() -> Fov {
        Fov::symmetric_degrees(90.0)
    }

    /// A column at one metre, four pixels wide in the middle, before a wall at four metres.
    fn column_before_wall() -> ProbeView {
        let is_column = |pixel: u32| (30..34).contains(&(pixel % SIDE));
        ProbeView {
            width: SIDE,
            height: SIDE,
            instance: (0..SIDE * SIDE).map(|pixel| u32::from(is_column(pixel))).collect(),
            depth_m: (0..SIDE * SIDE).map(|pixel| if is_column(pixel) { 1.0 } else { 4.0 }).collect(),
        }
    }

    fn wall(distance_m: f32) -> ProbeView {
        let count = (SIDE * SIDE) as usize;
        ProbeView { width: SIDE, height: SIDE, instance: vec![0; count], depth_m: vec![distance_m; count] }
    }

    /// Columns of the old picture that a row of the new one shows, pixels.
    fn row(probe: &ProbeView, now_from_then: Pose) -> Vec<f32> {
        let depth = Depth::new(&coded(probe, [SIDE, SIDE]).unwrap());
        let change = Change { now_from_then, fov_then: fov(), fov_now: fov(), extent_pixels: [SIDE, SIDE] };
        let sources = depth.sources(change);
        let of_row = &sources[(SIDE * SIDE / 2) as usize..][..SIDE as usize];
        of_row.iter().map(|source| source.expect("the grid covers the picture").x * SIDE as f32).collect()
    }

    fn moved(x_m: f32) -> Pose {
        // The eye goes to the right: what it sees goes to the left.
        Pose { position: Vec3::new(-x_m, 0.0, 0.0), orientation: Quat::IDENTITY }
    }

    #[test]
    fn an_eye_that_stayed_sees_each_pixel_where_it_was() {
        for probe in [column_before_wall(), wall(f32::INFINITY)] {
            for (x, source) in row(&probe, Pose::IDENTITY).into_iter().enumerate() {
                assert!((source - (x as f32 + 0.5).clamp(1.0, 63.0)).abs() < 0.51, "{x}: {source}");
            }
        }
    }

    #[test]
    fn a_surface_moves_by_the_eyes_way_over_its_distance() {
        // 0.25 m at 2 m are an eighth of a tangent, which are four of the 64 pixels.
        // What is infinitely far stays.
        for (distance_m, pixels) in [(2.0, 4.0), (f32::INFINITY, 0.0)] {
            let shown = row(&wall(distance_m), moved(0.25));
            for (x, source) in shown.into_iter().enumerate().skip(8).take(48) {
                assert!((source - (x as f32 + 0.5 + pixels)).abs() < 0.1, "{distance_m} m, {x}: {source}");
            }
        }
    }

    #[test]
    fn what_a_column_uncovers_looks_as_the_wall_behind_it() {
        // The column at 1 m goes eight pixels to the left, the wall two.
        let shown = row(&column_before_wall(), moved(0.25));
        let is_column = |source: &f32| (30.0..34.0).contains(source);
        let columns: Vec<usize> = (0..shown.len()).filter(|x| is_column(&shown[*x])).collect();
        assert!(columns.iter().all(|x| (21..=26).contains(x)) && columns.len() >= 3, "{columns:?}");
        assert!(shown[29..32].iter().all(|source| (34.0..37.5).contains(source)), "{:?}", &shown[29..32]);
    }

    #[test]
    fn depth_is_of_what_is_nearest_and_has_eight_bits() {
        let planes = coded(&column_before_wall(), [SIDE, SIDE]).unwrap();
        assert_eq!(planes.extent_texels(), [SIDE / 2, SIDE / 2]);
        let depth = Depth::new(&planes);
        for (at, inverse_m) in depth.inverse_m.iter().enumerate() {
            let is_column = (14..18).contains(&(at % (SIDE / 2) as usize));
            let expected = if is_column { 1.0 } else { 0.25 };
            assert!((inverse_m - expected).abs() <= 0.501 / (255.0 * NEAREST_M), "{at}: {inverse_m}");
        }
        assert!(coded(&wall(1.0), [SIDE / 2 + 1, SIDE]).is_err());
    }
}
