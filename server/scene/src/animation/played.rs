//! Bounding boxes of a model over everything that an instance can play: its clips, their cross-fades, and an application's
//! poses.

use super::bounds::{Bounds, Reach, fade_bounds, model_bounds};
use crate::animation::pose::animated_vertices;
use crate::timeline::ClipIndex;
use crate::{Model, Scene};
use glam::Vec3;
use shadecast_model::playback::Schedule;
use std::collections::HashMap;

/// How much farther than in any of its clips a live pose may reach from the model's origin.
const LIVE_ROOM: f32 = 1.5;

/// Boxes in model space by instance, of which each clip of a model is looked at once.
pub struct PlayedBounds<'a> {
    scene: &'a Scene,
    schedules: Vec<Schedule<ClipIndex>>,
    of_clip: HashMap<(usize, ClipIndex), Bounds>,
    /// See [`live_reach_m`].
    of_live: HashMap<usize, f32>,
}

impl<'a> PlayedBounds<'a> {
    /// Of a scene, before anything was looked at.
    pub fn new(scene: &'a Scene) -> Self {
        Self { scene, schedules: scene.schedules(), of_clip: HashMap::new(), of_live: HashMap::new() }
    }

    /// Around the model of an instance, in model space, whatever the instance plays; empty for a model without vertices.
    pub fn of(&mut self, instance: usize) -> Bounds {
        let placed = &self.scene.instances[instance];
        let model = &self.scene.models[placed.model];
        let mut found = Bounds::EMPTY;
        for clip in self.scene.playable(instance) {
            let of_clip = self.of_clip.entry((placed.model, clip));
            found = found.union(*of_clip.or_insert_with(|| model_bounds(model, clip)));
        }
        if found.is_empty() {
            return found;
        }
        if placed.live {
            let reach =
                self.of_live.entry(placed.model).or_insert_with(|| live_reach_m(model, &Reach::new(model)));
            let reach = Vec3::splat(*reach);
            return found.union(Bounds { low: -reach, high: reach });
        }
        found.union(fade_bounds(model, &self.schedules[instance]))
    }
}

/// How far from the model's origin a live pose of a model may take its vertices, metres of model space: in any clip, however
/// its bones are turned, and some room.
pub fn live_reach_m(model: &Model, reach: &Reach) -> f32 {
    let clips = (0..model.clips.len()).map(Some).chain([None]);
    LIVE_ROOM * clips.map(|clip| reach.of_clip_m(model, clip)).fold(0.0, f32::max)
}

impl Scene {
    /// Whether any vertex of an instance is ever elsewhere than at first.
    pub fn moves(&self, instance: usize) -> bool {
        let placed = &self.instances[instance];
        let playable = self.playable(instance);
        let moves = |clip: &ClipIndex| animated_vertices(&self.models[placed.model], *clip).contains(&true);
        placed.path.is_some() || placed.live || playable.len() > 1 || playable.iter().any(moves)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animation::{playing, pose};
    use crate::load::{SceneSource, load_scene};
    use crate::timeline::{Change, Event};
    use crate::{Bone, Clip, Instance, Interpolation, PaletteEntry, Track, TrackValues, Trs, Vertex};
    use glam::{Affine3A, Quat};
    use shadecast_model::time::WorldTime;

    /// A vertex a metre from the bone that turns it, in one clip not at all and in the other nearly half around.
    fn hand(events: Vec<Event>) -> Scene {
        let clip = |angle: f32| Clip {
            duration_s: 1.0,
            tracks: vec![Track {
                bone: 0,
                times_s: vec![0.0],
                interpolation: Interpolation::Step,
                values: TrackValues::Rotation(vec![Quat::from_rotation_z(angle)]),
            }],
            ..Clip::default()
        };
        let model = Model {
            bones: vec![Bone { name: "b".into(), parent: None, rest: Trs::IDENTITY }],
            palette: vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }],
            vertices: vec![Vertex { position: Vec3::X, ..Vertex::default() }],
            clips: vec![clip(0.0), clip(3.0)],
            ..Model::default()
        };
        let instance = Instance { clip: Some(0), ..Instance::new("hand", 0) };
        let template = load_scene(&SceneSource::Dragons(1)).expect("built in");
        Scene { models: vec![model], instances: vec![instance], events, ..template }
    }

    fn to_the_other_clip(fade_ns: i64) -> Vec<Event> {
        let change = Change { clip: Some(Some(1)), fade_ns, ..Change::default() };
        vec![Event { at: WorldTime(1_000_000_000), instance: 0, change }]
    }

    fn contains(bounds: Bounds, place: Vec3) -> bool {
        bounds.low.cmple(place + 1e-4).all() && bounds.high.cmpge(place - 1e-4).all()
    }

    #[test]
    fn box_of_a_cross_fade_holds_what_sweeps_between_the_clips() {
        let scene = hand(to_the_other_clip(400_000_000));
        let schedule = &scene.schedules()[0];
        let mut bounds = PlayedBounds::new(&scene);
        let found = bounds.of(0);
        for at_ms in (900..1500).step_by(7) {
            let playing = schedule.at(WorldTime(at_ms * 1_000_000));
            let bone = playing::source_pose(&scene.models[0], &playing)[0];
            let at = bone.affine().transform_point3(Vec3::X);
            assert!(contains(found, at), "{at} leaves {found:?} at {at_ms} ms");
        }
        let abrupt = hand(to_the_other_clip(0));
        let of_clips = PlayedBounds::new(&abrupt).of(0);
        assert!(
            found.high.y > 0.99 && of_clips.high.y < 0.2,
            "clips alone do not reach so far: {of_clips:?}"
        );
    }

    #[test]
    fn box_of_a_live_instance_holds_every_turn_of_its_bones() {
        let mut scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        scene.instances[0].live = true;
        let found = PlayedBounds::new(&scene).of(0);
        let model = &scene.models[0];
        for step in 0..40 {
            let turn = |bone: usize| Quat::from_rotation_y(bone as f32 * step as f32 * 0.37);
            let mut locals = pose::source_pose(model, Some(0), 0.1 * f64::from(step));
            locals.iter_mut().enumerate().for_each(|(bone, local)| local.rotation = turn(bone));
            let palette = pose::palette(model, &pose::global_pose(model, &locals));
            let skinned = pose::skin(&model.vertices, &palette, Affine3A::IDENTITY);
            assert!(skinned.iter().all(|vertex| contains(found, vertex.position)), "step {step}");
        }
    }

    #[test]
    fn what_an_event_or_an_application_can_move_moves() {
        assert!(!hand(Vec::new()).moves(0), "its clip stands");
        assert!(hand(to_the_other_clip(0)).moves(0), "the other one has it elsewhere");
        let mut live = hand(Vec::new());
        live.instances[0].live = true;
        assert!(live.moves(0));
    }
}
