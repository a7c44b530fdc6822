//! Which triangles of what stands still a view can reach: runs of them, with the box around each. Pure.
//!
//! Of a room that one stands in most is behind or beside. What moves has one box that it never leaves: [`crate::visibility::culling`].

use crate::visibility::culling::Sight;
use glam::Vec3;
use shadecast_scene::Primitive;
use shadecast_scene::animation::bounds::Bounds;
use std::ops::Range;

/// Indices of a cluster at most: 128 triangles, about 64 patches.
const CLUSTER_INDICES: u32 = 3 * 128;
/// Positions are drawn as they are packed, which moves them by a share of what holds them, and by metres at most.
const PACKED_SHARE: f32 = 1e-5;
const PACKED_M: f32 = 1e-4;

/// By instance, and by LOD; none for what moves, and for what nothing is known of.
#[derive(Clone, Debug, Default)]
pub struct Clusters(Vec<Vec<Vec<Cluster>>>);

/// Triangles of one primitive that follow each other.
#[derive(Clone, Debug)]
struct Cluster {
    /// In the LOD's own numbers.
    indices: Range<u32>,
    /// In the world.
    bounds: Bounds,
}

impl Clusters {
    /// Of a scene of which nothing is known.
    pub(crate) const NONE: &Self = &Self(Vec::new());

    /// The next instance moves.
    pub(crate) fn add_moving(&mut self) {
        self.0.push(Vec::new());
    }

    /// The next instance stands still: of each of its LODs the primitives, and where each index has its vertex in the world.
    pub(crate) fn add_still<'a>(
        &mut self,
        lods: impl IntoIterator<Item = (&'a [Primitive], &'a [u32])>,
        position: impl Fn(u32) -> Vec3,
    ) {
        let of_lod = |(primitives, indices): (&[Primitive], &[u32])| {
            let all = primitives.iter().flat_map(|primitive| {
                let all = all_indices(primitive);
                let of = |first: u32| first..(first + CLUSTER_INDICES).min(all.end);
                all.clone().step_by(CLUSTER_INDICES as usize).map(of).collect::<Vec<_>>()
            });
            let mut clusters: Vec<Cluster> = all.map(|run| cluster(run, indices, &position)).collect();
            clusters.sort_by_key(|cluster| cluster.indices.start);
            clusters
        };
        self.0.push(lods.into_iter().map(of_lod).collect());
    }

    /// Indices of a primitive of an instance's LOD that may be in sight, in runs without gaps.
    pub(crate) fn runs<'a>(
        &'a self,
        [instance, lod]: [usize; 2],
        primitive: &Primitive,
        sight: &'a Sight,
    ) -> impl Iterator<Item = Range<u32>> + use<'a> {
        let all = all_indices(primitive);
        let of_lod = self.0.get(instance).and_then(|lods| lods.get(lod));
        let first = of_lod.map_or(0, |of| of.partition_point(|cluster| cluster.indices.start < all.start));
        let of_primitive = of_lod.map_or(&[][..], |of| &of[first..]);
        let end = all.end;
        let mut in_sight = of_primitive
            .iter()
            .take_while(move |cluster| cluster.indices.start < end)
            .filter(|cluster| sight.reaches(cluster.bounds))
            .map(|cluster| cluster.indices.clone())
            .peekable();
        let mut whole = of_lod.is_none().then_some(all);
        std::iter::from_fn(move || {
            let mut run = whole.take().or_else(|| in_sight.next())?;
            while let Some(next) = in_sight.next_if(|next| next.start == run.end) {
                run.end = next.end;
            }
            Some(run)
        })
    }
}

fn all_indices(primitive: &Primitive) -> Range<u32> {
    primitive.first_index..primitive.first_index + primitive.index_count
}

fn cluster(run: Range<u32>, indices: &[u32], position: &impl Fn(u32) -> Vec3) -> Cluster {
    let used = &indices[run.start as usize..run.end as usize];
    let bounds = Bounds::around(used.iter().map(|vertex| position(*vertex)));
    let farthest = bounds.low.abs().max(bounds.high.abs()).max_element();
    Cluster { indices: run, bounds: bounds.grown(PACKED_M + PACKED_SHARE * farthest) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::visibility::predict::View;
    use glam::{Quat, Vec4};
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use shadecast_protocol::pose::{Fov, Pose};

    #[test]
    fn no_triangle_in_view_is_left_out_and_much_of_what_is_around_is() {
        let mut rng = SmallRng::seed_from_u64(7);
        // A tape of small triangles that winds through a room.
        let place = |at: u32| {
            let angle = at as f32 * 2e-3;
            Vec3::new(4.0 * angle.cos(), (at % 3) as f32 * 0.02 + angle * 0.1, 4.0 * angle.sin())
        };
        let indices: Vec<u32> = (0..9000).collect();
        let primitive = |first_index, index_count| Primitive { first_index, index_count, material: 0 };
        let primitives = [primitive(0, 3000), primitive(3000, 6000)];
        let mut clusters = Clusters::default();
        clusters.add_moving();
        clusters.add_still([(&primitives[..], &indices[..])], place);
        let (mut drawn, mut all) = (0, 0);
        for case in 0..100 {
            let mut number = |reach: f32| rng.random_range(-reach..reach);
            let orientation = Quat::from_rotation_y(number(3.1)) * Quat::from_rotation_x(number(0.5));
            let position = Vec3::new(number(2.0), number(1.0), number(2.0));
            let view = View {
                world_from_eye: Pose { position, orientation },
                fov: Fov { left: -0.8, right: 0.6, up: 0.7, down: -0.9 },
            };
            let sight = Sight::of([view].iter());
            let clip_from_world = view.fov.clip_from_eye() * view.world_from_eye.inverse().matrix();
            for primitive in &primitives {
                assert!(clusters.runs([0, 0], primitive, &sight).eq([all_indices(primitive)]), "it moves");
                let runs: Vec<_> = clusters.runs([1, 0], primitive, &sight).collect();
                assert!(runs.windows(2).all(|pair| pair[0].end < pair[1].start), "{runs:?}");
                for index in all_indices(primitive) {
                    let at: Vec4 = clip_from_world * place(index).extend(1.0);
                    let is_seen = at.x.abs() <= at.w && at.y.abs() <= at.w;
                    let is_drawn = runs.iter().any(|run| run.contains(&index));
                    assert!(is_drawn || !is_seen, "seed 7, case {case}: {index}");
                    drawn += u32::from(is_drawn);
                    all += 1;
                }
            }
        }
        assert!(drawn * 2 < all, "{drawn} of {all}");
    }
}
