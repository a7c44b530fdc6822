//! Allocations of an update at rest, for a static and for a moving scene: only the bytes for the client. Lists, picture and
//! timings reuse those of earlier updates.

use allocation_counter::measure;
use glam::{Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, Displayed, HeadState, Welcome, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::update::{ShowOptions, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use shadecast_test_support::peers;
use std::sync::Arc;

const PERIOD_NS: i64 = 33_333_333;
/// Updates until levels, blocks and surround have come to rest, and until each buffer has been as long as it gets.
const SETTLED: u32 = 96;
const MEASURED: usize = 16;

/// How often each step of an update allocates: begin, place, shade, collect, and coding what it says, whose bytes leave.
type Steps = [u64; 5];

/// What is usual.
const USUAL: Steps = [0, 0, 0, 0, 1];
/// Of a scene that moves, so many updates may have a list that gets longer than it ever was: its memory is doubled then.
const GROWN_UPDATES: usize = 3;
const GROWN_LISTS: u64 = 4;

/// Holds updates after [`SETTLED`] against what is usual: all, or all but a few that grow.
fn hold(made: &[Steps], grown_updates: usize) {
    let sum = |steps: &Steps| steps.iter().sum::<u64>();
    let grown: Vec<_> = made.iter().filter(|steps| **steps != USUAL).collect();
    let is_held = grown.len() <= grown_updates && grown.iter().all(|steps| sum(steps) <= 1 + GROWN_LISTS);
    assert!(is_held && made.len() == MEASURED, "{made:?}");
}

/// What each update of so many dragons after [`SETTLED`] takes.
fn made(dragons: u32, is_moving: bool, head: impl Fn(u32) -> Pose) -> Vec<Steps> {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)
        .expect("a Vulkan device; `./shadecast setup` installs a software one");
    let mut scene = load_scene(&SceneSource::Dragons(dragons)).expect("built in");
    if !is_moving {
        scene.instances.iter_mut().for_each(|instance| (instance.clip, instance.path) = (None, None));
    }
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("a scene"));
    let mut world = World::new(&gpu, &scene).expect("memory");
    let (welcome, capabilities) = terms();
    let show = ShowOptions { detail_pixels: 1.0, surround: DEFAULT_SURROUND };
    let mut updates = ViewerUpdates::new(&world, ViewerId(1), &welcome, &capabilities, show).expect("memory");
    let mut made = Vec::new();
    for number in 0..SETTLED + MEASURED as u32 {
        made.push(update(&mut updates, &mut world, number, head(number)));
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
    made.split_off(SETTLED as usize)
}

fn update(updates: &mut ViewerUpdates, world: &mut World, number: u32, world_from_head: Pose) -> Steps {
    let now = ServerTime(i64::from(number) * PERIOD_NS);
    updates.head(HeadState { world_from_head, ..peers::head(number, now) });
    let begin = measure(|| assert!(updates.begin(world, now).expect("a device"), "a head is known"));
    let place = measure(|| updates.place(world).expect("a device"));
    let shade = measure(|| updates.shade(world).expect("a device"));
    let mut shaded = None;
    let collect = measure(|| shaded = updates.collect(world).expect("a device"));
    let shaded = shaded.expect("it is shaded");
    let encode = measure(|| drop(updates.encode(&shaded.delta)));
    let display_time = now.plus_ns(PERIOD_NS);
    updates.displayed(&Displayed { update: shaded.update, display_time, ..Displayed::default() });
    updates.recycle(shaded);
    [begin, place, shade, collect, encode].map(|step| step.count_total)
}

fn terms() -> (Welcome, Capabilities) {
    let (mut hello, mut offer) = (peers::hello(), peers::offer());
    (hello.capabilities.max_patch_slots, offer.patch_slots) = (20_000, 20_000);
    (hello.capabilities.max_vertex_slots, offer.vertex_slots) = (60_000, 60_000);
    hello.capabilities.max_triangles = 120_000;
    hello.capabilities.eye_extent_pixels = [96, 96];
    offer.atlas_extent_texels = AtlasExtent::new(1024, 1024).expect("an atlas");
    let welcome = negotiate(&hello, &offer).expect("they agree");
    (welcome, hello.capabilities)
}

fn head(turn: f32) -> Pose {
    Pose { position: Vec3::new(0.0, 1.6, 1.0), orientation: Quat::from_rotation_y(turn) }
}

#[test]
fn of_what_stands_still() {
    hold(&made(3, false, |_| head(0.0)), 0);
}

#[test]
fn of_what_moves_before_a_still_head() {
    hold(&made(3, true, |_| head(0.0)), GROWN_UPDATES);
}

#[test]
fn of_what_moves_before_a_head_that_sways() {
    hold(&made(1, true, |number| head((number as f32 * 0.1).sin() * 0.2)), GROWN_UPDATES);
}
