//! Overlapping updates equal sequential ones, and those in a leaver's memory equal those in new memory. Validation is on.

use glam::{Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, HeadState, Welcome, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::update::{Shaded, ShowOptions, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use shadecast_test_support::peers;
use std::ops::Range;
use std::sync::Arc;

const PERIOD_NS: i64 = 33_333_333;
const UPDATES: u32 = 10;
const SHOW: ShowOptions = ShowOptions { detail_pixels: 1.0, surround: 0.25 };
/// The update that is begun when a viewer leaves.
const LEAVES_AT: u32 = 3;

/// A viewer with a world of its own.
struct Lone {
    world: World,
    updates: ViewerUpdates,
}

impl Lone {
    fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>) -> Self {
        Self::of_world(World::new(gpu, scene).expect("memory"))
    }

    fn of_world(world: World) -> Self {
        let (welcome, capabilities) = terms();
        let updates = ViewerUpdates::new(&world, ViewerId(1), &welcome, &capabilities, SHOW).expect("memory");
        Self { world, updates }
    }

    /// The same in the memory of one that has made some updates.
    fn after_another(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>) -> Self {
        let mut another = Self::new(gpu, scene);
        for number in 0..UPDATES {
            let now = another.turn(number);
            another.updates.update(&mut another.world, now).expect("a device").expect("a head is known");
        }
        let kept = another.updates.leave(&mut another.world).wiped(gpu).expect("a device");
        let (world, (welcome, capabilities)) = (World::new(gpu, scene).expect("memory"), terms());
        let updates = ViewerUpdates::in_memory(&world, kept, ViewerId(2), (&welcome, &capabilities), SHOW);
        Self { world, updates: updates.expect("memory") }
    }

    /// The head turns and comes nearer; gives when it did.
    fn turn(&mut self, update: u32) -> ServerTime {
        let now = ServerTime(i64::from(update) * PERIOD_NS);
        let along = update as f32 * 0.02;
        let world_from_head = Pose {
            position: Vec3::new(along, 1.6, 2.0 - along),
            orientation: Quat::from_rotation_y(along) * Quat::from_rotation_x(-0.3),
        };
        self.updates.head(HeadState { world_from_head, ..peers::head(update, now) });
        now
    }

    fn in_a_row(mut self, updates: Range<u32>) -> Vec<Shaded> {
        let mut update = |number| {
            let now = self.turn(number);
            self.updates.update(&mut self.world, now).expect("a device").expect("a head is known")
        };
        updates.map(&mut update).collect()
    }

    /// Begins an update beside the one before; gives the one before that.
    fn begin(&mut self, number: u32) -> Option<Shaded> {
        let now = self.turn(number);
        let before = self.updates.collect(&self.world).expect("a device");
        assert!(self.updates.begin(&mut self.world, now).expect("a device"), "a head is known");
        let flight = self.updates.flight(&self.world).expect("a device");
        assert_eq!((flight.is_begun, flight.is_in_work), (true, number > 0));
        before
    }

    /// Goes with one update begun and one in work.
    fn leaves_in_flight(mut self) -> World {
        for number in 0..LEAVES_AT {
            self.begin(number);
            self.updates.place(&mut self.world).expect("a device");
        }
        self.begin(LEAVES_AT);
        self.updates.leave(&mut self.world);
        self.world
    }

    /// Visibility of each is before the device when the one before is shaded.
    fn overlapping(mut self) -> Vec<Shaded> {
        let mut made = Vec::new();
        for number in 0..UPDATES {
            made.extend(self.begin(number));
            self.updates.place(&mut self.world).expect("a device");
        }
        made.extend(self.updates.collect(&self.world).expect("a device"));
        self.updates.shade(&mut self.world).expect("a device");
        made.extend(self.updates.collect(&self.world).expect("a device"));
        made
    }

    /// Each is before the device ahead of the visibility of the next: as early as a queue of its own can be.
    fn shading_first(mut self) -> Vec<Shaded> {
        let mut made = Vec::new();
        for number in 0..UPDATES {
            let now = self.turn(number);
            assert!(self.updates.begin(&mut self.world, now).expect("a device"), "a head is known");
            made.extend(self.updates.collect(&self.world).expect("a device"));
            self.updates.place(&mut self.world).expect("a device");
            self.updates.shade(&mut self.world).expect("a device");
        }
        made.extend(self.updates.collect(&self.world).expect("a device"));
        made
    }
}

fn terms() -> (Welcome, Capabilities) {
    let (mut hello, mut offer) = (peers::hello(), peers::offer());
    (hello.capabilities.max_patch_slots, offer.patch_slots) = (20_000, 20_000);
    (hello.capabilities.max_vertex_slots, offer.vertex_slots) = (60_000, 60_000);
    hello.capabilities.max_triangles = 120_000;
    hello.capabilities.eye_extent_pixels = [160, 160];
    offer.atlas_extent_texels = AtlasExtent::new(1024, 1024).expect("an atlas");
    let welcome = negotiate(&hello, &offer).expect("they agree");
    (welcome, hello.capabilities)
}

fn dragons(count: u32) -> (Arc<Gpu>, Arc<SceneGpu>) {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)
        .expect("a Vulkan device; `./shadecast setup` installs a software one");
    let scene = load_scene(&SceneSource::Dragons(count)).expect("built in");
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("a scene"));
    (gpu, scene)
}

#[track_caller]
fn assert_same(gpu: &Gpu, one: &[Shaded], other: &[Shaded]) {
    assert_eq!(one.len(), other.len());
    for (one, other) in one.iter().zip(other) {
        assert_eq!((one.update, one.time), (other.update, other.time));
        assert_eq!(one.delta, other.delta, "{:?}", one.update);
        assert!(one.picture == other.picture, "another picture of {:?}", one.update);
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn updates_that_overlap_are_those_in_a_row() {
    let (gpu, scene) = dragons(4);
    let row = Lone::new(&gpu, &scene).in_a_row(0..UPDATES);
    let overlapping = Lone::new(&gpu, &scene).overlapping();
    assert_same(&gpu, &row, &overlapping);
}

#[test]
fn a_viewer_leaving_mid_update_leaves_the_world_intact() {
    let (gpu, scene) = dragons(2);
    let world = Lone::new(&gpu, &scene).leaves_in_flight();
    // The next one looks from the time at which that one left: what was begun for it is used.
    let updates = LEAVES_AT..LEAVES_AT + 3;
    let next = Lone::of_world(world).in_a_row(updates.clone());
    let first = Lone::new(&gpu, &scene).in_a_row(updates);
    assert_same(&gpu, &first, &next);
}

/// Texels without a block are compared as well: a picture holds them.
#[test]
fn nothing_of_a_viewer_is_left_in_the_memory_that_another_gets() {
    let (gpu, scene) = dragons(2);
    let last = UPDATES - 1..UPDATES;
    let after_another = Lone::after_another(&gpu, &scene).in_a_row(last.clone());
    let first = Lone::new(&gpu, &scene).in_a_row(last);
    assert_same(&gpu, &first, &after_another);
}

#[test]
fn shading_on_its_own_queue_may_overlap_the_next_update() {
    let (gpu, scene) = dragons(4);
    let row = Lone::new(&gpu, &scene).in_a_row(0..UPDATES);
    let ahead = Lone::new(&gpu, &scene).shading_first();
    assert_same(&gpu, &row, &ahead);
}
