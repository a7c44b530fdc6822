//! A cell: a number of dragons in one of the table's columns, and the derivation of its scene from the loaded one.
//!
//! Off: the dragons have no clip, so no animation stage runs for them. Static: each has its skeleton, its clip and its own
//! phase, and is posed and skinned for every update, but time stands still: its clip advances by a microsecond a second.
//! Animated: it flies.

use crate::session::options::{Head, MOST_ROOM, Renderer, RunOptions, Spared, StageMs};
use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};
use shadecast_mock_runtime::head_path::COLUMNS;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::pose::Pose;
use shadecast_scene::Scene;
use shadecast_scene::animation::bounds::{Bounds, instance_bounds};
use shadecast_scene::animation::played::PlayedBounds;
use shadecast_scene::animation::sampling::{DEFAULT_INTERVAL_S, Sampling};
use shadecast_scene::load::SceneSource;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::scene::skins::Skinning;
use std::path::Path;

/// Pixels of a side of the paper's picture.
const PAPER_SIDE_PIXELS: f64 = 1300.0;
/// Degrees that it shows.
pub const FOV_DEGREES: f32 = 90.0;
/// Part of the picture's half that dragons reach at most.
const FRAMED: f32 = 0.97;
/// From the head's middle to an eye, metres.
const HALF_PUPILS_M: f32 = 0.032;
/// Clip seconds a second of dragons for which time stands still: with a speed of 0 all would be in one pose.
const STILL_SPEED: f32 = 1e-6;
/// Updates a second on the clock of the scene, and display frames.
pub const UPDATES_HZ: f64 = 30.0;
/// The same of the client.
pub const REFRESH_HZ: f64 = 90.0;

/// What of the animation runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Column {
    /// No stage of it.
    Off,
    /// All stages, and time stands still.
    Static,
    /// All stages, in flight.
    Animated,
}

/// All, in the paper's order.
pub const COLUMNS_OF_TABLE: [Column; 3] = [Column::Off, Column::Static, Column::Animated];

/// How the server works.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// As it ships.
    Ours,
    /// Each vertex walks the parent chains of its bones, keys lie 100 ms apart, all three predicted times are skinned anew for
    /// each update and sent with it, and the client moves vertices on lines between them.
    AsPaper,
}

/// What of the rest is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Set {
    /// Full detail, and nothing of an update is kept for the next, the shadow map neither: the paper's columns.
    Paper,
    /// Levels of detail and reuse as they ship.
    Shipped,
}

/// One of what is measured by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Cell {
    /// Dragons.
    pub dragons: u32,
    /// What beside animation is on.
    pub set: Set,
    /// How the server works.
    pub mode: Mode,
    /// What of the animation runs.
    pub column: Column,
}

impl Cell {
    /// All of a scene: the paper's columns, those of its own ways that differ where they are asked for, the second set.
    pub fn of_scene(dragons: u32, with_paper_ways: bool) -> Vec<Self> {
        let cell = |set, mode| move |column| Self { dragons, set, mode, column };
        let mut cells: Vec<Self> = COLUMNS_OF_TABLE.map(cell(Set::Paper, Mode::Ours)).into();
        if with_paper_ways {
            // Without animation both modes are one.
            cells.extend([Column::Static, Column::Animated].map(cell(Set::Paper, Mode::AsPaper)));
        }
        cells.extend(COLUMNS_OF_TABLE.map(cell(Set::Shipped, Mode::Ours)));
        cells
    }

    /// About what it takes, beside one dragon of the paper's columns.
    pub fn weight(self) -> f64 {
        let of_kind = match (self.set, self.mode) {
            (_, Mode::AsPaper) => 3.0,
            (Set::Paper, Mode::Ours) => 1.0,
            (Set::Shipped, Mode::Ours) => 0.5,
        };
        f64::from(self.dragons) * of_kind
    }

