//! Probe files of the client (`--probe-dir`): what a display frame showed, without its picture.

use crate::measure::metrics::ProbeView;
use anyhow::{Context, ensure};
use shadecast_protocol::pose::{Fov, Pose};
use std::path::Path;

/// Words before the pixels: width, height, and the eye.
const HEADER_WORDS: usize = 2 + 11;

/// One eye of a display frame.
#[derive(Clone, Debug)]
pub struct Probed {
    /// Takes eye coordinates to the world's, and the frustum; `None` where the frame showed no bundle.
    pub eye: Option<(Pose, Fov)>,
    /// What it saw.
    pub view: ProbeView,
}

/// Both eyes of the frame that was due at `display_time_ns`; `None` where it was not probed. A window's two eyes are one.
///
/// # Errors
/// A file cannot be read, or is cut short.
pub fn read_probes(folder: &Path, display_time_ns: i64) -> anyhow::Result<Option<[Probed; 2]>> {
    let path = |side| folder.join(format!("probe-{display_time_ns}-{side}.bin"));
    if !path("left").exists() {
        return Ok(None);
    }
    let left = read_probe(&path("left"))?;
    let right = if path("right").exists() { read_probe(&path("right"))? } else { left.clone() };
    Ok(Some([left, right]))
}

/// Display times of the probes in a folder, nanoseconds, the earliest first.
///
/// # Errors
/// The folder cannot be read.
pub fn probed_times_ns(folder: &Path) -> anyhow::Result<Vec<i64>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))?;
    let time = |name: &str| name.strip_prefix("probe-")?.strip_suffix("-left.bin")?.parse().ok();
    let mut times: Vec<i64> =
        entries.flatten().filter_map(|entry| time(entry.file_name().to_str()?)).collect();
    times.sort_unstable();
    Ok(times)
}

/// One probe file; its format is that of the client's `ProbeView::to_bytes`.
///
/// # Errors
/// The file cannot be read, or is cut short.
pub fn read_probe(path: &Path) -> anyhow::Result<Probed> {
    let bytes = std::fs::read(path).with_context(|| format!("reading {}", path.display()))?;
    let words: Vec<u32> =
        bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
    let (header, pixels) =
        words.split_at_checked(HEADER_WORDS).context("a probe begins with its extent and its eye")?;
    let [width, height] = [header[0], header[1]];
    let count = width as usize * height as usize;
    ensure!(pixels.len() == 2 * count, "{} is cut short", path.display());
    let (instances, depths) = pixels.split_at(count);
    let depth_m = depths.iter().map(|bits| f32::from_bits(*bits)).collect();
    let view = ProbeView { width, height, instance: instances.to_vec(), depth_m };
    Ok(Probed { eye: eye(&header[2..]), view })
}

fn eye(words: &[u32]) -> Option<(Pose, Fov)> {
    let values: Vec<f32> = words.iter().map(|bits| f32::from_bits(*bits)).collect();
    let &[px, py, pz, qx, qy, qz, qw, left, right, up, down] = values.as_slice() else { return None };
    let pose =
        Pose { position: glam::Vec3::new(px, py, pz), orientation: glam::Quat::from_xyzw(qx, qy, qz, qw) };
    (left != right).then_some((pose, Fov { left, right, up, down }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_client::draw::stages::probe::ProbeView as ClientView;

    #[test]
    fn what_the_client_writes_is_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let eye = (
            Pose { position: glam::Vec3::new(1.0, 2.0, 3.0), orientation: glam::Quat::from_rotation_y(0.3) },
            Fov { left: -0.8, right: 0.7, up: 0.6, down: -0.5 },
        );
        let nothing = ClientView::empty([2, 1]);
        let seen = ClientView {
            eye: Some(eye),
            instance: vec![3, u32::MAX],
            distance_m: vec![1.5, 9.0],
            ..nothing.clone()
        };
        for (time, view) in [(7, &nothing), (12, &seen)] {
            let path = folder.path().join(format!("probe-{time}-left.bin"));
            std::fs::write(path, view.to_bytes()).expect("a file");
        }
        assert_eq!(probed_times_ns(folder.path()).expect("times"), [7, 12]);
        let [left, right] = read_probes(folder.path(), 12).expect("a probe").expect("it is there");
        assert_eq!((left.eye, right.eye), (Some(eye), Some(eye)));
        assert_eq!((&left.view.instance, &left.view.depth_m), (&seen.instance, &seen.distance_m));
        let [left, _] = read_probes(folder.path(), 7).expect("a probe").expect("it is there");
        assert_eq!((left.eye, left.view.coverage()), (None, 0.0));
        assert!(read_probes(folder.path(), 8).expect("no file").is_none());
    }
}
