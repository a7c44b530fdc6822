//! Tubes with an egg-shaped cross-section along a curve: trunk, limbs, toes, fingers.
//!
//! A loft is both a surface (points by length and angle) and a rough signed distance, which is what joins limbs to the
//! trunk smoothly and finds bone weights by place.

use crate::curve::{catmull_rom, lerp};
use glam::{Vec2, Vec3};
use std::f32::consts::TAU;

/// Sections computed between two stations of the table.
const SECTIONS_PER_STATION: usize = 6;

/// One cross-section. Its width is symmetric; above and below the centre it has radii of its own.
#[derive(Clone, Copy, Debug)]
pub(super) struct Section {
    /// Model space, metres.
    pub centre: Vec3,
    /// Unit vector along the curve.
    pub along: Vec3,
    /// Unit vector of angle a quarter turn.
    pub side: Vec3,
    /// Unit vector of angle zero.
    pub up: Vec3,
    /// Radius along `side`, metres.
    pub half_width: f32,
    /// Radius along `up`, metres.
    pub top: f32,
    /// Radius against `up`, metres.
    pub bottom: f32,
}

impl Section {
    /// Point on the rim; the angle runs from `up` over `side`, radians.
    pub fn rim(&self, angle: f32) -> Vec3 {
        let (sin, cos) = angle.sin_cos();
        let vertical = if cos > 0.0 { self.top } else { self.bottom };
        self.centre + self.side * (self.half_width * sin) + self.up * (vertical * cos)
    }

    /// Length of the rim, metres (Ramanujan's first approximation, for the mean of the two radii).
    pub fn rim_length(&self) -> f32 {
        let (a, b) = (self.half_width, 0.5 * (self.top + self.bottom));
        0.5 * TAU * (3.0 * (a + b) - ((3.0 * a + b) * (a + 3.0 * b)).sqrt())
    }

    fn mix(&self, other: &Self, t: f32) -> Self {
        Self {
            centre: self.centre.lerp(other.centre, t),
            along: self.along.lerp(other.along, t).normalize(),
            side: self.side.lerp(other.side, t).normalize(),
            up: self.up.lerp(other.up, t).normalize(),
            half_width: lerp(self.half_width, other.half_width, t),
            top: lerp(self.top, other.top, t),
            bottom: lerp(self.bottom, other.bottom, t),
        }
    }

    /// Signed distance in the section's plane along the ray from the centre, metres.
    fn radial_distance(&self, offset: Vec3) -> f32 {
        let (x, y) = (offset.dot(self.side), offset.dot(self.up));
        let vertical = if y > 0.0 { self.top } else { self.bottom };
        let relative = Vec2::new(x / self.half_width, y / vertical).length();
        if relative < 1e-3 {
            return -self.half_width.min(vertical);
        }
        Vec2::new(x, y).length() * (1.0 - 1.0 / relative)
    }
}

/// A tube along a curve.
#[derive(Clone, Debug)]
pub(super) struct Loft {
    sections: Vec<Section>,
    /// Their centres, close together for the search of the nearest one.
    centres: Vec<Vec3>,
    /// Length along the curve up to each section, metres.
    lengths_m: Vec<f32>,
    low: Vec3,
    high: Vec3,
}

/// A row of a loft's table: x, y, z of the centre, half width, radius above, radius below, all in metres.
pub(super) type Station = [f32; 6];

impl Loft {
    /// A smooth tube through `stations`; `side` is the reference for the direction of the width.
    pub fn new(stations: &[Station], side: Vec3) -> Self {
        let steps = (stations.len() - 1) * SECTIONS_PER_STATION;
        let at = |step: usize| catmull_rom(stations, step as f32 / SECTIONS_PER_STATION as f32);
        let rows: Vec<Station> = (0..=steps).map(at).collect();
        let sections: Vec<Section> = (0..=steps).map(|i| section(&rows, i, side)).collect();
        let mut lengths_m = vec![0.0];
        for pair in sections.windows(2) {
            lengths_m.push(lengths_m[lengths_m.len() - 1] + pair[0].centre.distance(pair[1].centre));
        }
        let reach = |s: &Section| Vec3::splat(s.half_width.max(s.top).max(s.bottom));
        let low = sections.iter().map(|s| s.centre - reach(s)).fold(Vec3::INFINITY, Vec3::min);
        let high = sections.iter().map(|s| s.centre + reach(s)).fold(Vec3::NEG_INFINITY, Vec3::max);
        let centres = sections.iter().map(|s| s.centre).collect();
        Self { sections, centres, lengths_m, low, high }
    }

