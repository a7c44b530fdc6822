//! The picture at a headset's size: both kinds of picture, over links with short and long delay, with a moving and turning
//! head.

use super::run::run;
use crate::session::options::{COMPARE_EVERY, Head, Renderer, RunOptions};
use serde_json::{Map, Value, json};
use shadecast_scene::load::SceneSource;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_transport::LinkProfile;
use std::path::Path;

/// Pixels a side of an eye's picture, over 90 degrees: the paper's.
const SIDE_PIXELS: u32 = 1300;
/// Of each run, seconds of virtual time: two until texels, bits and clock have settled, and half a round of the path.
const SECONDS: f64 = 3.0;
const CAUSES_SECONDS: f64 = 2.5;
/// Places along a side of each pixel of the truth.
const TRUTH_PLACES: u32 = 4;
/// The first display frame that is compared, at 72 a second.
const COMPARE_FROM: u64 = 144;

/// A run: its key in the result, how, and in which atlas.
struct Way {
    key: &'static str,
    renderer: Renderer,
    link: &'static str,
    atlas: &'static str,
}

const LARGE: &str = "4096x2048";
const NEAR: &str = "latency=20ms,jitter=10ms,rate=100mbit";
const FAR: &str = "latency=110ms,jitter=10ms,rate=100mbit";
const WAYS: [Way; 4] = [
    Way { key: "local", renderer: Renderer::Local, link: "none", atlas: LARGE },
    Way { key: "local_2048", renderer: Renderer::Local, link: "none", atlas: "2048x2048" },
    Way { key: "stream_20_ms", renderer: Renderer::Stream, link: NEAR, atlas: LARGE },
    Way { key: "stream_110_ms", renderer: Renderer::Stream, link: FAR, atlas: LARGE },
];

/// Runs the scene, which a person calls `shown`, all ways; `folder` is for what the runs leave.
///
/// # Errors
/// A run fails.
pub fn measure(scene: &SceneSource, shown: &str, folder: &Path) -> anyhow::Result<Value> {
    let mut all = Map::new();
    for way in WAYS {
        let options = options(scene, &way, folder);
        let stats = run(&options)?.stats;
        println!("{shown}, {}: {stats}", way.key);
        let command = format!("{} --link {}", options.command_line(shown), way.link);
        let all_mbit_s = stats.mbit_per_s.atlas + stats.mbit_per_s.geometry;
        let row = json!({ "command": command, "all_mbit_s": all_mbit_s, "stats": stats });
        all.insert(way.key.to_owned(), row);
    }
    Ok(all.into())
}

/// The run over the short link, for the causes of its error: there are a dozen of it, so each is shorter.
pub fn streamed(scene: &SceneSource, folder: &Path) -> RunOptions {
    RunOptions { seconds: CAUSES_SECONDS, ..options(scene, &WAYS[2], folder) }
}

fn options(scene: &SceneSource, way: &Way, folder: &Path) -> RunOptions {
    RunOptions {
        renderer: way.renderer,
        link: LinkProfile::into(way.link.parse().expect("a link")),
        head: Head::Named("stride".to_owned()),
        extent_pixels: [SIDE_PIXELS; 2],
        atlas_extent_texels: way.atlas.parse().expect("an extent"),
        seconds: SECONDS,
        compare_every: COMPARE_EVERY,
        compare_from: COMPARE_FROM,
        surround: DEFAULT_SURROUND,
        truth_places: TRUTH_PLACES,
        validation: true,
        ..RunOptions::new(scene.clone(), folder.join("run"))
    }
}
