//! The command line of the lab, a file a subcommand.
//!
//! Arguments enter. Options leave for the library, and its reports for the terminal and for files. Nothing here knows how
//! anything is measured.

mod abrupt;
mod bars;
mod causes;
mod compare;
mod demo;
mod detail;
mod device;
#[cfg(feature = "libavcodec")]
mod encoders;
mod hostile;
mod links;
mod live;
mod merge_traces;
mod motion;
mod neighbours;
mod quality;
mod render_thread;
mod report;
mod run;
mod scale;
mod skinning;
mod slow;
mod steady;
mod still;
mod table1;

use anyhow::Context;
use clap::{Parser, Subcommand};
use serde::Serialize;
use shadecast_lab::hostile::traffic::record;
use shadecast_lab::results::sources::freshness;
use shadecast_lab::results::{figures, long};
use shadecast_lab::scenes::robot::robot;
use shadecast_lab::scenes::room::{MANY_VASES, write_room};
use shadecast_lab::scenes::walls::{TEXELS, write_walls};
use std::path::{Path, PathBuf};

/// The whole system on one virtual clock: measurements that a slow machine makes as a fast one would.
#[derive(Parser)]
#[command(
    name = "shadecast-lab",
    version,
    after_help = "Examples:
  shadecast-lab run dragons:3 --renderer stream --link latency=20ms,jitter=5ms,rate=100mbit --out out/run
  shadecast-lab run fox.glb --renderer local --size 256x256 --seconds 3 --dump-every 24 --out out/fox
  shadecast-lab motion fox.glb --clip Run --link latency=200ms,jitter=10ms --link updates=2 --json motion.json
  shadecast-lab demo --out out/demo
  shadecast-lab device

SCENE is courtyard, dragons:N, dragons:NxMxK (a grid), a .glb, .gltf or .fbx file, or a scene description (.toml).
A head path is a CSV file, t_s,x,y,z,qx,qy,qz,qw: metres in the stage's frame (y up, -z forward)."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Runs server, link and client in one process on a virtual clock, and measures
    Run(run::RunArgs),
    /// Measures the atlas beside a video of both eyes: the same bit rate, the same links, the best of several settings of video
    Quality(quality::QualityCommandArgs),
    /// Measures how exactly vertices move: every way over several links, in one table
    Motion(motion::MotionArgs),
    /// Measures what each cause of error costs: a run as it ships, and the same run without each cause in turn
    Causes(causes::CausesArgs),
    /// Measures the ways of skinning side by side, against the floor that the device's own rates set
    Skinning(skinning::SkinningArgs),
    /// Measures how device time and bytes grow with triangles, instances, joints, animated vertices, atlas, views and viewers
    Scale(scale::ScaleArgs),
    /// Measures the second update of a scene in which nothing moves beside the first, by stage of the device
    Still(run::RunArgs),
    /// Measures slow devices: when the first picture comes, when a whole one, and what is missing afterwards
    Slow(slow::SlowArgs),
    /// Measures links that are bad in one way each: queues, ages of pictures, pauses
    Links(links::LinksArgs),
    /// Runs server and client as two processes in real time; measures the first picture, updates, frames and holes of each second
    Live(live::LiveArgs),
    /// Measures the paper's Table 1 and Figure 4: rates of server and client for 9 to 169 dragons, and how the cost grows
    Table1(table1::Table1Args),
    /// Measures openh264 beside libx264 on atlases of nine dragons
    #[cfg(feature = "libavcodec")]
    Encoders {
        /// Folder for encoders.json
        #[arg(long, default_value = "out/encoders")]
        out: PathBuf,
    },
    /// Measures what a display frame costs the thread that draws while updates of the paper's dragons arrive
    RenderThread(render_thread::RenderThreadArgs),
    /// Runs server and client as two processes in real time, then the same scene in virtual time; pictures, figures, a page
    Demo(demo::DemoArgs),
    /// Runs what takes long, one after the other, and checks the bars; what is done already is left out
    Long {
        /// Folder for the JSON results
        #[arg(long, default_value = "docs/results")]
        out: PathBuf,
        /// Runs only those whose name begins so, and checks no bars
        #[arg(long)]
        only: Option<String>,
    },
    /// Checks the results that are there against their bars, without running anything; fails where one is missed
    Bars {
        /// Folder of the JSON results
        #[arg(long, default_value = "docs/results")]
        out: PathBuf,
        /// Another list of bars
        #[arg(long)]
        bars: Option<PathBuf>,
    },
    /// Writes the tables of README and docs anew from the committed results, and the curve of keys
    Figures {
        /// The project's folder
        #[arg(long, default_value = ".")]
        root: PathBuf,
    },
    /// Writes one page of HTML from the committed results: curves, tables, pictures, bars, and where each figure comes from
    Report(report::ReportArgs),
    /// Says what changed between two results or folders of results; fails where a figure became worse beyond noise
    Compare(compare::CompareArgs),
    /// Writes the stiff character of the long runs: boxes on joints, wide steps between 24 keys a second
    Robot {
        /// The .glb file
        #[arg(long, default_value = "robot.glb")]
        out: PathBuf,
    },
    /// Writes the room of the long runs, in which the head starts abruptly: room.glb, and room.toml to stand in it
    Room {
        /// The folder
        #[arg(long, default_value = ".")]
        out: PathBuf,
    },
    /// Writes the room of the long runs whose walls are painted down to the texel: walls.toml, walls.glb and its pictures
    Walls {
        /// The folder
        #[arg(long, default_value = ".")]
        out: PathBuf,
    },
    /// Attacks a server of its own on loopback, and says what becomes of a lawful client meanwhile and afterwards
    Hostile(hostile::HostileArgs),
    /// Has a lawful client served beside others that behave badly, and says how many pictures it gets
    Neighbours {
        /// Seconds that each is beside it, in each of five rounds
        #[arg(long, default_value_t = 10.0)]
        seconds: f64,
        /// Writes the figures to this JSON file
        #[arg(long)]
        json: Option<PathBuf>,
    },
    /// Records what a server and a client say to each other, as seeds for the fuzz targets
    RecordTraffic {
        /// Folder of the seeds
        #[arg(long, default_value = "tests/fuzz/seeds")]
        out: PathBuf,
    },
    /// Puts traces of --trace into one, each in the server's time, and says how busy each row was: of a server and its clients
    MergeTraces {
        /// The traces
        #[arg(required = true)]
        traces: Vec<PathBuf>,
        /// The file of all
        #[arg(long, default_value = "trace.json")]
        out: PathBuf,
    },
    /// Runs as run does, and says what changes of levels of detail do to the picture, and how much the client draws
    Detail(run::RunArgs),
    /// Runs as run does with a head that stands still and then moves at full speed at once, and says how much is missing
    Abrupt(run::RunArgs),
    /// Runs as run does, and says how much of the atlas changes from update to update, and when it comes to rest
    Steady(run::RunArgs),
    /// Names the Vulkan device that would be used
    Device,
}

