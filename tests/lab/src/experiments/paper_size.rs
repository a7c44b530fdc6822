//! The paper's largest scene at full size: 169 dragons, all in view, streamed to a client of 150,000 vertices, and its costs.

use super::run::mock_config;
use super::table1::cell::{FOV_DEGREES, Size, boxes, eye_for, head_csv, source, whole_in_view};
use crate::session::Lab;
use crate::session::options::{Head, RunOptions};
use anyhow::ensure;
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::ClockKind;
use shadecast_scene::load::load_scene;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::room::Room;
use std::fmt;
use std::path::Path;

/// Vertices that the client offers to keep.
const ROOM_VERTICES: u32 = 150_000;
/// Of virtual time: until all has arrived, and some updates more.
const SECONDS: f64 = 0.7;

/// What was shown, and what it took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PaperSize {
    /// Dragons, all of them whole in view.
    pub dragons: u32,
    /// Pixels a side of an eye.
    pub extent_pixels: [u32; 2],
    /// Updates that were made.
    pub updates: usize,
    /// Vertices that the client may keep.
    pub room_vertices: u32,
    /// Most vertices of dragons that it kept.
    pub vertices: usize,
    /// Most patches that an update showed.
    pub patches: u32,
    /// Most triangles, those of two sides twice.
    pub triangles: u32,
    /// Level of detail of the instances of the last update, on average.
    pub mean_level: f64,
    /// Texels that a pixel of the display had in the last update.
    pub texels_per_pixel: f32,
    /// Patches in view that were not shown, over all updates.
    pub dropped_patches: u64,
    /// What the server held on its device, mapped or not, bytes.
    pub device_bytes: u64,
    /// Messages of the validation layers.
    pub validation_messages: u64,
}

impl fmt::Display for PaperSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { dragons, updates, vertices, room_vertices, patches, triangles, .. } = self;
        writeln!(
            f,
            "{dragons} dragons, {updates} updates: {vertices} vertices of {room_vertices}, {patches} patches,"
        )?;
        write!(
            f,
            "{triangles} triangles, {:.2} texels a pixel, {} patches dropped, {:.0} MB on the device, {} messages",
            self.texels_per_pixel,
            self.dropped_patches,
            self.device_bytes as f64 * 1e-6,
            self.validation_messages
        )
    }
}

/// Streams so many dragons with validation layers on; files go to `folder`. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(dragons: u32, size: Size, folder: &Path) -> anyhow::Result<PaperSize> {
    let scene = load_scene(&source(dragons))?;
    let boxes = boxes(&scene);
    let eye = eye_for(&boxes);
    ensure!(whole_in_view(&boxes, eye) == boxes.len(), "all dragons are whole in view from {eye}");
    std::fs::create_dir_all(folder)?;
    let head = folder.join("head.csv");
    std::fs::write(&head, head_csv(&scene, eye))?;
    let usual = RunOptions::new(source(dragons), folder.join("run"));
    let options = RunOptions {
        head: Head::File(head),
        extent_pixels: size.extent_pixels,
        fov_degrees: FOV_DEGREES,
        atlas_extent_texels: size.atlas_extent_texels,
        room: Room { vertices: ROOM_VERTICES, ..usual.room },
        seconds: SECONDS,
        surround: DEFAULT_SURROUND,
        validation: true,
        ..usual
    };
    let config = mock_config(&options, ClockKind::Virtual, 0)?;
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(&options, &config) }?;
    let mut vertices = 0;
    while let Step::Frame(_) = lab.step()? {
        vertices = vertices.max(lab.seat().moving_vertices());
    }
    let (shows, gpu) = (&lab.seat().shows, &lab.server.gpu);
    let last = shows.last().cloned().unwrap_or_default();
    Ok(PaperSize {
        dragons,
        extent_pixels: options.extent_pixels,
        updates: shows.len(),
        room_vertices: ROOM_VERTICES,
        vertices,
        patches: shows.iter().map(|update| update.patches).max().unwrap_or(0),
        triangles: shows.iter().map(|update| update.triangles).max().unwrap_or(0),
        mean_level: last.lods.iter().sum::<usize>() as f64 / last.lods.len().max(1) as f64,
        texels_per_pixel: last.texels_per_pixel,
        dropped_patches: lab.seat().dropped_patches(),
        device_bytes: gpu.memory().iter().map(|held| held.bytes).sum(),
        validation_messages: u64::from(gpu.validation_messages())
            + lab.client.presenter.stats().validation_messages.map_or(0, u64::from),
    })
}
