//! Reuse of shading, beside a viewer whose updates shade everything, on one device. Validation is on.

use glam::{Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::message::{Capabilities, HeadState, Welcome, negotiate};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::Scene;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::encode::Source;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::shading::reuse::{Cause, Reused};
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_server::update::{Shaded, ShowOptions, Shows, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use shadecast_test_support::peers;
use std::sync::Arc;

const PERIOD_NS: i64 = 33_333_333;
/// Updates until what is shown has come to rest: levels, blocks and their sizes.
const SETTLED: u32 = 24;

/// Two viewers who see the same: one reuses blocks, the other shades all.
struct Both {
    gpu: Arc<Gpu>,
    world: World,
    viewers: [ViewerUpdates; 2],
    update: u32,
}

impl Both {
    fn new(scene: Scene) -> Self {
        let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
        let gpu = Gpu::open(&options, &DesktopDevice)
            .expect("a Vulkan device; `./shadecast setup` installs a software one");
        let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("a scene"));
        let world = World::new(&gpu, &scene).expect("memory");
        let (welcome, capabilities) = terms();
        let show = ShowOptions { detail_pixels: 1.0, surround: 0.0 };
        let updates = |(number, reuse): (u64, bool)| {
            let policy = UpdatePolicy { reuse, ..UpdatePolicy::default() };
            ViewerUpdates::with_policy(&world, ViewerId(number), &welcome, &capabilities, show, policy)
                .expect("memory")
        };
        let viewers = [(1, true), (2, false)].map(updates);
        Self { gpu, viewers, world, update: 0 }
    }

    /// An update of both for a head at a place, and what the first of them shows.
    fn update(&mut self, position: Vec3, orientation: Quat) -> ([I420; 2], Shows) {
        let now = ServerTime(i64::from(self.update) * PERIOD_NS);
        let world_from_head = Pose { position, orientation };
        let head = HeadState { world_from_head, ..peers::head(self.update, now) };
        self.update += 1;
        let world = &mut self.world;
        let pictures = self.viewers.each_mut().map(|updates| {
            updates.head(head);
            let Shaded { picture: Source::Planes(picture), .. } =
                updates.update(world, now).expect("a device").expect("a head is known");
            picture
        });
        (pictures, self.viewers[0].shows(&self.world))
    }

    /// The blocks of both, which are the same.
    #[track_caller]
    fn blocks(&self) -> Vec<Block> {
        let [reused, all] =
            self.viewers.each_ref().map(|updates| updates.layout().live().collect::<Vec<_>>());
        assert_eq!(reused, all, "what is seen does not depend on what is shaded");
        reused.into_iter().map(|(_, block)| block).collect()
    }

    #[track_caller]
    fn ends_well(self) {
        assert_eq!(self.gpu.validation_messages(), 0, "{:#?}", self.gpu.validation_texts());
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

/// The largest difference of luma in any of the blocks, in steps.
fn worst_luma(pictures: &[I420; 2], blocks: &[Block]) -> (u8, Option<Block>) {
    let [width, _] = pictures[0].extent_texels();
    let [reused, all] = pictures.each_ref().map(|picture| picture.planes()[0]);
    let of_block = |block: &Block| {
        let [left, top, right, bottom] = block.rect_texels();
        let rows = (top..bottom).flat_map(|y| (left..right).map(move |x| (y * width + x) as usize));
        rows.map(|at| reused[at].abs_diff(all[at])).max().unwrap_or(0)
    };
    let worst = blocks.iter().max_by_key(|block| of_block(block));
    (worst.map_or(0, of_block), worst.copied())
}

/// Dragons on their ground, which move or stand.
fn dragons(count: u32, is_moving: bool) -> Scene {
    let mut scene = load_scene(&SceneSource::Dragons(count)).expect("built in");
    if !is_moving {
        scene.instances.iter_mut().for_each(|instance| (instance.clip, instance.path) = (None, None));
    }
    scene
}

const AT: Vec3 = Vec3::new(0.0, 1.6, 2.0);

fn down(radians: f32) -> Quat {
    Quat::from_rotation_x(-radians)
}

#[test]
fn a_still_scene_is_shaded_and_converted_once() {
    let mut both = Both::new(dragons(9, false));
    for _ in 0..SETTLED {
        both.update(AT, down(0.3));
    }
    let ([before, _], _) = both.update(AT, down(0.3));
    let ([now, all], shows) = both.update(AT, down(0.3));
    assert_eq!((shows.pairs, shows.reused.shaded_blocks(), shows.converted_texels), (1, 0, 0));
    assert!(shows.reused.blocks > 100 && shows.reused.share() == 1.0, "{:?}", shows.reused);
    assert!(before.bytes() == now.bytes(), "what the encoder sees has not changed");
    assert_eq!(worst_luma(&[now, all], &both.blocks()).0, 0);
    both.ends_well();
}

#[test]
fn shadows_of_what_moves_are_nowhere_old() {
    let mut both = Both::new(dragons(3, true));
    let (mut shaded, mut texels, mut last) = (0, 0, Reused::default());
    for update in 0..SETTLED {
        let (pictures, shows) = both.update(AT, down(0.4));
        last = shows.reused;
        let (worst, block) = worst_luma(&pictures, &both.blocks());
        assert!(worst <= 1, "update {update}: {worst} steps in {block:?}");
        (shaded, texels) = (shaded + shows.reused.shaded_texels, texels + shows.reused.texels);
    }
    println!("{:.3} of the texels were shaded, at last {last:?}", shaded as f64 / texels as f64);
    assert!(shaded < texels * 9 / 10, "the ground beside the shadows stays: {shaded} of {texels}");
    both.ends_well();
}

#[test]
fn reused_shading_differs_by_few_steps_for_a_moving_head() {
    let mut both = Both::new(dragons(3, false));
    // An NVIDIA H100 differs by five.
    let most = if both.gpu.is_cpu() { 4 } else { 5 };
    let (mut shaded, mut texels) = (0, 0);
    for update in 0..SETTLED {
        let sway = (update as f32 * 0.2).sin();
        let (pictures, shows) =
            both.update(AT + Vec3::X * 0.05 * sway, Quat::from_rotation_y(0.1 * sway) * down(0.3));
        let (worst, block) = worst_luma(&pictures, &both.blocks());
        assert!(worst <= most, "update {update}: {worst} steps in {block:?}");
        (shaded, texels) = (shaded + shows.reused.shaded_texels, texels + shows.reused.texels);
    }
    println!("{:.3} of the texels were shaded", shaded as f64 / texels as f64);
    assert!(shaded < texels / 2, "most looks the same from a little aside: {shaded} of {texels}");
    both.ends_well();
}

#[test]
fn a_budget_bounds_reshading_and_never_new_blocks() {
    const BUDGET_TEXELS: u64 = 20_000;
    let mut both = Both::new(dragons(3, true));
    both.viewers[0].set_shading_budget(BUDGET_TEXELS);
    let (mut waiting, mut oldest) = (0, 0);
    for update in 0..SETTLED {
        let ([bounded, all], shows) = both.update(AT, down(0.4));
        let Reused { shaded, shaded_texels, .. } = shows.reused;
        waiting += shows.reused.waiting;
        if shaded[Cause::New as usize] == 0 {
            assert!(shaded_texels <= BUDGET_TEXELS, "update {update}: {:?}", shows.reused);
        }
        oldest = oldest.max(worst_luma(&[bounded, all], &both.blocks()).0);
        assert!(update > 0 || oldest == 0, "all is new at first");
    }
    assert!(waiting > 0 && oldest > 0, "there is more to do than the budget allows");
    both.ends_well();
}
