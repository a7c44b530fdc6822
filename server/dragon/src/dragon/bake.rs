//! Paints the textures: fills the triangles' places in the texture with what the painter says of each texel's place on
//! the skin, so that patterns run on across seams.

use super::mesh::{Mesh, Vertex};
use super::paint::{Sample, sample};
use glam::{Vec2, Vec3, Vec4};

/// Texels around the islands that repeat their rim, so that filtering and coarser mip levels find no background.
const MARGIN_TEXELS: usize = 6;

/// The three pictures, 8-bit RGB, rows from the top.
pub(super) struct Pictures {
    pub base_color: Vec<u8>,
    pub metallic_roughness: Vec<u8>,
    pub normal: Vec<u8>,
}

/// Texels as they fill up.
#[derive(Clone)]
pub(super) struct Canvas {
    pub side: usize,
    /// `None` where no triangle lies, and no margin.
    pub texels: Vec<Option<Texel>>,
}

#[derive(Clone, Copy)]
pub(super) struct Texel {
    sample: Sample,
    texels_per_m: f32,
}

impl Canvas {
    pub fn paint(mesh: &Mesh, side: usize) -> Self {
        let mut canvas = Self { side, texels: vec![None; side * side] };
        for triangle in &mesh.triangles {
            canvas.triangle(triangle.map(|index| &mesh.vertices[index as usize]));
        }
        for _ in 0..MARGIN_TEXELS {
            canvas.grow();
        }
        canvas
    }

    fn triangle(&mut self, [a, b, c]: [&Vertex; 3]) {
        let (ab, ac) = (b.texel - a.texel, c.texel - a.texel);
        let area = ab.perp_dot(ac);
        if area.abs() < 1e-6 {
            return;
        }
        let place_area = (b.position - a.position).cross(c.position - a.position).length();
        let texels_per_m = (area.abs() / place_area.max(1e-12)).sqrt();
        let low = a.texel.min(b.texel).min(c.texel).floor().max(Vec2::ZERO).as_uvec2();
        let high =
            a.texel.max(b.texel).max(c.texel).ceil().as_uvec2().min(glam::UVec2::splat(self.side as u32));
        for y in low.y..high.y {
            for x in low.x..high.x {
                let index = y as usize * self.side + x as usize;
                let offset = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - a.texel;
                let (v, w) = (offset.perp_dot(ac) / area, ab.perp_dot(offset) / area);
                let shares = Vec3::new(1.0 - v - w, v, w);
                if self.texels[index].is_none() && shares.min_element() >= -1e-4 {
                    let sample = interpolate([a, b, c], shares);
                    self.texels[index] = Some(Texel { sample, texels_per_m });
                }
            }
        }
    }

    /// One texel outwards: the mean of the painted neighbours.
    fn grow(&mut self) {
        let empty = (0..self.texels.len()).filter(|&index| self.texels[index].is_none());
        let grown: Vec<(usize, Texel)> =
            empty.filter_map(|index| mean(self.neighbours(index)).map(|texel| (index, texel))).collect();
        grown.into_iter().for_each(|(index, texel)| self.texels[index] = Some(texel));
    }

    fn neighbours(&self, index: usize) -> impl Iterator<Item = Texel> {
        let (x, last) = (index % self.side, self.side - 1);
        let left = if x > 0 { self.texels[index - 1] } else { None };
        let right = if x < last { self.texels[index + 1] } else { None };
        let above = index.checked_sub(self.side).and_then(|above| self.texels[above]);
        let below = self.texels.get(index + self.side).copied().flatten();
        [left, right, above, below].into_iter().flatten()
    }

    pub fn pictures(&self) -> Pictures {
        // Never looked up, but the coarsest mip levels mix it in: about the mean of the hide.
        const BACKGROUND: Vec3 = Vec3::new(0.16, 0.36, 0.33);
        let mut pictures =
            Pictures { base_color: Vec::new(), metallic_roughness: Vec::new(), normal: Vec::new() };
        for index in 0..self.texels.len() {
            let texel = self.texels[index];
            let color = texel.map_or(BACKGROUND, |t| t.sample.color);
            let (roughness, metallic) = texel.map_or((0.6, 0.0), |t| (t.sample.roughness, t.sample.metallic));
            pictures.base_color.extend(bytes(color));
            pictures.metallic_roughness.extend(bytes(Vec3::new(1.0, roughness, metallic)));
            pictures.normal.extend(bytes(self.normal(index) * 0.5 + 0.5));
        }
        pictures
    }

    /// From the heights around; x to the right, y up, z out of the picture.
    fn normal(&self, index: usize) -> Vec3 {
        let Some(here) = self.texels[index] else { return Vec3::Z };
        let height = |index: Option<usize>| {
            let near = index.and_then(|index| self.texels.get(index).copied().flatten());
            near.map_or(here.sample.height_m, |near| near.sample.height_m)
        };
        let right = height(index.checked_add(1)) - height(index.checked_sub(1));
        let down = height(index.checked_add(self.side)) - height(index.checked_sub(self.side));
        let slope = 0.5 * here.texels_per_m;
        Vec3::new(-right * slope, down * slope, 1.0).normalize()
    }
}

fn interpolate(corners: [&Vertex; 3], shares: Vec3) -> Sample {
    let shares = shares.max(Vec3::ZERO);
    let [a, b, c] = corners;
    let place = a.position * shares.x + b.position * shares.y + c.position * shares.z;
    let paint: Vec4 = a.paint * shares.x + b.paint * shares.y + c.paint * shares.z;
    let openness = a.openness * shares.x + b.openness * shares.y + c.openness * shares.z;
    sample(a.skin, place, paint, openness)
}

fn mean(near: impl Iterator<Item = Texel>) -> Option<Texel> {
    let mut sum: Option<Texel> = None;
    let mut count = 0.0;
    for texel in near {
        count += 1.0;
        sum = Some(match sum {
            None => texel,
            Some(sum) => Texel {
                sample: sum.sample.mix(&texel.sample, 1.0 / count),
                texels_per_m: sum.texels_per_m.max(texel.texels_per_m),
            },
        });
    }
    sum
}

fn bytes(color: Vec3) -> [u8; 3] {
    color.to_array().map(|channel| (channel.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
}
