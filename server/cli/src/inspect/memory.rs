//! `inspect memory`: what a scene and one viewer of it hold on the device and of the host, measured: the scene is brought to the
//! device and updates are made.

use super::load;
use super::table::{Table, bytes};
use clap::Args;
use glam::Vec3;
use serde::Serialize;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Memory, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::limits::{DEFAULT_PATCH_SLOTS, DEFAULT_TRIANGLES, DEFAULT_VERTEX_SLOTS};
use shadecast_protocol::message::{Capabilities, ClientHello, HeadState, Welcome, negotiate};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::time::ServerTime;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::serve::stream::offer;
use shadecast_server::update::{ShowOptions, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use shadecast_system::process::resident_bytes;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Updates that are made: enough to use all that an update can.
const UPDATES: i64 = 12;
const UPDATE_NS: i64 = 33_333_333;
/// How high the eyes are above the stage, metres.
const EYE_HEIGHT_M: f32 = 1.6;

/// `inspect memory SCENE`.
#[derive(Args)]
pub struct MemoryArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// Pixels per eye of the viewer
    #[arg(long, default_value = "1300x1300", value_parser = shadecast_desktop::flags::size)]
    size: [u32; 2],
    /// Atlas width and height in texels, powers of two from 512x512 to 4096x2048
    #[arg(long, default_value = "4096x2048")]
    atlas: AtlasExtent,
    /// Part of the wanted Vulkan device's name
    #[arg(long)]
    device: Option<String>,
    /// JSON instead of text
    #[arg(long)]
    json: bool,
}

/// What is held after each step, most first.
#[derive(Serialize)]
struct Report {
    device: String,
    parts: Vec<Part>,
    device_bytes: u64,
    to_device_bytes: u64,
    from_device_bytes: u64,
    /// The process, when all was there; `None` where the system does not tell.
    resident_bytes: Option<u64>,
}

/// Of one name, after one step.
#[derive(Serialize)]
struct Part {
    part: String,
    /// Who holds it.
    of: &'static str,
    device_bytes: u64,
    /// Mapped, for the CPU to write: mirrors and lists.
    to_device_bytes: u64,
    /// Mapped, for the CPU to read.
    from_device_bytes: u64,
}

pub(super) fn run(args: &MemoryArgs) -> anyhow::Result<String> {
    let (scene, _) = load(&args.scene)?;
    let options = GpuOptions { needs: Needs::Server, validation: false, device_name: args.device.clone() };
    let gpu = Gpu::open(&options, &DesktopDevice)?;
    let mut parts: BTreeMap<(String, &'static str), Part> = BTreeMap::new();
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default())?);
    note(&gpu, "the scene", &mut parts);
    let mut world = World::new(&gpu, &scene)?;
    note(&gpu, "all viewers", &mut parts);
    let (welcome, capabilities) = viewer(&scene, args)?;
    let show = ShowOptions {
        detail_pixels: shadecast_server::visibility::detail::DEFAULT_DETAIL_PIXELS,
        surround: DEFAULT_SURROUND,
    };
    let mut updates = ViewerUpdates::new(&world, ViewerId(0), &welcome, &capabilities, show)?;
    for update in 0..UPDATES {
        let now = ServerTime(update * UPDATE_NS);
        updates.head(head(&scene, &capabilities, update, now));
        updates.update(&mut world, now)?;
    }
    note(&gpu, "a viewer", &mut parts);
    let report = Report::new(gpu.device_name(), parts.into_values().collect());
    Ok(if args.json { serde_json::to_string_pretty(&report)? + "\n" } else { report.text() })
}

/// Adds what is held now and was not before.
fn note(gpu: &Gpu, of: &'static str, parts: &mut BTreeMap<(String, &'static str), Part>) {
    for held in gpu.memory() {
        let (known, name) = (&*parts, &held.name);
        let before: u64 =
            known.values().filter(|part| part.part == *name).map(|part| *part.bytes(held.memory)).sum();
        let more = held.bytes.saturating_sub(before);
        if more > 0 {
            let part = parts.entry((held.name.clone(), of)).or_insert_with(|| Part::new(&held.name, of));
            *part.bytes_mut(held.memory) += more;
        }
    }
}

