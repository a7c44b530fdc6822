//! `shadecast-lab quality`.

use super::run::{RunArgs, run_options};
use super::write_json;
use anyhow::ensure;
use clap::Args;
use shadecast_lab::experiments::quality::{self, Compared, LATENCIES_MS, Video};

#[derive(Args)]
pub(super) struct QualityCommandArgs {
    /// Latencies of the links, milliseconds one way, each with a jitter of a half of it and at most 10 ms
    #[arg(long, value_name = "MS", value_delimiter = ',', default_values_t = LATENCIES_MS)]
    latencies: Vec<f64>,
    /// Packets that each of the links loses, percent
    #[arg(long, value_name = "PERCENT", default_value_t = 0.0)]
    lost: f64,
    /// Runs all twelve videos, instead of a search for the best
    #[arg(long)]
    all_videos: bool,
    /// Leaves out the atlas without prediction, and as in the paper
    #[arg(long)]
    only_videos: bool,
    /// Of all videos those with so many pictures a second: 30,72
    #[arg(long, value_name = "HZ", value_delimiter = ',')]
    video_rates: Vec<f64>,
    /// Of all videos those with these margins, degrees: 0,5,10,15 at 30 Hz, 0,5 at 72 Hz
    #[arg(long, value_name = "DEGREES", value_delimiter = ',')]
    video_margins: Vec<f32>,
    /// Of all videos those with depth, or those without
    #[arg(long, value_name = "WHETHER")]
    video_depths: Option<bool>,
    #[command(flatten)]
    run: RunArgs,
}

pub(super) fn run(args: QualityCommandArgs) -> anyhow::Result<()> {
    let of_one_run = args.run.one_way_or_link();
    ensure!(
        of_one_run.is_none(),
        "{} is for one run; quality has --latencies, --video-rates, --video-margins and --video-depths",
        of_one_run.unwrap_or_default()
    );
    let (scene, out) = (args.run.scene.clone(), args.run.out.clone());
    let has_settings =
        !args.video_rates.is_empty() || !args.video_margins.is_empty() || args.video_depths.is_some();
    let is_asked_for = |video: &Video| {
        (args.video_rates.is_empty() || args.video_rates.contains(&video.rate_hz))
            && (args.video_margins.is_empty() || args.video_margins.contains(&video.margin_degrees))
            && args.video_depths.is_none_or(|has_depth| has_depth == video.has_depth)
    };
    let videos = match args.all_videos || has_settings {
        true => quality::videos().into_iter().filter(is_asked_for).collect(),
        false => Vec::new(),
    };
    ensure!(
        !(has_settings && videos.is_empty()),
        "no video has these rates and margins; there are 0, 5, 10 and 15 degrees at 30 Hz, and 0 and 5 at 72 Hz"
    );
    let others = if args.only_videos { Vec::new() } else { Compared::default().others };
    let compared = Compared { others, videos };
    let links: Vec<String> =
        args.latencies.iter().map(|latency_ms| quality::link(*latency_ms, args.lost)).collect();
    let options = run_options(args.run)?;
    let found = quality::measure(&options, &scene, &links, &compared)?;
    print!("{found}");
    write_json(&out.join("quality.json"), &found)
}
