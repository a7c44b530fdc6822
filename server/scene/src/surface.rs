//! Distance of points from a triangle surface: the measure of simplification.

use glam::{Vec3, Vec3A};

const LEAF_TRIANGLES: usize = 8;

/// Triangles in a tree of boxes.
pub struct Surface {
    triangles: Vec<[Vec3A; 3]>,
    nodes: Vec<Node>,
}

struct Node {
    low: Vec3A,
    high: Vec3A,
    /// Of a leaf the first triangle, of another node the first of two children in a row.
    first: u32,
    /// Triangles of a leaf; 0 for another node.
    count: u32,
}

impl Surface {
    /// Of these triangles, whose corners are finite.
    pub fn new(triangles: impl IntoIterator<Item = [Vec3; 3]>) -> Self {
        let triangles = triangles.into_iter().map(|t| t.map(Vec3A::from)).collect();
        let mut surface = Self { triangles, nodes: Vec::new() };
        if !surface.triangles.is_empty() {
            surface.nodes.push(surface.leaf(0, surface.triangles.len()));
            surface.divide(0);
        }
        surface
    }

    fn leaf(&self, first: usize, count: usize) -> Node {
        let corners = self.triangles[first..first + count].iter().flatten();
        let empty = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
        let (low, high) = corners.fold(empty, |(low, high), p| (low.min(*p), high.max(*p)));
        Node { low, high, first: first as u32, count: count as u32 }
    }

    /// Splits a leaf at the median of its longest side, and so on.
    fn divide(&mut self, node: usize) {
        let Node { low, high, first, count } = self.nodes[node];
        let (first, count) = (first as usize, count as usize);
        if count <= LEAF_TRIANGLES {
            return;
        }
        let extent = high - low;
        let axis = (0..3).fold(0, |best, axis| if extent[axis] > extent[best] { axis } else { best });
        let middle = |t: &[Vec3A; 3]| t[0][axis] + t[1][axis] + t[2][axis];
        let half = count / 2;
        self.triangles[first..first + count]
            .select_nth_unstable_by(half, |a, b| middle(a).total_cmp(&middle(b)));
        let children = self.nodes.len();
        let (left, right) = (self.leaf(first, half), self.leaf(first + half, count - half));
        self.nodes.extend([left, right]);
        (self.nodes[node].first, self.nodes[node].count) = (children as u32, 0);
        self.divide(children);
        self.divide(children + 1);
    }

    /// Distance of a point, infinite where there is no triangle.
    #[cfg(test)]
    pub fn distance(&self, point: Vec3) -> f32 {
        self.distance_above(point, 0.0)
    }

    /// The largest distance of several points, at least `floor`.
    pub fn largest_distance(&self, points: impl IntoIterator<Item = Vec3>, floor: f32) -> f32 {
        points.into_iter().fold(floor, |largest, point| self.distance_above(point, largest))
    }

    /// The distance, or `floor` where that is larger, which is found out much sooner.
    fn distance_above(&self, point: Vec3, floor: f32) -> f32 {
        let (point, floor) = (Vec3A::from(point), floor * floor);
        let mut best = f32::INFINITY;
        let mut pending = vec![(0.0, 0)];
        while let Some((at_least, index)) = pending.pop() {
            let Some(node) = self.nodes.get(index).filter(|_| at_least < best) else { continue };
            let (first, count) = (node.first as usize, node.count as usize);
            for triangle in &self.triangles[first..first + count] {
                best = best.min(closest(point, triangle).distance_squared(point));
            }
            if best <= floor {
                return floor.sqrt();
            }
            if count == 0 {
                let [a, b] =
                    [first, first + 1].map(|child| (self.nodes[child].distance_squared(point), child));
                // The nearer one is looked at first.
                pending.extend(if a.0 < b.0 { [b, a] } else { [a, b] });
            }
        }
        best.sqrt()
    }
}

impl Node {
    fn distance_squared(&self, point: Vec3A) -> f32 {
        point.clamp(self.low, self.high).distance_squared(point)
    }
}

/// The point of a triangle that is closest to another point: Ericson, Real-Time Collision Detection, 5.1.5.
fn closest(p: Vec3A, &[a, b, c]: &[Vec3A; 3]) -> Vec3A {
    let (ab, ac, ap, bp, cp) = (b - a, c - a, p - a, p - b, p - c);
    let (d1, d2, d3, d4, d5, d6) = (ab.dot(ap), ac.dot(ap), ab.dot(bp), ac.dot(bp), ab.dot(cp), ac.dot(cp));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let (of_c, of_b, of_a) = (d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4);
    if of_c <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    if of_b <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    if of_a <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let sum = of_a + of_b + of_c;
    a + ab * (of_b / sum) + ac * (of_c / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    fn point(rng: &mut SmallRng) -> Vec3 {
        Vec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)))
    }

    /// The smallest distance to points that are spread over a triangle.
    fn by_sampling(p: Vec3, [a, b, c]: [Vec3; 3]) -> f32 {
        let n = 60;
        let places =
            (0..=n).flat_map(|i| (0..=n - i).map(move |j| (i as f32 / n as f32, j as f32 / n as f32)));
        places.map(|(u, v)| (a + (b - a) * u + (c - a) * v).distance(p)).fold(f32::INFINITY, f32::min)
    }

    #[test]
    fn the_distance_is_that_of_the_nearest_of_many_sampled_points() {
        let mut rng = SmallRng::seed_from_u64(41);
        for count in [1, 2, 30, 100] {
            let triangles: Vec<[Vec3; 3]> = (0..count).map(|_| [0; 3].map(|_| point(&mut rng))).collect();
            let surface = Surface::new(triangles.iter().copied());
            for _ in 0..10 {
                let p = point(&mut rng) * 2.0;
                let sampled = triangles.iter().map(|t| by_sampling(p, *t)).fold(f32::INFINITY, f32::min);
                let found = surface.distance(p);
                assert!(found <= sampled + 1e-5 && found > sampled - 0.03, "seed 41: {found} {sampled}");
            }
        }
    }

    #[test]
    fn the_largest_of_several_distances_is_found_above_a_floor() {
        let surface = Surface::new([[Vec3::ZERO, Vec3::X, Vec3::Y]]);
        let points = [0.5, 2.0, 1.0].map(|z| Vec3::new(0.2, 0.2, z));
        assert_eq!(surface.largest_distance(points, 0.0), 2.0);
        assert_eq!(surface.largest_distance(points, 3.0), 3.0);
        assert_eq!(Surface::new([]).distance(Vec3::ZERO), f32::INFINITY);
    }

    #[test]
    fn triangles_without_area_have_a_distance_too() {
        let surface = Surface::new([[Vec3::ZERO, Vec3::X, Vec3::X], [Vec3::ONE; 3]]);
        assert!((surface.distance(Vec3::new(0.5, 0.25, 0.0)) - 0.25).abs() < 1e-6);
        assert!(surface.distance(Vec3::ONE * 2.0).is_finite());
    }
}
