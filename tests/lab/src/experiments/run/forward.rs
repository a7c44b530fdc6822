//! `shadecast-lab run --renderer forward`: the truth's pictures at the poses and display times of another renderer. Nothing is
//! compared: there is no second picture.

use super::{Report, comparer, progress};
use crate::image::Rgb8Image;
use crate::measure::compare::Comparer;
use crate::report::stats::{Counted, Summary};
use crate::session::options::RunOptions;
use crate::session::walk::Walk;
use crate::session::{START_NS, Server};
use shadecast_mock_runtime::clock::period_begin_ns;
use shadecast_mock_runtime::config::MockConfig;
use shadecast_protocol::pose::Eye;

/// Writes `truth-NNNNNN-left.png` and `-right.png` every `dump_every` display frames, `truth-left.png` and `-right.png` of the
/// last one, and a `stats.json` without figures. `config` is what the mock runtime would be given.
///
/// # Errors
/// No device, or a file.
pub fn run(options: &RunOptions, config: &MockConfig) -> anyhow::Result<Report> {
    let server = Server::new(options)?;
    let mut comparer = comparer(&server, options)?;
    let walk = Walk::new(config, server.scene.scene.world_from_stage, options.fov_degrees)?;
    let frames = (options.seconds * options.refresh_hz).round() as u64;
    let every = u64::from(options.dump_every);
    let bar = progress(options.verbose, frames);
    for frame in 0..frames {
        let is_last = frame + 1 == frames;
        if is_last || (every > 0 && frame.is_multiple_of(every)) {
            let eyes = pictures(options, &server, &mut comparer, &walk, frame)?;
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
    server: &Server,
    comparer: &mut Comparer,
    walk: &Walk,
    frame: u64,
) -> anyhow::Result<[Rgb8Image; 2]> {
    let display_ns = period_begin_ns(START_NS, options.refresh_hz, frame + 1);
    let world_from_head = walk.world_from_head(display_ns);
    let [left, right] = walk.eyes();
    let mut picture = |eye: Eye| {
        comparer.picture(world_from_head.then(eye.head_from_eye), eye.fov, server.world_time(display_ns))
    };
    Ok([picture(left)?, picture(right)?])
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
