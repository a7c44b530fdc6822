//! `shadecast-lab motion`: one table of all kinds of motion over several links: their error on display, and their costs on the
//! link, the client and the server.
//!
//! A scene enters, kinds of motion and links. A row per pair leaves. Nothing here knows colours.

mod conditions;
mod watch;

pub use conditions::{Condition, KINDS, Kind};
pub use watch::Worst;

use crate::experiments::run::{mock_config, progress};
use crate::measure::motion::px_at_2m;
use crate::report::text_table::table;
use crate::session::Lab;
use crate::session::options::RunOptions;
use crate::session::seat::Sent;
use anyhow::Context;
use serde::Serialize;
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_server::scene::SceneOptions;
use shadecast_system::clock::thread_cpu_ns;
use std::collections::BTreeMap;
use std::fmt;
use watch::Watch;

/// The stage of the client's device that moves vertices.
const CLIENT_STAGE: &str = "motion";

/// One table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionTable {
    /// The scene as a person calls it.
    pub scene: String,
    /// The clip that all play, where it is not the scene's own choice.
    pub clip: Option<String>,
    /// Virtual seconds of each run.
    pub seconds: f64,
    /// Pixels per eye of the client; errors in pixels are those of the paper's picture, 1300 over 90 degrees.
    pub extent_pixels: [u32; 2],
    /// Display frames per second.
    pub refresh_hz: f64,
    /// Of links and connections.
    pub seed: u64,
    /// The device of both sides.
    pub device: String,
    /// Whether that is a CPU, so that its milliseconds say little.
    pub device_is_cpu: bool,
    /// By kind, then by link.
    pub rows: Vec<MotionRow>,
}

/// One kind over one link. Errors are distances between where a vertex is drawn and where its source curves lead at the time at
/// which the client believes that it is seen. Static vertices are left out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionRow {
    /// How vertices move.
    pub kind: Kind,
    /// The network, as the command line names it.
    pub link: String,
    /// Largest error, millimetres.
    pub max_error_mm: f64,
    /// 99 of 100 vertex-frames have no larger one.
    pub p99_error_mm: f64,
    /// The largest, in pixels of the paper's picture seen from 2 m.
    pub max_error_px: f64,
    /// Where that was.
    pub worst: Option<Worst>,
    /// Bytes of what says how vertices move, handed to the transport.
    pub motion_bytes: u64,
    /// The same and all others by cause.
    pub bytes: Bytes,
    /// Positions on the time grid that were sent: of each vertex with samples, drawn or kept, one a step.
    pub samples: u64,
    /// What each of them took on the wire, bytes.
    pub bytes_per_sample: Option<f64>,
    /// Vertices that stood still though they should have moved on, summed over display frames.
    pub frozen_vertex_frames: u64,
    /// Vertices at edges whose ends are at places of different times, summed over display frames.
    pub torn_vertex_frames: u64,
    /// Vertices that went on at their last velocity, by what the client says, summed over display frames.
    pub held_vertex_frames: u64,
    /// Vertices that had no sample for the frame's time, by what the client says, summed over display frames.
    pub stopped_vertex_frames: u64,
    /// Vertices of instances that were not shown yet, by what the client says, summed over display frames.
    pub withheld_vertex_frames: u64,
    /// Bytes of its device's memory that the client keeps for vertices and how they move.
    pub client_motion_memory_bytes: u64,
    /// Steps of the time grid that it keeps of each vertex.
    pub sample_ring: u32,
    /// Milliseconds of the client's device that moving vertices took, mean over display frames.
    pub client_gpu_ms: f64,
    /// The same for each of its stages.
    pub client_stage_ms: BTreeMap<String, f64>,
    /// Milliseconds of the server's CPU for animation, read-back and deltas, mean over updates.
    pub server_cpu_ms: f64,
    /// Of that, what came before the device's work: poses, and the recording of skinning and read-back.
    pub server_animation_cpu_ms: f64,
    /// Milliseconds of each stage of the server's device, mean over updates.
    pub server_stage_ms: BTreeMap<String, f64>,
    /// Milliseconds of the client's device for a display frame, mean.
    pub client_frame_gpu_ms: f64,
    /// Of that frame, how many times what it takes without moving vertices.
    pub animated_over_static: Option<f64>,
    /// Animated and static vertices that entered the client's memory.
    pub entered_vertices: u64,
    /// What each of them took on the wire, with what it is before skinning, bytes; evictions are in it.
    pub bytes_per_entered_vertex: Option<f64>,
    /// Display frames looked at.
    pub frames: u64,
    /// Animated vertices drawn in any of them.
    pub vertices: u64,
    /// Animated vertices drawn, summed over them.
    pub vertex_frames: u64,
    /// Updates that the server made.
    pub updates: u64,
    /// Connections that stood, one after the other.
    pub connections: u64,
    /// By how much the client's idea of the server's time went faster or slower than time from one display frame to the next,
    /// at most, milliseconds.
    pub max_clock_step_ms: f64,
    /// How far that idea was from the truth at most, milliseconds.
    pub clock_error_ms: f64,
    /// How far it could be by what the client knew, milliseconds.
    pub clock_error_bound_ms: Option<f64>,
    /// Messages of the validation layers of both sides; none where they are off.
    pub validation_messages: Option<u64>,
}

