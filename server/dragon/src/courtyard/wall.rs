//! Walls with arched openings.

use super::shapes::{CELL_M, rectangle};
use crate::surface::{Surface, surface};
use glam::{Vec2, Vec3};
use std::f32::consts::PI;

/// Pieces of half a circle.
const ARCH_PIECES: u16 = 14;
/// Heights of a line that are nearer to each other than this are one, metres.
const MERGED_M: f32 = 0.08;

/// A hole with a round top.
#[derive(Clone, Copy, Debug)]
pub(super) struct Opening {
    /// Along the face, metres.
    pub middle_m: f32,
    pub width_m: f32,
    /// Heights of its lower edge and of the arch's beginning, metres.
    pub sill_m: f32,
    pub spring_m: f32,
    /// How deep it goes; a niche has a back there.
    pub depth_m: f32,
    pub is_niche: bool,
}

impl Opening {
    fn radius_m(&self) -> f32 {
        0.5 * self.width_m
    }

    /// The height of the arch, metres.
    fn top_m(&self, along_m: f32) -> f32 {
        if self.is_edge(along_m) {
            return self.spring_m;
        }
        let off = along_m - self.middle_m;
        self.spring_m + (self.radius_m().powi(2) - off * off).max(0.0).sqrt()
    }

    fn holds(&self, along_m: f32) -> bool {
        (along_m - self.middle_m).abs() <= self.radius_m() + 1e-4
    }

    fn is_edge(&self, along_m: f32) -> bool {
        ((along_m - self.middle_m).abs() - self.radius_m()).abs() < 1e-4
    }

    /// Places along the face where the arch has a corner.
    fn corners_m(&self) -> impl Iterator<Item = f32> {
        let (middle_m, radius_m) = (self.middle_m, self.radius_m());
        (0..=ARCH_PIECES)
            .map(move |piece| middle_m - radius_m * (PI * f32::from(piece) / f32::from(ARCH_PIECES)).cos())
    }
}

/// One side of a wall.
#[derive(Clone, Debug)]
pub(super) struct Face {
    /// Its lower left corner.
    pub corner: Vec3,
    /// To the right, of unit length.
    pub along: Vec3,
    pub length_m: f32,
    pub height_m: f32,
    pub openings: Vec<Opening>,
}

impl Face {
    pub fn normal(&self) -> Vec3 {
        self.along.cross(Vec3::Y)
    }

    /// A place so far along, up and behind the face.
    pub fn at(&self, along_m: f32, up_m: f32, behind_m: f32) -> Vec3 {
        self.corner + self.along * along_m + Vec3::Y * up_m - self.normal() * behind_m
    }

    /// The other side of a wall of this thickness, longer by so much at both ends.
    pub fn back(&self, thickness_m: f32, longer_m: f32) -> Self {
        let mirrored =
            |opening: &Opening| Opening { middle_m: self.length_m - opening.middle_m + longer_m, ..*opening };
        Self {
            corner: self.at(self.length_m + longer_m, 0.0, thickness_m),
            along: -self.along,
            length_m: self.length_m + 2.0 * longer_m,
            height_m: self.height_m,
            openings: self.openings.iter().filter(|opening| !opening.is_niche).map(mirrored).collect(),
        }
    }

    /// The face around its openings, and the backs of niches.
    pub fn plane(&self, texture_m: f32) -> Surface {
        let mut made = Surface::default();
        for pair in self.lines_m().windows(2) {
            let [left, right] = [pair[0], pair[1]];
            match self.openings.iter().find(|opening| opening.holds(0.5 * (left + right))) {
                None => self.strip([left, right], |_| [0.0, self.height_m], 0.0, texture_m, &mut made),
                Some(opening) => {
                    if opening.sill_m > 0.0 {
                        self.strip([left, right], |_| [0.0, opening.sill_m], 0.0, texture_m, &mut made);
                    }
                    let above = |along_m: f32| [opening.top_m(along_m), self.height_m];
                    self.strip([left, right], above, 0.0, texture_m, &mut made);
                    if opening.is_niche {
                        let inside = |along_m: f32| [opening.sill_m, opening.top_m(along_m)];
                        self.strip([left, right], inside, opening.depth_m, texture_m, &mut made);
                    }
                }
            }
        }
        made
    }

