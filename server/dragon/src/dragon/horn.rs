//! Bent cones: horns, claws, dorsal spikes, teeth.

use super::anatomy::island;
use super::loft::{Loft, Station};
use super::mesh::{Island, Mesh, Skin, Tube};
use glam::{Vec2, Vec3, Vec4};

/// A bent cone. Its base is open: it starts inside what it grows from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Horn {
    pub base: Vec3,
    /// From base to tip without the bend, metres.
    pub reach: Vec3,
    /// Added to the tip, growing with the square of the way, metres.
    pub bend: Vec3,
    /// Radii along `side` and across it at the base, metres.
    pub radii_m: Vec2,
    /// Direction of the first radius.
    pub side: Vec3,
    pub edge_m: f32,
    /// How dark the base is, 0..1.
    pub dark_base: f32,
}

impl Horn {
    pub fn mesh(&self) -> Mesh {
        const ROWS: usize = 7;
        let station = |row: usize| -> Station {
            let t = row as f32 / (ROWS - 1) as f32;
            let centre = self.base + self.reach * t + self.bend * (t * t);
            let radii = self.radii_m * (1.0 - 0.93 * t.powf(1.15));
            [centre.x, centre.y, centre.z, radii.x, radii.y, radii.y]
        };
        let stations: [Station; ROWS] = std::array::from_fn(station);
        let loft = Loft::new(&stations, self.side);
        let length = loft.length_m();
        Tube {
            loft: &loft,
            from_m: 0.0,
            to_m: length,
            edge_m: &|_| self.edge_m,
            caps: [false, true],
            island: Island { origin: island::HORN, texels_per_m: island::HORN_LENGTH / length },
            skin: Skin::Horn,
            paint: &|s_m, _| Vec4::new(s_m / length, self.dark_base, 0.0, 0.0),
        }
        .mesh()
    }
}