/// Bytes handed to the transport, by cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Bytes {
    /// Keys of clips.
    pub keys: u64,
    /// Changes of what is played.
    pub schedules: u64,
    /// Poses on the time grid.
    pub poses: u64,
    /// Positions on the time grid.
    pub samples: u64,
    /// Positions that updates predict.
    pub predictions: u64,
    /// Skeletons, and the instances that they move.
    pub skeletons: u64,
    /// Vertices before skinning.
    pub rests: u64,
    /// Vertices that enter and leave the client's memory.
    pub vertices: u64,
    /// Patches that enter and leave.
    pub patches: u64,
    /// Where in the atlas patches are.
    pub placements: u64,
    /// All deltas, with what heads them.
    pub deltas: u64,
    /// Pictures.
    pub pictures: u64,
}

impl From<Sent> for Bytes {
    fn from(sent: Sent) -> Self {
        Self {
            keys: sent.motion.chunk_bytes,
            schedules: sent.motion.schedule_bytes,
            poses: sent.motion.pose_bytes,
            samples: sent.motion.sample_bytes,
            predictions: sent.prediction_bytes,
            skeletons: sent.skeleton_bytes,
            rests: sent.rest_bytes,
            vertices: sent.vertex_bytes,
            patches: sent.patch_bytes,
            placements: sent.placement_bytes,
            deltas: sent.geometry_bytes,
            pictures: sent.atlas_bytes,
        }
    }
}

impl Bytes {
    /// Of what says how vertices move.
    fn motion(&self) -> u64 {
        self.keys + self.schedules + self.poses + self.samples + self.predictions
    }
}

/// Runs `options` once for each kind and link, and says how it went. `scene` is the scene as a person calls it. To be called
/// where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on, and a run in which nothing animated is drawn.
pub fn measure(
    options: &RunOptions,
    scene: &str,
    kinds: &[Kind],
    conditions: &[Condition],
) -> anyhow::Result<MotionTable> {
    let mut found = MotionTable {
        scene: scene.to_owned(),
        clip: options.clip.clone(),
        seconds: options.seconds,
        extent_pixels: options.extent_pixels,
        refresh_hz: options.refresh_hz,
        seed: options.seed,
        device: String::new(),
        device_is_cpu: false,
        rows: Vec::new(),
    };
    for kind in kinds {
        for condition in conditions {
            let doing = || format!("measuring {kind} over {condition}");
            let (row, lab) = measure_one(options, *kind, condition).with_context(doing)?;
            (found.device, found.device_is_cpu) = (lab.server.gpu.device_name(), lab.server.gpu.is_cpu());
            found.rows.push(row);
        }
    }
    Ok(found)
}