    /// The scene that is measured, made of the one that was loaded.
    pub fn scene(self, loaded: &Scene) -> Scene {
        let mut scene = loaded.clone();
        for instance in scene.instances.iter_mut().filter(|instance| instance.clip.is_some()) {
            match self.column {
                Column::Off => instance.clip = None,
                Column::Static => {
                    instance.time_shift_s /= STILL_SPEED;
                    instance.speed = STILL_SPEED;
                }
                Column::Animated => {}
            }
        }
        scene
    }

    /// What the run until everything has arrived is made with; files go to `folder`.
    pub fn run_options(self, size: Size, head: &Path, folder: &Path) -> RunOptions {
        let usual = RunOptions::new(source(self.dragons), folder.to_owned());
        let scene_options = match self.mode {
            Mode::Ours => SceneOptions::default(),
            Mode::AsPaper => SceneOptions {
                sampling: Sampling::Constant { interval_s: DEFAULT_INTERVAL_S },
                skinning: Skinning::PerVertexChain,
                motion: MotionOption::Paper,
                ..SceneOptions::default()
            },
        };
        let is_paper = self.set == Set::Paper;
        let mut spared = Spared::default();
        let policy = &mut spared.policy;
        (policy.reuse, policy.one_pass_when_still, policy.clusters) = (!is_paper, !is_paper, !is_paper);
        RunOptions {
            renderer: Renderer::Local,
            head: Head::File(head.to_owned()),
            seconds: 1e6, // it is left when everything is measured
            extent_pixels: size.extent_pixels,
            fov_degrees: FOV_DEGREES,
            atlas_extent_texels: size.atlas_extent_texels,
            stages: StageMs { server: 1.0, encode: 0.0, decode: 0.0, steps: None },
            detail_pixels: if is_paper { 0.0 } else { usual.detail_pixels },
            spared,
            // Full detail of many dragons is more than a client usually keeps.
            room: if is_paper { MOST_ROOM } else { usual.room },
            rate_hz: UPDATES_HZ,
            refresh_hz: REFRESH_HZ,
            scene_options,
            ..usual
        }
    }
}

/// Sizes at a scale.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Size {
    /// Of each eye.
    pub extent_pixels: [u32; 2],
    /// Of the atlas.
    pub atlas_extent_texels: AtlasExtent,
}

impl Size {
    /// A part of the paper's. The atlas has the blocks for everything that is in view, which are no fewer for a small picture: it
    /// shrinks to a quarter at most.
    pub fn at(scale: f64) -> anyhow::Result<Self> {
        let side = ((PAPER_SIDE_PIXELS * scale / 4.0).round() as u32 * 4).max(16);
        let [width, height] = if scale > 0.5 { [4096, 2048] } else { [4096, 1024] };
        Ok(Self { extent_pixels: [side; 2], atlas_extent_texels: AtlasExtent::new(width, height)? })
    }
}

/// The grid of so many dragons: the sides of the paper's six are equal. It has one layer of depth, since all are to be seen, and
/// the paper's numbers are squares, four of them of primes.
pub fn source(dragons: u32) -> SceneSource {
    let up = (1..=dragons.isqrt()).rev().find(|up| dragons.is_multiple_of(*up)).unwrap_or(1);
    SceneSource::DragonGrid([dragons / up, up, 1])
}

/// Boxes that dragons never leave, in the world.
pub fn boxes(scene: &Scene) -> Vec<Bounds> {
    let mut played = PlayedBounds::new(scene);
    let flying = scene.instances.iter().enumerate().filter(|(_, instance)| instance.clip.is_some());
    flying.map(|(index, instance)| instance_bounds(instance, played.of(index))).collect()
}

/// The nearest place in front of the middle of some boxes from which all of them are seen whole, looking ahead (-z).
pub fn eye_for(boxes: &[Bounds]) -> Vec3 {
    let all = boxes.iter().fold(Bounds::EMPTY, |all, one| all.union(*one));
    let middle = (all.low + all.high) * 0.5;
    let half = (0.5 * FOV_DEGREES).to_radians().tan() * FRAMED;
    let behind = |corner: Vec3| {
        let aside = (corner - middle).abs() + Vec3::X * HALF_PUPILS_M;
        corner.z + aside.x.max(aside.y) / half
    };
    let corners = boxes.iter().flat_map(|one| one.corners());
    middle.with_z(corners.map(behind).fold(f32::NEG_INFINITY, f32::max))
}

