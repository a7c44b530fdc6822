//! Statistics of a client and their report.

use crate::handover::Arrived;
use crate::report::FrameReport;
use serde::Serialize;
use shadecast_gpu::Gpu;
use shadecast_protocol::time::ClientTime;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// How a client fared, for `--stats` and the lab.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ClientStats {
    /// The Vulkan device's name.
    pub device: String,
    /// True where the device is a CPU: correct, slow.
    pub device_is_cpu: bool,
    /// The OpenXR runtime's name.
    pub runtime: String,
    /// From the first to the last display frame, seconds of display time.
    pub seconds: f64,
    /// Display frames per second of display time, without those that showed the picture before again.
    pub client_fps: f64,
    /// Bundles that came on display, per second of display time.
    pub bundles_per_s: f64,
    /// Display frames.
    pub frames: u64,
    /// Display frames that were rendered.
    pub rendered_frames: u64,
    /// Display frames for which the device was not done with those before, so that the last picture was shown again.
    pub repeated_frames: u64,
    /// Display frames, rendered or repeated, that showed a bundle.
    pub frames_with_bundle: u64,
    /// Bundles that came on display.
    pub bundles: u64,
    /// Sessions that stood.
    pub connections: u64,
    /// Bytes of the device's memory that the last of them keeps for vertices and how they move.
    pub motion_memory_bytes: u64,
    /// Steps of the time grid that it keeps of each vertex; 0 before the first.
    pub sample_ring: u32,
    /// Bytes of coded pictures received.
    pub atlas_bytes: u64,
    /// Bytes of geometry deltas received, samples included.
    pub geometry_bytes: u64,
    /// Vertex samples received.
    pub vertex_samples: u64,
    /// Vertices that went on at their last velocity, summed over display frames.
    pub held_vertices: u64,
    /// Vertices that had stopped for want of samples, poses or predictions, summed over display frames.
    pub frozen_vertices: u64,
    /// Vertices not drawn for want of their skeleton, or of its keys or poses, summed over display frames.
    pub withheld_vertices: u64,
    /// Patches not drawn for want of samples, summed over display frames.
    pub withheld_patches: u64,
    /// Bytes of skeletons, keys and morph targets that waited for the GPU's memory, at most.
    pub most_arena_waiting_bytes: u64,
    /// Pictures given up or undecodable.
    pub lost_pictures: u64,
    /// Refreshes asked for.
    pub refresh_requests: u64,
    /// How far the estimate of the server's clock could be off at most, over the display frames that showed a bundle,
    /// milliseconds; none before the first.
    pub clock_error_bound_ms: Option<f64>,
    /// The same at the last of them.
    pub clock_error_bound_last_ms: Option<f64>,
    /// Validation messages; none with validation off.
    pub validation_messages: Option<u32>,
}