    /// The inner sides of the openings.
    pub fn reveals(&self, texture_m: f32) -> Surface {
        let mut made = Surface::default();
        for opening in &self.openings {
            self.jambs(opening, texture_m, &mut made);
            if opening.sill_m > 0.0 {
                let left_m = opening.middle_m - opening.radius_m();
                let corner = self.at(left_m, opening.sill_m, 0.0);
                let into = -self.normal() * opening.depth_m;
                made.append(rectangle(corner, self.along * opening.width_m, into, texture_m));
            }
        }
        made
    }

    /// A band of stones around each arch, which stands out from the face, and the two stones that it rests on.
    pub fn bands(&self, texture_m: f32) -> Surface {
        const WIDTH_M: f32 = 0.24;
        const OUT_M: f32 = 0.035;
        const REST_M: f32 = 0.03;
        const REST_HEIGHT_M: f32 = 0.15;
        let mut made = Surface::default();
        for opening in &self.openings {
            let inner_m = opening.radius_m() - 0.012;
            let arch_m = PI * (inner_m + 0.5 * WIDTH_M);
            let mut side = |from: [f32; 2], to: [f32; 2]| {
                let point = |u: f32, v: f32| {
                    let (sin, cos) = (PI * (1.0 - u)).sin_cos();
                    let [radius_m, behind_m] = [0, 1].map(|axis| from[axis] + (to[axis] - from[axis]) * v);
                    self.at(opening.middle_m + radius_m * cos, opening.spring_m + radius_m * sin, behind_m)
                };
                let mut band = surface(ARCH_PIECES + 1, 2, point);
                let width_m = (to[0] - from[0]).hypot(to[1] - from[1]);
                band.uvs.iter_mut().for_each(|uv| *uv *= Vec2::new(arch_m, width_m) / texture_m);
                made.append(band);
            };
            let outer_m = inner_m + WIDTH_M;
            side([inner_m, 0.1], [inner_m, -OUT_M]);
            side([inner_m, -OUT_M], [outer_m, -OUT_M]);
            side([outer_m, -OUT_M], [outer_m, 0.0]);
            let size_m = [WIDTH_M + 2.0 * REST_M, REST_HEIGHT_M, OUT_M + REST_M];
            for left_m in [-outer_m - REST_M, inner_m - REST_M] {
                let low = [opening.middle_m + left_m, opening.spring_m - REST_HEIGHT_M];
                made.append(self.ledge(low, size_m, texture_m));
            }
        }
        made
    }

    /// A stone that stands out from the face: its lower left corner there, and its width, height and depth.
    fn ledge(
        &self,
        [left_m, low_m]: [f32; 2],
        [width_m, height_m, out_m]: [f32; 3],
        texture_m: f32,
    ) -> Surface {
        let behind_m = 0.12;
        let corner = self.at(left_m, low_m, -out_m);
        let [right, up] = [self.along * width_m, Vec3::Y * height_m];
        let into = -self.normal() * (out_m + behind_m);
        let mut made = rectangle(corner, right, up, texture_m);
        made.append(rectangle(corner + right, into, up, texture_m));
        made.append(rectangle(corner + into, -into, up, texture_m));
        made.append(rectangle(corner + up, right, into, texture_m));
        made.append(rectangle(corner + into, right, -into, texture_m));
        made
    }

    /// Where the face is divided, from left to right.
    fn lines_m(&self) -> Vec<f32> {
        let mut fixed: Vec<f32> = self.openings.iter().flat_map(Opening::corners_m).collect();
        fixed.extend([0.0, self.length_m]);
        fixed.sort_by(f32::total_cmp);
        let mut lines = vec![fixed[0]];
        for pair in fixed.windows(2) {
            let steps = ((pair[1] - pair[0]) / CELL_M).ceil().max(1.0);
            lines.extend(
                (1..=steps as u16).map(|step| pair[0] + (pair[1] - pair[0]) * f32::from(step) / steps),
            );
        }
        lines
    }

