//! What shading depends on at a time, of the scene in motion: for [`Reuse`](crate::shading::reuse::Reuse), which compares. On the CPU alone.

use crate::animation::manager::PoseKey;
use crate::animation::timeline::{Shown, Timeline};
use crate::scene::SceneGpu;
use crate::scene::geometry::{Geometry, MAX_CORNERS, corners};
use crate::scene::lights::SunView;
use crate::scene::numbering::{ScenePatch, SceneVertex};
use crate::scene::shine::StillLight;
use crate::shading::passes::shadow::Shadow;
use crate::shading::reuse::{Lamp, Moment, Receiver, Surfaces};
use crate::shading::shadow_change::SunBox;
use crate::skinning::gpu::Animation;
use crate::time::RingPlace;
use crate::world::samples::SampleWindow;
use arrayvec::ArrayVec;
use glam::{Affine3A, Vec3};
use shadecast_protocol::atlas::{Block, PatchKind};
use shadecast_protocol::limits::BLOCK_INSET_TEXELS;
use shadecast_protocol::time::WorldTime;
use shadecast_scene::Trs;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_scene::patches::Patch;
use shadecast_shaders::generated::PunctualGpu;

/// Least cosine between the triangles of a patch that has a normal, and the whole of it.
const FLAT_COSINE: f32 = 0.95;

/// Equal where an instance looks the same.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Stance(Option<Stands>);

/// Of an instance that may move.
#[derive(Clone, Debug, PartialEq)]
struct Stands {
    pose: PoseKey,
    /// Of one that is posed.
    bones: Option<Vec<Trs>>,
    world_from_model: Affine3A,
}

/// Of an instance, at a time.
pub(crate) fn stance(scene: &SceneGpu, timeline: &Timeline, instance: usize, time: WorldTime) -> Stance {
    let (manager, place) = (&scene.animation.manager, &scene.numbering.instances[instance]);
    let stands = || {
        let shown = timeline.at(instance, time);
        let pose = manager.pose_key(place.model, instance, &shown);
        let world_from_model = manager.paths.world_from_model(&scene.scene, instance, time.seconds());
        let bones = if let Shown::Live(bones) = shown { Some(bones) } else { None };
        Stands { pose, bones, world_from_model }
    };
    Stance(place.is_animated.then(stands))
}

/// All of a time, which light and shadow map are of, over what was there.
pub(crate) fn write(
    scene: &SceneGpu,
    animation: &Animation,
    shadow: &Shadow,
    time: WorldTime,
    Moment { stances, casters, lamps }: &mut Moment<Stance>,
) {
    let (timeline, instances) = (animation.timeline().lock(), 0..scene.numbering.instances.len());
    stances.clear();
    stances.extend(instances.clone().map(|number| stance(scene, &timeline, number, time)));
    let caster = |number: usize| {
        let sun = shadow.sun_view().filter(|_| shadow.has(number))?;
        SunBox::around(sun, bounds_at(scene, number, time).corners())
    };
    casters.clear();
    casters.extend(instances.map(caster));
    lamps.clear();
    lamps.extend(shadow.lamps().iter().map(lamp));
}

fn lamp(lamp: &PunctualGpu) -> Lamp {
    let [x, y, z, by_range] = lamp.position_range;
    let range_m = if by_range > 0.0 { 1.0 / by_range } else { f32::INFINITY };
    Lamp { words: bytemuck::cast(*lamp), position: Vec3::new(x, y, z), range_m }
}

/// A box that holds an instance at a time, whatever it plays.
fn bounds_at(scene: &SceneGpu, number: usize, time: WorldTime) -> Bounds {
    let played = scene.played_bounds[number];
    if played.is_empty() {
        return played;
    }
    let paths = &scene.animation.manager.paths;
    let world_from_model = paths.world_from_model(&scene.scene, number, time.seconds());
    Bounds::around(played.corners().map(|corner| world_from_model.transform_point3(corner)))
}

/// The scene's surfaces at a time.
pub(crate) struct SceneSurfaces<'a> {
    /// The scene.
    pub scene: &'a SceneGpu,
    /// Where its vertices are that do not move.
    pub samples: &'a SampleWindow,
    /// Where those are that do.
    pub animation: &'a Animation,
    /// How the sun sees it, where it casts shadows.
    pub sun: Option<&'a SunView>,
    /// When.
    pub time: WorldTime,
    /// Of positions at that time.
    pub place: RingPlace,
}