/// One row, and what is left of its run.
fn measure_one(options: &RunOptions, kind: Kind, condition: &Condition) -> anyhow::Result<(MotionRow, Lab)> {
    let options = RunOptions {
        link: condition.link.clone(),
        rate_hz: condition.updates_hz,
        scene_options: SceneOptions { motion: kind.option, ..options.scene_options },
        reconnects: true,
        // Every vertex is looked at, not those of coarser levels alone.
        detail_pixels: 0.0,
        ..options.clone()
    };
    let config = MockConfig { capture_dir: None, ..mock_config(&options, ClockKind::Virtual, 0)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(&options, &config) }?;
    lab.server.world.effort_mut().measure_by(thread_cpu_ns);
    let bar = progress(options.verbose, (options.seconds * options.refresh_hz).round() as u64);
    let mut watch = Watch::default();
    while let Step::Frame(frame) = lab.step()? {
        watch.look(&mut lab, &frame)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok((MotionRow::new(kind, condition, &lab, &watch)?, lab))
}

impl MotionRow {
    fn new(kind: Kind, condition: &Condition, lab: &Lab, watch: &Watch) -> anyhow::Result<Self> {
        let max_error_mm = watch.errors_mm.largest().context("nothing animated was drawn")?;
        let (seat, client, effort) = (lab.seat(), lab.client.presenter.stats(), *lab.server.world.effort());
        let bytes = Bytes::from(seat.sent);
        let (frames, updates) = (watch.frames.max(1) as f64, seat.sent.updates.max(1) as f64);
        let client_stage_ms = means(&watch.client_gpu_ms, frames);
        let client_gpu_ms = client_stage_ms.get(CLIENT_STAGE).copied().unwrap_or(0.0);
        let client_frame_gpu_ms: f64 = client_stage_ms.values().sum();
        let still_ms = client_frame_gpu_ms - client_gpu_ms;
        let entry_bytes = (bytes.vertices + bytes.rests + bytes.skeletons) as f64;
        Ok(Self {
            kind,
            link: condition.to_string(),
            max_error_mm,
            p99_error_mm: watch.errors_mm.at(99.0).unwrap_or(max_error_mm),
            max_error_px: px_at_2m(max_error_mm),
            worst: watch.worst.clone(),
            motion_bytes: bytes.motion(),
            bytes,
            samples: seat.sent.motion.samples,
            bytes_per_sample: (seat.sent.motion.samples > 0)
                .then(|| bytes.samples as f64 / seat.sent.motion.samples as f64),
            frozen_vertex_frames: watch.frozen_vertex_frames,
            torn_vertex_frames: watch.torn_vertex_frames,
            held_vertex_frames: watch.held_vertex_frames,
            stopped_vertex_frames: watch.stopped_vertex_frames,
            withheld_vertex_frames: watch.withheld_vertex_frames,
            client_motion_memory_bytes: client.motion_memory_bytes,
            sample_ring: client.sample_ring,
            client_gpu_ms,
            client_frame_gpu_ms,
            animated_over_static: (still_ms > 0.0).then(|| client_frame_gpu_ms / still_ms),
            entered_vertices: seat.sent.new_vertices,
            bytes_per_entered_vertex: (seat.sent.new_vertices > 0)
                .then(|| entry_bytes / seat.sent.new_vertices as f64),
            client_stage_ms,
            server_cpu_ms: (effort.animation_ms() + effort.delta_ms()) / updates,
            server_animation_cpu_ms: effort.animation_ms() / updates,
            server_stage_ms: means(&seat.gpu_ms, updates),
            frames: watch.frames,
            vertices: watch.vertices(),
            vertex_frames: watch.vertex_frames,
            updates: seat.sent.updates,
            connections: client.connections,
            max_clock_step_ms: watch.max_clock_step_ms,
            clock_error_ms: watch.max_clock_error_ms,
            clock_error_bound_ms: client.clock_error_bound_ms,
            validation_messages: crate::report::stats::messages_of_both(&lab.server.gpu, &client),
        })
    }

    fn cells(&self) -> [String; 11] {
        [
            self.kind.to_string(),
            self.link.clone(),
            format!("{:.3}", self.max_error_mm),
            format!("{:.3}", self.p99_error_mm),
            format!("{:.3}", self.max_error_px),
            format!("{:.1}", self.motion_bytes as f64 * 1e-3),
            self.frozen_vertex_frames.to_string(),
            self.torn_vertex_frames.to_string(),
            self.vertex_frames.to_string(),
            format!("{:.3}", self.client_gpu_ms),
            format!("{:.3}", self.server_cpu_ms),
        ]
    }
}

fn means(sums: &BTreeMap<&'static str, f64>, count: f64) -> BTreeMap<String, f64> {
    sums.iter().map(|(stage, ms)| ((*stage).to_owned(), ms / count)).collect()
}

impl fmt::Display for MotionTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scene, seconds, device, .. } = self;
        let clip = self.clip.as_ref().map_or(String::new(), |clip| format!(", clip {clip}"));
        let kind = if self.device_is_cpu { " (a CPU: milliseconds say little)" } else { "" };
        writeln!(f, "{scene}{clip}, {seconds} s of virtual time on {device}{kind}")?;
        let heads = [
            "kind",
            "link",
            "error mm",
            "99 %",
            "px at 2 m",
            "kB",
            "frozen",
            "torn",
            "of vertex-frames",
            "client GPU ms",
            "server CPU ms",
        ];
        f.write_str(&table(heads, self.rows.iter().map(MotionRow::cells)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_server::motion::sender::MotionBytes;

    #[test]
    fn bytes_of_motion_are_not_those_of_what_moves() {
        let sent = Sent {
            motion: MotionBytes { sample_bytes: 3, pose_bytes: 4, ..MotionBytes::default() },
            vertex_bytes: 11,
            patch_bytes: 13,
            prediction_bytes: 17,
            geometry_bytes: 100,
            ..Sent::default()
        };
        let bytes = Bytes::from(sent);
        assert_eq!((bytes.samples, bytes.poses), (3, 4));
        assert_eq!((bytes.motion(), bytes.vertices, bytes.patches, bytes.deltas), (24, 11, 13, 100));
    }
}