/// Does what the arguments say.
pub(crate) fn run() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Run(args) => run::run(args),
        Command::Quality(args) => quality::run(args),
        Command::Motion(args) => motion::run(args),
        Command::Causes(args) => causes::run(args),
        Command::Table1(args) => table1::run(args),
        Command::RenderThread(args) => render_thread::run(&args),
        #[cfg(feature = "libavcodec")]
        Command::Encoders { out } => encoders::run(&out),
        Command::Demo(args) => demo::run(args),
        Command::Long { out, only: Some(only) } => long::run_all(&out, &only),
        Command::Long { out, only: None } => long::run_all(&out, "").and_then(|()| bars::run(&out, None)),
        Command::Bars { out, bars } => bars::run(&out, bars.as_deref()),
        Command::Figures { root } => {
            figures::write(&root)?;
            println!("{}", freshness(&root.join(figures::RESULTS)));
            Ok(())
        }
        Command::Report(args) => report::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Robot { out } => {
            std::fs::write(&out, robot()).with_context(|| format!("writing {}", out.display()))
        }
        Command::Room { out } => write_room(&out, MANY_VASES)
            .map(|_| ())
            .with_context(|| format!("writing into {}", out.display())),
        Command::Walls { out } => {
            write_walls(&out, TEXELS).map(|_| ()).with_context(|| format!("writing into {}", out.display()))
        }
        Command::Scale(args) => scale::run(&args),
        Command::Skinning(args) => skinning::run(&args),
        Command::Still(args) => still::run(args),
        Command::Slow(args) => slow::run(args),
        Command::Links(args) => links::run(args),
        Command::Live(args) => live::run(args),
        Command::Hostile(args) => hostile::run(args),
        Command::Neighbours { seconds, json } => neighbours::run(seconds, json.as_deref()),
        Command::RecordTraffic { out } => record(&out),
        Command::MergeTraces { traces, out } => merge_traces::run(&traces, &out),
        Command::Detail(args) => detail::run(args),
        Command::Abrupt(args) => abrupt::run(args),
        Command::Steady(args) => steady::run(args),
        Command::Device => device::run(),
    }
}

fn write_json(path: &Path, found: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(found)? + "\n";
    shadecast_system::write_atomically(path, text.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// What clap asserts of a command line: no two flags or groups of one name, and defaults that parse.
    #[test]
    fn every_command_is_well_formed() {
        Cli::command().debug_assert();
    }
}