impl SceneSurfaces<'_> {
    /// The corners of a patch that does not move, with room for the fourth of a parallelogram.
    fn places(&self, number: usize, patch: &Patch) -> Option<ArrayVec<Vec3, { MAX_CORNERS + 1 }>> {
        let first = self.samples.first_vertex(number as u16);
        let place = |corner: u32| self.samples.static_position(SceneVertex(first.0 + corner));
        corners(*patch).map(place).collect()
    }
}

impl Surfaces for SceneSurfaces<'_> {
    fn instance(&self, patch: ScenePatch) -> usize {
        self.scene.numbering.instance_of_patch(patch)
    }

    fn is_there(&self, instance: usize) -> bool {
        let animation = self.animation;
        animation.position_base(instance, self.place).is_some() && animation.tangent_base(instance).is_some()
    }

    fn receiver(&self, patch: ScenePatch, block: Block) -> Receiver {
        let (number, of_patch) = (self.instance(patch), self.scene.patch(patch));
        let gloss = self.scene.gloss_of(number, &of_patch);
        let in_sun = |points: &[Vec3], beyond: f32| {
            let sun = self.sun?;
            Some(SunBox::around(sun, points.iter().copied())?.stretched(beyond).as_looked_up(sun))
        };
        let Some(mut points) = self.places(number, &of_patch) else {
            let points = bounds_at(self.scene, number, self.time).corners();
            let (centre, radius_m) = ball(&points);
            return Receiver { centre, radius_m, normal: None, in_sun: in_sun(&points, 0.0), gloss };
        };
        let normal = flat_normal(&points, of_patch.kind);
        if of_patch.kind == PatchKind::One {
            points.push(points[1] + points[2] - points[0]); // its block is the whole parallelogram
        }
        let beyond = beyond(of_patch.kind, block);
        let (centre, radius_m) = ball(&points);
        let radius_m = radius_m * (1.0 + 2.0 * beyond);
        Receiver { centre, radius_m, normal, in_sun: in_sun(&points, beyond), gloss }
    }

    fn turns_after_m(&self, patch: ScenePatch, eye: Vec3) -> f32 {
        let (number, of_patch) = (self.instance(patch), self.scene.patch(patch));
        if !of_patch.double_sided {
            return f32::INFINITY;
        }
        let Some(points) = self.places(number, &of_patch) else { return 0.0 };
        let distance_m = |[a, normal]: [Vec3; 2]| normal.normalize_or_zero().dot(eye - a).abs();
        planes(&points, of_patch.kind).map(distance_m).fold(f32::INFINITY, f32::min)
    }

    fn still_light(&self) -> &StillLight {
        &self.scene.still_light
    }
}

/// The part of a patch's extent by which its block's gutter reaches beyond it at most: a triangle of three is half as wide.
fn beyond(kind: PatchKind, block: Block) -> f32 {
    let of_side = |side: u32| BLOCK_INSET_TEXELS / (side as f32 - 2.0 * BLOCK_INSET_TEXELS);
    let both = of_side(block.size.width()) + of_side(block.size.height());
    if kind == PatchKind::Three { 2.0 * both } else { both }
}

/// A ball that holds points.
fn ball(points: &[Vec3]) -> (Vec3, f32) {
    let bounds = Bounds::around(points.iter().copied());
    let centre = (bounds.low + bounds.high) * 0.5;
    (centre, points.iter().map(|point| point.distance(centre)).fold(0.0, f32::max))
}

/// A corner of each triangle, and its facing.
fn planes(points: &[Vec3], kind: PatchKind) -> impl Iterator<Item = [Vec3; 2]> + '_ {
    kind.triangles().iter().map(|corners| {
        let [a, b, c] = corners.map(|corner| points[usize::from(corner)]);
        [a, (b - a).cross(c - a)]
    })
}

/// Of a patch whose triangles face one way.
fn flat_normal(points: &[Vec3], kind: PatchKind) -> Option<Vec3> {
    let sum = planes(points, kind).map(|[_, facing]| facing).sum::<Vec3>().try_normalize()?;
    let is_along = |[_, facing]: [Vec3; 2]| facing.normalize_or(sum).dot(sum) >= FLAT_COSINE;
    planes(points, kind).all(is_along).then_some(sum)
}