impl ClientStats {
    /// What was counted in this and then in a later headset session, as one.
    #[must_use]
    pub fn and(self, later: Self) -> Self {
        // All fields by name: a new one does not compile until it is added up here.
        let Self {
            device,
            device_is_cpu,
            runtime,
            seconds,
            client_fps,
            bundles_per_s,
            frames,
            rendered_frames,
            repeated_frames,
            frames_with_bundle,
            bundles,
            connections,
            motion_memory_bytes,
            sample_ring,
            atlas_bytes,
            geometry_bytes,
            vertex_samples,
            held_vertices,
            frozen_vertices,
            withheld_vertices,
            withheld_patches,
            most_arena_waiting_bytes,
            lost_pictures,
            refresh_requests,
            clock_error_bound_ms,
            clock_error_bound_last_ms,
            validation_messages,
        } = later;
        let (motion_memory_bytes, sample_ring) = match connections {
            0 => (self.motion_memory_bytes, self.sample_ring),
            _ => (motion_memory_bytes, sample_ring),
        };
        let both_s = self.seconds + seconds;
        let rate = |a: f64, b: f64| {
            if both_s > 0.0 { (a * self.seconds + b * seconds) / both_s } else { 0.0 }
        };
        Self {
            device,
            device_is_cpu,
            runtime,
            seconds: both_s,
            client_fps: rate(self.client_fps, client_fps),
            bundles_per_s: rate(self.bundles_per_s, bundles_per_s),
            frames: self.frames + frames,
            rendered_frames: self.rendered_frames + rendered_frames,
            repeated_frames: self.repeated_frames + repeated_frames,
            frames_with_bundle: self.frames_with_bundle + frames_with_bundle,
            bundles: self.bundles + bundles,
            connections: self.connections + connections,
            motion_memory_bytes,
            sample_ring,
            atlas_bytes: self.atlas_bytes + atlas_bytes,
            geometry_bytes: self.geometry_bytes + geometry_bytes,
            vertex_samples: self.vertex_samples + vertex_samples,
            held_vertices: self.held_vertices + held_vertices,
            frozen_vertices: self.frozen_vertices + frozen_vertices,
            withheld_vertices: self.withheld_vertices + withheld_vertices,
            withheld_patches: self.withheld_patches + withheld_patches,
            most_arena_waiting_bytes: self.most_arena_waiting_bytes.max(most_arena_waiting_bytes),
            lost_pictures: self.lost_pictures + lost_pictures,
            refresh_requests: self.refresh_requests + refresh_requests,
            clock_error_bound_ms: larger(self.clock_error_bound_ms, clock_error_bound_ms),
            clock_error_bound_last_ms: clock_error_bound_last_ms.or(self.clock_error_bound_last_ms),
            validation_messages: sum(self.validation_messages, validation_messages),
        }
    }
}

/// Of what was counted.
fn sum(a: Option<u32>, b: Option<u32>) -> Option<u32> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a + b),
        _ => a.or(b),
    }
}

fn larger(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.into_iter().chain(b).reduce(f64::max)
}

/// The counters behind [`ClientStats`].
#[derive(Debug, Default)]
pub(crate) struct Counters {
    pub(crate) device: String,
    device_is_cpu: bool,
    runtime: String,
    span: Option<(ClientTime, ClientTime)>,
    pub(crate) frames: u64,
    rendered_frames: u64,
    pub(crate) repeated_frames: u64,
    frames_with_bundle: u64,
    pub(crate) bundles: u64,
    held_vertices: u64,
    frozen_vertices: u64,
    withheld_vertices: u64,
    withheld_patches: u64,
    most_arena_waiting_bytes: u64,
    /// Largest and last over the frames that showed a bundle, milliseconds.
    clock_error_bound_ms: (Option<f64>, Option<f64>),
    pub(crate) connections: u64,
    pub(crate) motion_memory_bytes: u64,
    pub(crate) sample_ring: u32,
    pub(crate) arrived: Arc<Arrived>,
}

/// What has been counted so far, perhaps on another thread.
pub(crate) fn so_far(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}

impl Counters {
    pub(crate) fn new(gpu: &Gpu, runtime: &str, arrived: Arc<Arrived>) -> Self {
        Self {
            arrived,
            device: gpu.device_name(),
            device_is_cpu: gpu.is_cpu(),
            runtime: runtime.to_owned(),
            ..Self::default()
        }
    }

