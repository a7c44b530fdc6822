//! Records at the end of a frame: its line in the log, and the pictures of the submission.

use openxr_sys as xr;

use crate::fault::{CallResult, Fault};
use crate::frame::Frame;
use crate::gpu::ReadBack;
use crate::layers::{Submitted, SubmittedView};
use crate::record::{FrameRecord, Side, ViewRecord};
use crate::runtime::{Core, Session};
use crate::space;

/// Logs a frame that ended, with its pictures where they are due.
pub(crate) fn log_and_capture(
    core: &mut Core,
    session: &mut Session,
    frame: &Frame,
    submitted: Option<&Submitted>,
) -> CallResult<()> {
    let shown = submitted.map(Submitted::releases);
    let repeated = shown.is_some() && std::mem::replace(&mut session.shown, shown) == shown;
    core.tally.empty_frames += u64::from(submitted.is_none());
    core.tally.repeated_frames += u64::from(repeated);
    let every = u64::from(core.config.capture_every);
    let due = session.capture_is_due || (every > 0 && frame.index.is_multiple_of(every));
    session.capture_is_due = due && repeated;
    let captured = match submitted.filter(|_| due && !repeated && core.recorder.is_some()) {
        Some(submitted) => {
            take_pictures(core, session, frame, submitted)?;
            core.tally.captured_frames += 1;
            true
        }
        None => false,
    };
    let views = submitted.map(view_records).unwrap_or_default();
    let kind = FrameKind { captured, empty: submitted.is_none(), repeated, discarded: false };
    log(core, frame, kind, views)
}

/// Logs a frame that was begun and not ended.
pub(crate) fn log_discarded(core: &mut Core, frame: &Frame) -> CallResult<()> {
    let kind = FrameKind { captured: false, empty: true, repeated: false, discarded: true };
    log(core, frame, kind, Vec::new())
}

struct FrameKind {
    captured: bool,
    empty: bool,
    repeated: bool,
    discarded: bool,
}

fn log(core: &mut Core, frame: &Frame, kind: FrameKind, views: Vec<ViewRecord>) -> CallResult<()> {
    let stage_from_head = space::stage_from_head(core, frame.display_time_ns);
    let Some(recorder) = &mut core.recorder else { return Ok(()) };
    let record = FrameRecord {
        frame: frame.index,
        predicted_display_time_ns: frame.display_time_ns,
        wait_time_ns: frame.wait_time_ns,
        captured: kind.captured,
        empty: kind.empty,
        repeated: kind.repeated,
        discarded: kind.discarded,
        views,
        head_pose: stage_from_head.into(),
    };
    recorder.frame(&record).map_err(|error| {
        Fault::runtime(xr::Result::ERROR_RUNTIME_FAILURE, format!("cannot write the frame log: {error}"))
    })
}

fn view_records(submitted: &Submitted) -> Vec<ViewRecord> {
    let record = |view: &SubmittedView| ViewRecord {
        pose: view.layer_from_eye.into(),
        stage_pose: submitted.stage_from_layer.then(view.layer_from_eye).into(),
        fov: [view.fov.left, view.fov.right, view.fov.up, view.fov.down],
    };
    submitted.views.iter().map(record).collect()
}

fn take_pictures(core: &Core, session: &mut Session, frame: &Frame, submitted: &Submitted) -> CallResult<()> {
    let Session { gpu, swapchains, .. } = session;
    let mut parts = Vec::with_capacity(2);
    for view in &submitted.views {
        let swapchain = swapchains.get(&view.swapchain).ok_or_else(|| Fault::handle("swapchain"))?;
        parts.push(ReadBack {
            image: swapchain.image(view.image),
            array_index: view.array_index,
            offset: view.offset,
            extent: view.extent,
            blue_first: swapchain.blue_first(),
        });
    }
    let pictures = gpu.read_back(&parts)?;
    let Some(recorder) = &core.recorder else { return Ok(()) };
    for ((side, part), rgb) in Side::BOTH.into_iter().zip(&parts).zip(&pictures) {
        recorder.picture(frame.index, side, part.extent, rgb).map_err(|error| {
            let message = format!("cannot write a picture of frame {}: {error}", frame.index);
            Fault::runtime(xr::Result::ERROR_RUNTIME_FAILURE, message)
        })?;
    }
    Ok(())
}
