//! What an update takes from the allocator once all has come to rest: of a scene that stands still, and of one that moves. Blocks,
//! levels, slots and what is needed and looked at take nothing; what is left is mostly what leaves for the client.

use allocation_counter::{AllocationInfo, measure};
use glam::{Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, Displayed, HeadState, Welcome, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::frame::{Frame, ShowOptions};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::surround::DEFAULT_SURROUND;
use shadecast_server::world::{ViewerId, World};
use shadecast_test_support::peers;
use std::sync::Arc;

const PERIOD_NS: i64 = 33_333_333;
/// Updates until levels, blocks and surround have come to rest, and until each buffer has been as long as it gets.
const SETTLED: u32 = 96;
const MEASURED: u32 = 12;

/// Of what moves: patches come and go with each update, and the lists that tell the client of them grow as they are filled.
const MOVING: Most = [(12, 4096), (160, 524_288), (40, 4096), (4, 2048), (96, 131_072)];

/// Allocations of each step of an update: begin, place, shade, collect, and coding what it says.
type Steps = [AllocationInfo; 5];

/// What a step may allocate at most: how often, and how many bytes.
type Most = [(u64, u64); 5];

/// Makes updates, and holds those after [`SETTLED`] against what each step may allocate.
fn hold(allowed: Most, is_moving: bool, head: impl Fn(u32) -> Pose) {
    let most = most(is_moving, head);
    let is_less = most.iter().zip(allowed).all(|(most, allowed)| most.0 <= allowed.0 && most.1 <= allowed.1);
    assert!(is_less, "{most:?}, where {allowed:?} is allowed");
}

/// Most allocations of each step in any of the updates after [`SETTLED`], and most bytes of them.
fn most(is_moving: bool, head: impl Fn(u32) -> Pose) -> Most {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)
        .expect("a Vulkan device; `./shadecast setup` installs a software one");
    let mut scene = load_scene(&SceneSource::Dragons(3)).expect("built in");
    if !is_moving {
        scene.instances.iter_mut().for_each(|instance| (instance.clip, instance.path) = (None, None));
    }
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("a scene"));
    let mut world = World::new(&gpu, &scene).expect("memory");
    let (welcome, capabilities) = terms();
    let show = ShowOptions { detail_pixels: 1.0, surround: DEFAULT_SURROUND };
    let mut frame = Frame::new(&world, ViewerId(1), &welcome, &capabilities, show).expect("memory");
    let mut most = [(0, 0); 5];
    for number in 0..SETTLED + MEASURED {
        let steps = update(&mut frame, &mut world, number, head(number));
        if number >= SETTLED {
            most.iter_mut().zip(steps).for_each(|(most, step)| {
                *most = (most.0.max(step.count_total), most.1.max(step.bytes_total));
            });
        }
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
    most
}

fn update(frame: &mut Frame, world: &mut World, number: u32, world_from_head: Pose) -> Steps {
    let now = ServerTime(i64::from(number) * PERIOD_NS);
    frame.head(HeadState { world_from_head, ..peers::head(number, now) });
    let begin = measure(|| assert!(frame.begin(world, now).expect("a device"), "a head is known"));
    let place = measure(|| frame.place(world).expect("a device"));
    let shade = measure(|| frame.shade(world).expect("a device"));
    let mut shaded = None;
    let collect = measure(|| shaded = frame.collect(world).expect("a device"));
    let shaded = shaded.expect("it is shaded");
    let encode = measure(|| drop(frame.encode(&shaded.delta)));
    let display_time = now.plus_ns(PERIOD_NS);
    frame.displayed(&Displayed { update: shaded.update, display_time, ..Displayed::default() });
    frame.recycle(shaded.picture);
    [begin, place, shade, collect, encode]
}

fn terms() -> (Welcome, Capabilities) {
    let (mut hello, mut offer) = (peers::hello(), peers::offer());
    (hello.capabilities.max_patch_slots, offer.patch_slots) = (20_000, 20_000);
    (hello.capabilities.max_vertex_slots, offer.vertex_slots) = (60_000, 60_000);
    hello.capabilities.max_triangles = 120_000;
    hello.capabilities.eye_extent_pixels = [128, 128];
    offer.atlas_extent_texels = AtlasExtent::new(1024, 1024).expect("an atlas");
    let welcome = negotiate(&hello, &offer).expect("they agree");
    (welcome, hello.capabilities)
}

fn head(turn: f32) -> Pose {
    Pose { position: Vec3::new(0.0, 1.6, 1.0), orientation: Quat::from_rotation_y(turn) }
}

#[test]
fn of_what_stands_still() {
    let allowed = [(12, 4096), (24, 98_304), (1, 512), (4, 2048), (16, 1024)];
    hold(allowed, false, |_| head(0.0));
}

#[test]
fn of_what_moves_before_a_still_head() {
    hold(MOVING, true, |_| head(0.0));
}

#[test]
fn of_what_moves_before_a_head_that_sways() {
    hold(MOVING, true, |number| head((number as f32 * 0.1).sin() * 0.2));
}