    pub(crate) fn count(&mut self, frame: &FrameReport) {
        let (first, _) = self.span.unwrap_or((frame.display_time, frame.display_time));
        self.span = Some((first, frame.display_time));
        self.frames += 1;
        self.rendered_frames += u64::from(frame.is_rendered);
        self.repeated_frames += u64::from(frame.is_repeated);
        self.frames_with_bundle += u64::from(frame.is_seen() && frame.update.is_some());
        self.bundles += u64::from(frame.is_new);
        self.held_vertices += u64::from(frame.held_vertices);
        self.frozen_vertices += u64::from(frame.frozen_vertices);
        self.withheld_vertices += u64::from(frame.withheld_vertices);
        self.withheld_patches += u64::from(frame.withheld_patches);
        self.most_arena_waiting_bytes = self.most_arena_waiting_bytes.max(frame.arena_waiting_bytes);
        if let (Some(_), Some(bound_ns)) = (frame.update, frame.clock_error_bound_ns) {
            let bound_ms = Some(bound_ns as f64 * 1e-6);
            self.clock_error_bound_ms = (larger(self.clock_error_bound_ms.0, bound_ms), bound_ms);
        }
    }

    pub(crate) fn stats(&self, gpu: &Gpu) -> ClientStats {
        let seconds = self.span.map_or(0.0, |(first, last)| last.since(first) as f64 * 1e-9);
        // The first frame opens the span, so that it is not counted as one that took time.
        let per_s = |count: u64| if seconds > 0.0 { count.saturating_sub(1) as f64 / seconds } else { 0.0 };
        ClientStats {
            device: self.device.clone(),
            device_is_cpu: self.device_is_cpu,
            runtime: self.runtime.clone(),
            seconds,
            client_fps: per_s(self.frames - self.repeated_frames),
            bundles_per_s: per_s(self.bundles),
            frames: self.frames,
            rendered_frames: self.rendered_frames,
            repeated_frames: self.repeated_frames,
            frames_with_bundle: self.frames_with_bundle,
            bundles: self.bundles,
            connections: self.connections,
            motion_memory_bytes: self.motion_memory_bytes,
            sample_ring: self.sample_ring,
            atlas_bytes: so_far(&self.arrived.atlas_bytes),
            geometry_bytes: so_far(&self.arrived.geometry_bytes),
            vertex_samples: so_far(&self.arrived.vertex_samples),
            held_vertices: self.held_vertices,
            frozen_vertices: self.frozen_vertices,
            withheld_vertices: self.withheld_vertices,
            withheld_patches: self.withheld_patches,
            most_arena_waiting_bytes: self.most_arena_waiting_bytes,
            lost_pictures: so_far(&self.arrived.lost_pictures),
            refresh_requests: so_far(&self.arrived.refresh_requests),
            clock_error_bound_ms: self.clock_error_bound_ms.0,
            clock_error_bound_last_ms: self.clock_error_bound_ms.1,
            validation_messages: gpu.checked_messages(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_headset_that_was_opened_twice_is_counted_as_one() {
        let first = ClientStats {
            runtime: "first".into(),
            seconds: 3.0,
            client_fps: 70.0,
            frames: 211,
            connections: 1,
            sample_ring: 8,
            withheld_vertices: 5,
            most_arena_waiting_bytes: 900,
            clock_error_bound_ms: Some(7.0),
            ..ClientStats::default()
        };
        let second = ClientStats {
            runtime: "second".into(),
            seconds: 1.0,
            client_fps: 90.0,
            frames: 91,
            connections: 1,
            sample_ring: 32,
            withheld_vertices: 2,
            most_arena_waiting_bytes: 300,
            clock_error_bound_ms: Some(4.0),
            clock_error_bound_last_ms: Some(2.0),
            ..ClientStats::default()
        };
        let both = ClientStats::default().and(first.clone()).and(second);
        assert_eq!((both.runtime.as_str(), both.seconds, both.client_fps), ("second", 4.0, 75.0));
        assert_eq!((both.frames, both.connections, both.sample_ring), (302, 2, 32));
        assert_eq!(first.clone().and(ClientStats::default()).sample_ring, 8, "no later session stood");
        assert_eq!((both.withheld_vertices, both.most_arena_waiting_bytes), (7, 900));
        assert_eq!((both.clock_error_bound_ms, both.clock_error_bound_last_ms), (Some(7.0), Some(2.0)));
        assert_eq!(ClientStats::default().and(first.clone()), first);
    }
}
