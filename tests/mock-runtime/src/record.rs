//! Records of a run: one line of `frames.jsonl` per frame, the pictures' names, `summary.json`. The runtime writes these, and
//! the lab reads them with the same types.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shadecast_protocol::pose::{Fov, Pose};

/// File name of the frame log in the capture folder: a JSON object per line and frame.
pub const FRAMES_NAME: &str = "frames.jsonl";

/// File name of the summary in the capture folder.
pub const SUMMARY_NAME: &str = "summary.json";

/// One of the two eyes, in the order of OpenXR's stereo views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// View 0.
    Left,
    /// View 1.
    Right,
}

impl Side {
    /// Both, in view order.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];

    fn name(self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Right => "right",
        }
    }
}

/// Path of the picture of `side` in frame `frame`.
pub fn picture_path(capture_dir: &Path, frame: u64, side: Side) -> PathBuf {
    capture_dir.join(format!("frame-{frame:06}-{}.png", side.name()))
}

/// One frame as the application submitted it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Index of the frame: the number of `xrWaitFrame` calls before its own.
    pub frame: u64,
    /// When the frame is displayed, nanoseconds of `XrTime`.
    pub predicted_display_time_ns: i64,
    /// When its `xrWaitFrame` returned, nanoseconds of `XrTime`.
    pub wait_time_ns: i64,
    /// True where pictures of both eyes were written.
    pub captured: bool,
    /// True where no projection layer was submitted.
    pub empty: bool,
    /// True where the pictures of the frame before were submitted again: nothing was released since. No pictures are written of such a
    /// frame, but of the next one that has other pictures.
    #[serde(default)]
    pub repeated: bool,
    /// True where the next `xrBeginFrame` came without an `xrEndFrame` of this frame.
    pub discarded: bool,
    /// The two views of the first projection layer; none where the frame is empty.
    pub views: Vec<ViewRecord>,
    /// Pose of the head in the stage at the display time, by the head path.
    pub head_pose: PoseRecord,
}

/// One view of a projection layer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewRecord {
    /// Pose of the eye as submitted, in the layer's space.
    pub pose: PoseRecord,
    /// The same pose in the stage's frame at the display time.
    pub stage_pose: PoseRecord,
    /// Angles of the view as submitted, radians: left, right, up, down; left and down are usually negative.
    pub fov: [f32; 4],
}

/// A pose, as it is written.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseRecord {
    /// x, y, z in metres.
    pub position: [f32; 3],
    /// Unit quaternion x, y, z, w.
    pub orientation: [f32; 4],
}

/// The whole run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Frames that `xrWaitFrame` handed out.
    pub frames: u64,
    /// From the first to the last `xrWaitFrame`, seconds of `XrTime`.
    pub seconds: f64,
    /// Calls that were refused because the application made a mistake.
    pub errors: u64,
    /// Display periods for which there was no frame (real clock).
    pub missed_frames: u64,
    /// Frames without a projection layer.
    pub empty_frames: u64,
    /// Frames that showed the pictures of the one before again.
    #[serde(default)]
    pub repeated_frames: u64,
    /// Frames that were begun and never ended.
    pub discarded_frames: u64,
    /// Frames of which pictures were written.
    pub captured_frames: u64,
    /// Frames that were ended for another display time than the predicted one.
    #[serde(default)]
    pub other_display_times: u64,
    /// What the application last asked of processor and graphics processor (`XR_EXT_performance_settings`): 50 is sustained high; 0
    /// where it asked for nothing, or to save power.
    #[serde(default)]
    pub performance_levels: [i32; 2],
    /// The level of fixed foveation that the application asked for last, 1 to 3 (`XR_FB_foveation`); 0 for none.
    #[serde(default)]
    pub foveation_level: i32,
}

impl From<Pose> for PoseRecord {
    fn from(pose: Pose) -> Self {
        Self { position: pose.position.to_array(), orientation: pose.orientation.to_array() }
    }
}

impl From<PoseRecord> for Pose {
    fn from(record: PoseRecord) -> Self {
        Self { position: record.position.into(), orientation: glam::Quat::from_array(record.orientation) }
    }
}

impl ViewRecord {
    /// The view's frustum.
    pub fn frustum(&self) -> Fov {
        let [left, right, up, down] = self.fov;
        Fov { left, right, up, down }
    }
}

/// Reads the frame log of a capture folder.
pub fn read_frames(capture_dir: &Path) -> io::Result<Vec<FrameRecord>> {
    let reader = BufReader::new(File::open(capture_dir.join(FRAMES_NAME))?);
    reader.lines().map(|line| Ok(serde_json::from_str(&line?)?)).collect()
}

/// Reads the summary of a capture folder.
pub fn read_summary(capture_dir: &Path) -> io::Result<Summary> {
    Ok(serde_json::from_str(&std::fs::read_to_string(capture_dir.join(SUMMARY_NAME))?)?)
}

/// Writer of a capture folder.
pub(crate) struct Recorder {
    capture_dir: PathBuf,
    frames: File,
}

impl Recorder {
    /// Opens the log in `capture_dir`, made where missing; an older log is continued or replaced.
    pub(crate) fn open(capture_dir: &Path, continue_log: bool) -> io::Result<Self> {
        std::fs::create_dir_all(capture_dir)?;
        let path = capture_dir.join(FRAMES_NAME);
        let mut options = File::options();
        let frames = match continue_log {
            true => options.append(true).create(true).open(path)?,
            false => options.write(true).create(true).truncate(true).open(path)?,
        };
        Ok(Self { capture_dir: capture_dir.to_owned(), frames })
    }

    /// Appends a frame; unbuffered, so that a killed application leaves a complete log.
    pub(crate) fn frame(&mut self, record: &FrameRecord) -> io::Result<()> {
        let mut line = serde_json::to_vec(record)?;
        line.push(b'\n');
        self.frames.write_all(&line)
    }

    pub(crate) fn summary(&self, summary: &Summary) -> io::Result<()> {
        let text = serde_json::to_string_pretty(summary)? + "\n";
        std::fs::write(self.capture_dir.join(SUMMARY_NAME), text)
    }

    /// Writes one eye's picture. `rgb` is `width * height` times red, green, blue: sRGB bytes as the image holds them.
    pub(crate) fn picture(&self, frame: u64, side: Side, size: [u32; 2], rgb: &[u8]) -> io::Result<()> {
        let file = io::BufWriter::new(File::create(picture_path(&self.capture_dir, frame, side))?);
        let mut encoder = png::Encoder::new(file, size[0], size[1]);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(rgb)?;
        writer.finish()?;
        Ok(())
    }
}