/// How many boxes are whole within a head's picture that looks ahead from `eye`.
pub fn whole_in_view(boxes: &[Bounds], eye: Vec3) -> usize {
    let half = (0.5 * FOV_DEGREES).to_radians().tan();
    let is_seen = |corner: &Vec3| {
        let at = (*corner - eye) * Vec3::new(1.0, 1.0, -1.0);
        at.z > 0.1 && (at.x.abs() + HALF_PUPILS_M).max(at.y.abs()) <= at.z * half
    };
    boxes.iter().filter(|one| one.corners().iter().all(is_seen)).count()
}

/// The head that looks ahead from `eye` for ever, as the runtime reads it.
pub fn head_csv(scene: &Scene, eye: Vec3) -> String {
    let world_from_head = Pose { position: eye, orientation: Quat::IDENTITY };
    let Pose { position: p, orientation: q } = scene.world_from_stage.inverse().then(world_from_head);
    let row = |t_s: u32| format!("{t_s},{},{},{},{},{},{},{}\n", p.x, p.y, p.z, q.x, q.y, q.z, q.w);
    format!("{COLUMNS}\n{}{}", row(0), row(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::load_scene;

    #[test]
    fn all_dragons_are_whole_in_view_and_no_step_nearer() {
        for dragons in [1, 2, 4, 9] {
            let boxes = boxes(&load_scene(&source(dragons)).expect("dragons"));
            assert_eq!(boxes.len(), dragons as usize);
            let eye = eye_for(&boxes);
            assert_eq!(whole_in_view(&boxes, eye), boxes.len(), "{dragons}: {eye}");
            let nearer = eye - Vec3::Z * 0.1 * (eye.z - boxes[0].low.z);
            assert!(whole_in_view(&boxes, nearer) < boxes.len(), "{dragons}: {eye} is farther than needed");
        }
    }

    #[test]
    fn the_papers_grids_are_square() {
        for (dragons, side) in [(9, 3), (25, 5), (49, 7), (81, 9), (121, 11), (169, 13)] {
            assert_eq!(source(dragons), SceneSource::DragonGrid([side, side, 1]));
        }
        assert_eq!(source(6), SceneSource::DragonGrid([3, 2, 1]));
        assert_eq!(source(1), SceneSource::DragonGrid([1, 1, 1]));
    }

    #[test]
    fn a_column_changes_what_moves_and_nothing_else() {
        let loaded = load_scene(&source(2)).expect("dragons");
        let of = |column| Cell { dragons: 2, set: Set::Paper, mode: Mode::Ours, column }.scene(&loaded);
        assert!((0..2).all(|dragon| !of(Column::Off).moves(dragon)));
        let (still, flying) = (of(Column::Static), of(Column::Animated));
        for dragon in 0..2 {
            assert!(still.moves(dragon), "it is skinned all the same");
            let [still, flying] = [&still, &flying].map(|scene| {
                let schedule = &scene.schedules()[dragon];
                [0, 3_000_000_000].map(|ns| schedule.at(shadecast_protocol::time::WorldTime(ns)).now.local_s)
            });
            assert!((still[0] - flying[0]).abs() < 1e-3, "{still:?} {flying:?}");
            assert!((still[1] - still[0]).abs() < 1e-4 && (flying[1] - flying[0]).abs() > 0.5);
        }
    }

    #[test]
    fn sizes_shrink_with_the_scale() {
        let full = Size::at(1.0).expect("the paper's");
        assert_eq!(
            (full.extent_pixels, full.atlas_extent_texels.to_string()),
            ([1300; 2], "4096x2048".into())
        );
        let small = Size::at(0.2).expect("small");
        assert_eq!(small.extent_pixels, [260; 2]);
        assert!(small.atlas_extent_texels.height() < full.atlas_extent_texels.height());
    }
}
