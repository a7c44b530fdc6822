//! Updates in flight together are those that are made one after the other, with validation layers on.

use glam::{Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, HeadState, Welcome, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::frame::{Frame, Shaded, ShowOptions};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::world::{ViewerId, World};
use shadecast_test_support::peers;
use std::sync::Arc;

const PERIOD_NS: i64 = 33_333_333;
const UPDATES: u32 = 10;

/// A viewer with a world of its own.
struct Lone {
    world: World,
    frame: Frame,
}

impl Lone {
    fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>) -> Self {
        let world = World::new(gpu, scene).expect("memory");
        let (welcome, capabilities) = terms();
        let show = ShowOptions { detail_pixels: 1.0, surround: 0.25 };
        let frame = Frame::new(&world, ViewerId(1), &welcome, &capabilities, show).expect("memory");
        Self { world, frame }
    }

    /// The head turns and comes nearer; gives when it did.
    fn turn(&mut self, update: u32) -> ServerTime {
        let now = ServerTime(i64::from(update) * PERIOD_NS);
        let along = update as f32 * 0.02;
        let world_from_head = Pose {
            position: Vec3::new(along, 1.6, 2.0 - along),
            orientation: Quat::from_rotation_y(along) * Quat::from_rotation_x(-0.3),
        };
        self.frame.head(HeadState { world_from_head, ..peers::head(update, now) });
        now
    }

    fn in_a_row(mut self) -> Vec<Shaded> {
        let mut update = |number| {
            let now = self.turn(number);
            self.frame.update(&mut self.world, now).expect("a device").expect("a head is known")
        };
        (0..UPDATES).map(&mut update).collect()
    }

    /// Visibility of each is before the device when the one before is shaded.
    fn overlapping(mut self) -> Vec<Shaded> {
        let mut made = Vec::new();
        for number in 0..UPDATES {
            let now = self.turn(number);
            made.extend(self.frame.collect(&self.world).expect("a device"));
            assert!(self.frame.begin(&mut self.world, now).expect("a device"), "a head is known");
            let flight = self.frame.flight(&self.world).expect("a device");
            assert_eq!((flight.is_begun, flight.is_in_work), (true, number > 0));
            self.frame.place(&mut self.world).expect("a device");
        }
        made.extend(self.frame.collect(&self.world).expect("a device"));
        self.frame.shade(&mut self.world).expect("a device");
        made.extend(self.frame.collect(&self.world).expect("a device"));
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

#[test]
fn updates_that_overlap_are_those_in_a_row() {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)
        .expect("a Vulkan device; `./shadecast setup` installs a software one");
    let scene = load_scene(&SceneSource::Dragons(4)).expect("built in");
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("a scene"));
    let row = Lone::new(&gpu, &scene).in_a_row();
    let overlapping = Lone::new(&gpu, &scene).overlapping();
    assert_eq!(row.len(), overlapping.len());
    for (alone, beside) in row.iter().zip(&overlapping) {
        assert_eq!((alone.update, alone.time), (beside.update, beside.time));
        assert_eq!(alone.delta, beside.delta, "{:?}", alone.update);
        assert!(alone.picture == beside.picture, "another picture of {:?}", alone.update);
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}