    /// Heights at which the line there has vertices, whichever piece uses them: so no piece ends amid another's edge.
    fn heights_m(&self, along_m: f32) -> Vec<f32> {
        let mut fixed = vec![0.0, self.height_m];
        for opening in self.openings.iter().filter(|opening| opening.holds(along_m)) {
            fixed.extend([opening.sill_m, opening.top_m(along_m)]);
        }
        let rows = (self.height_m / CELL_M).ceil();
        let free = (1..rows as u16).map(|row| self.height_m * f32::from(row) / rows);
        let mut all: Vec<f32> =
            free.filter(|at| fixed.iter().all(|other| (other - at).abs() > MERGED_M)).collect();
        all.extend(fixed);
        all.sort_by(f32::total_cmp);
        all.dedup_by(|a, b| (*a - *b).abs() < 1e-4);
        all
    }

    /// What lies between two lines, from the lower to the upper end at each.
    fn strip(
        &self,
        lines_m: [f32; 2],
        ends_m: impl Fn(f32) -> [f32; 2],
        behind_m: f32,
        texture_m: f32,
        made: &mut Surface,
    ) {
        let [left, right] = lines_m.map(|along_m| {
            let [low, high] = ends_m(along_m);
            let mut heights = self.heights_m(along_m);
            heights.retain(|at| (low - 1e-4..=high + 1e-4).contains(at));
            heights
        });
        let first = made.positions.len() as u16;
        for (along_m, heights) in lines_m.into_iter().zip([&left, &right]) {
            for up_m in heights {
                let at = self.at(along_m, *up_m, behind_m);
                made.positions.push(at);
                made.normals.push(self.normal());
                made.uvs.push(Vec2::new(at.dot(self.along), -at.y) / texture_m);
            }
        }
        let (mut l, mut r) = (0, 0);
        while l + 1 < left.len() || r + 1 < right.len() {
            let [here, there] = [first + l as u16, first + (left.len() + r) as u16];
            let takes_left = r + 1 >= right.len() || (l + 1 < left.len() && left[l + 1] <= right[r + 1]);
            if takes_left {
                made.indices.extend([here, there, here + 1]);
                l += 1;
            } else {
                made.indices.extend([here, there, there + 1]);
                r += 1;
            }
        }
    }

    /// Up one side of an opening, over the arch and down the other, as a strip into the wall.
    fn jambs(&self, opening: &Opening, texture_m: f32, made: &mut Surface) {
        let edges = [-1.0, 1.0].map(|side| opening.middle_m + side * opening.radius_m());
        let upright = |along_m: f32| -> Vec<[f32; 2]> {
            let heights = self.heights_m(along_m);
            let inside = heights.into_iter().filter(|at| (opening.sill_m..=opening.spring_m).contains(at));
            inside.map(|up_m| [along_m, up_m]).collect()
        };
        let mut outline = upright(edges[0]);
        let arch = opening.corners_m().skip(1).take(usize::from(ARCH_PIECES) - 1);
        outline.extend(arch.map(|along_m| [along_m, opening.top_m(along_m)]));
        outline.extend(upright(edges[1]).into_iter().rev());
        let steps = (opening.depth_m / CELL_M).ceil() as u16;
        let first = made.positions.len() as u16;
        let mut way_m = 0.0;
        for (index, [along_m, up_m]) in outline.iter().copied().enumerate() {
            let before = outline[index.saturating_sub(1)];
            way_m += (along_m - before[0]).hypot(up_m - before[1]);
            let off = Vec2::new(opening.middle_m - along_m, opening.spring_m - up_m.max(opening.spring_m))
                .normalize();
            for step in 0..=steps {
                let behind_m = opening.depth_m * f32::from(step) / f32::from(steps);
                made.positions.push(self.at(along_m, up_m, behind_m));
                made.normals.push(self.along * off.x + Vec3::Y * off.y);
                made.uvs.push(Vec2::new(behind_m, -way_m) / texture_m);
            }
        }
        for row in 0..outline.len() as u16 - 1 {
            for step in 0..steps {
                let low = first + row * (steps + 1) + step;
                let above = low + steps + 1;
                made.indices.extend([low, low + 1, above, low + 1, above + 1, above]);
            }
        }
    }
}