    /// The same on the other side of the body.
    pub fn mirrored(&self) -> Self {
        let flip = |v: Vec3| Vec3::new(-v.x, v.y, v.z);
        let mut loft = self.clone();
        for section in &mut loft.sections {
            for vector in [&mut section.centre, &mut section.along, &mut section.side, &mut section.up] {
                *vector = flip(*vector);
            }
        }
        loft.centres.iter_mut().for_each(|centre| *centre = flip(*centre));
        (loft.low, loft.high) = (Vec3 { x: -self.high.x, ..self.low }, Vec3 { x: -self.low.x, ..self.high });
        loft
    }

    /// Length of the curve, metres.
    pub fn length_m(&self) -> f32 {
        self.lengths_m[self.lengths_m.len() - 1]
    }

    /// Length along the curve at a row of the table (rows may be fractional), metres.
    pub fn length_at_station(&self, station: f32) -> f32 {
        let step = station * SECTIONS_PER_STATION as f32;
        let i = (step as usize).min(self.lengths_m.len() - 2);
        lerp(self.lengths_m[i], self.lengths_m[i + 1], step - i as f32)
    }

    /// Cross-section at a length along the curve, metres.
    pub fn section(&self, s_m: f32) -> Section {
        let after = self.lengths_m.partition_point(|&length| length < s_m);
        let i = after.clamp(1, self.sections.len() - 1) - 1;
        let step = self.lengths_m[i + 1] - self.lengths_m[i];
        let t = ((s_m - self.lengths_m[i]) / step).clamp(0.0, 1.0);
        self.sections[i].mix(&self.sections[i + 1], t)
    }

    /// Length along the curve of the centre nearest to a point, metres.
    pub fn nearest_m(&self, point: Vec3) -> f32 {
        let (mut near, mut least) = (0, f32::INFINITY);
        for (i, centre) in self.centres.iter().enumerate() {
            let squared = centre.distance_squared(point);
            if squared < least {
                (near, least) = (i, squared);
            }
        }
        let candidates = near.saturating_sub(1)..(near + 1).min(self.sections.len() - 1);
        let project = |i: usize| {
            let (a, b) = (self.centres[i], self.centres[i + 1]);
            let t = ((point - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
            (a.lerp(b, t).distance_squared(point), lerp(self.lengths_m[i], self.lengths_m[i + 1], t))
        };
        let best = candidates.map(project).min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or(0.0, |(_, s_m)| s_m)
    }

    /// How far around a point lies: 0 above the curve, 1 below it.
    pub fn ventral(&self, point: Vec3) -> f32 {
        let section = self.section(self.nearest_m(point));
        let offset = point - section.centre;
        let (x, y) = (offset.dot(section.side), offset.dot(section.up));
        let vertical = if y > 0.0 { section.top } else { section.bottom };
        let turned = Vec2::new(x / section.half_width, y / vertical).normalize_or(Vec2::Y);
        0.5 - 0.5 * turned.y
    }

    /// Rough signed distance, metres: exact on the surface, negative inside. Far away only a lower bound.
    pub fn distance(&self, point: Vec3) -> f32 {
        const FAR_M: f32 = 0.3;
        let outside = (self.low - point).max(point - self.high).max(Vec3::ZERO).length();
        if outside > FAR_M {
            return outside;
        }
        let s_m = self.nearest_m(point);
        let section = self.section(s_m);
        let offset = point - section.centre;
        let radial = section.radial_distance(offset);
        // Past an end the nearest centre is the end itself, and the offset leaves the section's plane.
        let at_end = s_m <= 0.0 || s_m >= self.length_m();
        if at_end { Vec2::new(radial.max(0.0), offset.dot(section.along)).length() } else { radial }
    }
}

fn section(rows: &[Station], i: usize, side: Vec3) -> Section {
    const LEAST_RADIUS_M: f32 = 1e-3;
    let centre = |i: usize| Vec3::new(rows[i][0], rows[i][1], rows[i][2]);
    let along = (centre((i + 1).min(rows.len() - 1)) - centre(i.saturating_sub(1))).normalize();
    let side = (side - along * along.dot(side)).normalize();
    let radius = |k: usize| rows[i][k].max(LEAST_RADIUS_M);
    Section {
        centre: centre(i),
        along,
        side,
        up: along.cross(side),
        half_width: radius(3),
        top: radius(4),
        bottom: radius(5),
    }
}