/// The terms of a client with the usual room.
fn viewer(scene: &SceneGpu, args: &MemoryArgs) -> anyhow::Result<(Welcome, Capabilities)> {
    let eye = |x| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), ..Pose::IDENTITY },
        fov: Fov::symmetric_degrees(90.0),
    };
    let capabilities = Capabilities {
        max_vertex_slots: DEFAULT_VERTEX_SLOTS,
        max_patch_slots: DEFAULT_PATCH_SLOTS,
        max_triangles: DEFAULT_TRIANGLES,
        ..Capabilities::most([eye(-0.0315), eye(0.0315)], args.size, 13_888_889)
    };
    let hello = ClientHello::new(env!("CARGO_PKG_VERSION"), capabilities.clone());
    let welcome = negotiate(&hello, &offer(scene, args.atlas, 30.0, 0))
        .map_err(|refused| anyhow::anyhow!("{}; {}", refused.reason, refused.remedy))?;
    Ok((welcome, capabilities))
}

/// Somebody who stands where the scene puts people, and looks about.
fn head(scene: &SceneGpu, capabilities: &Capabilities, update: i64, time: ServerTime) -> HeadState {
    let turn = glam::Quat::from_rotation_y(0.02 * update as f32);
    let head = Pose { position: Vec3::new(0.0, EYE_HEIGHT_M, 0.0), orientation: turn };
    HeadState {
        sequence: update as u32,
        time,
        world_from_head: scene.scene.world_from_stage.then(head),
        linear_velocity: Vec3::ZERO,
        angular_velocity: Vec3::ZERO,
        eyes: capabilities.eyes,
        discontinuity: DiscontinuityId(0),
    }
}

impl Part {
    fn new(name: &str, of: &'static str) -> Self {
        Self { part: name.into(), of, device_bytes: 0, to_device_bytes: 0, from_device_bytes: 0 }
    }

    fn bytes(&self, memory: Memory) -> &u64 {
        match memory {
            Memory::Device => &self.device_bytes,
            Memory::Upload => &self.to_device_bytes,
            Memory::Readback => &self.from_device_bytes,
        }
    }

    fn bytes_mut(&mut self, memory: Memory) -> &mut u64 {
        match memory {
            Memory::Device => &mut self.device_bytes,
            Memory::Upload => &mut self.to_device_bytes,
            Memory::Readback => &mut self.from_device_bytes,
        }
    }

    fn all(&self) -> [u64; 3] {
        [self.device_bytes, self.to_device_bytes, self.from_device_bytes]
    }
}

impl Report {
    fn new(device: String, mut parts: Vec<Part>) -> Self {
        parts.sort_by_key(|part| std::cmp::Reverse(part.all().iter().sum::<u64>()));
        let sum = |memory| parts.iter().map(|part| part.bytes(memory)).sum();
        Self {
            device,
            device_bytes: sum(Memory::Device),
            to_device_bytes: sum(Memory::Upload),
            from_device_bytes: sum(Memory::Readback),
            resident_bytes: resident_bytes(std::process::id()),
            parts,
        }
    }

    fn text(&self) -> String {
        let mut table =
            Table::new(&["bytes held", "for", "on the device", "for it, mapped", "from it, mapped"]);
        let row = |all: [u64; 3]| all.map(|size| if size == 0 { String::new() } else { bytes(size) });
        for part in &self.parts {
            let cells = std::iter::once(part.of.to_owned()).chain(row(part.all()));
            table.row(&part.part, cells);
        }
        let all = [self.device_bytes, self.to_device_bytes, self.from_device_bytes];
        table.row("together", std::iter::once(String::new()).chain(row(all)));
        let resident = self.resident_bytes.map_or(String::new(), |size| {
            format!(
                "the whole process has {} bytes of memory, those of a software device among them\n",
                bytes(size)
            )
        });
        format!("{}\n{}{resident}", self.device, table.text())
    }
}
