//! `shadecast-lab run --renderer forward`: the truth's pictures at the poses and display times of another renderer. Nothing is
//! compared: there is no second picture.

use super::{Report, comparer, progress};
use crate::image::Rgb8Image;
use crate::measure::compare::Comparer;
use crate::report::stats::{Counted, Summary};
use crate::session::options::RunOptions;
use crate::session::{START_NS, Server};
use anyhow::Context;
use glam::{Quat, Vec3};
use shadecast_mock_runtime::clock::period_begin_ns;
use shadecast_mock_runtime::config::MockConfig;
use shadecast_mock_runtime::head_path::HeadPath;
use shadecast_protocol::pose::{Fov, Pose};

/// Writes `truth-NNNNNN-left.png` and `-right.png` every `dump_every` display frames, `truth-left.png` and `-right.png` of the
/// last one, and a `stats.json` without figures. `config` is what the mock runtime would be given.
///
/// # Errors
/// No device, or a file.
pub fn run(options: &RunOptions, config: &MockConfig) -> anyhow::Result<Report> {
    let server = Server::new(options)?;
    let mut comparer = comparer(&server, options)?;
    let path = config.head_path.as_ref().context("a run has a head path")?;
    let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    let head = HeadPath::parse(&text, &path.display().to_string())?;
    let frames = (options.seconds * options.refresh_hz).round() as u64;
    let every = u64::from(options.dump_every);
    let bar = progress(options.verbose, frames);
    for frame in 0..frames {
        let is_last = frame + 1 == frames;
        if is_last || (every > 0 && frame.is_multiple_of(every)) {
            let eyes = pictures(options, config, &server, &mut comparer, &head, frame)?;
            for (picture, side) in eyes.iter().zip(["left", "right"]) {
                if every > 0 && frame.is_multiple_of(every) {
                    picture.write_png(&options.out.join(format!("truth-{frame:06}-{side}.png")))?;
                }
                if is_last {
                    picture.write_png(&options.out.join(format!("truth-{side}.png")))?;
                }
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    report(options, &server)
}

/// What both eyes see in a display frame: it is seen when the next one begins.
fn pictures(
    options: &RunOptions,
    config: &MockConfig,
    server: &Server,
    comparer: &mut Comparer,
    head: &HeadPath,
    frame: u64,
) -> anyhow::Result<[Rgb8Image; 2]> {
    let display_ns = period_begin_ns(START_NS, options.refresh_hz, frame + 1);
    let stage_from_head = head.pose_at((display_ns - START_NS) as f64 * 1e-9);
    let world_from_head = server.scene.scene.world_from_stage.then(stage_from_head);
    let mut eye = |x_m: f32| {
        let head_from_eye = Pose { position: Vec3::X * x_m, orientation: Quat::IDENTITY };
        let time = server.world_time(display_ns);
        comparer.picture(
            world_from_head.then(head_from_eye),
            Fov::symmetric_degrees(options.fov_degrees),
            time,
        )
    };
    Ok([eye(-0.5 * config.ipd_m)?, eye(0.5 * config.ipd_m)?])
}

fn report(options: &RunOptions, server: &Server) -> anyhow::Result<Report> {
    let stats = Summary::default().finish(Counted {
        device: server.gpu.device_name(),
        device_is_cpu: server.gpu.is_cpu(),
        renderer: options.renderer.name().into(),
        validation_messages: server.gpu.checked_messages().map(u64::from),
        ..Counted::default()
    });
    stats.write_json(&options.out.join("stats.json"))?;
    Ok(Report {
        stats,
        frames_with_bundle: 0,
        frames_before_first_bundle: 0,
        runtime_errors: 0,
        motion: None,
        compared: Vec::new(),
        looks: Vec::new(),
    })
}
