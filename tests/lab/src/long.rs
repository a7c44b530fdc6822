//! `shadecast-lab long`: the sizes that the acceptance names, one JSON file each; a file that is there is not made again.

use crate::options::RunOptions;
use crate::run::run;
use crate::skinning;
use anyhow::Context;
use shadecast_scene::animation::sampling::{DEFAULT_INTERVAL_S, Sampling};
use shadecast_scene::load::SceneSource;
use std::path::{Path, PathBuf};

/// Real models that the runs use where they are there; the project ships none.
pub fn asset(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
    path.exists().then_some(path)
}

/// Runs all that is not done yet.
///
/// # Errors
/// A run fails, or the folder cannot be written.
pub fn run_all(out: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(out).with_context(|| format!("making {}", out.display()))?;
    skinning_of_nine(out)?;
    let mut runs = vec![("dragons3-512", SceneSource::Dragons(3))];
    for (name, file) in [("cesium-man-512", "CesiumMan.glb"), ("fox-512", "Fox.glb")] {
        match asset(file) {
            Some(path) => runs.push((name, SceneSource::File(path))),
            None => println!("left out: {name}, {file} is not there"),
        }
    }
    for (name, scene) in runs {
        let result = out.join(format!("{name}.json"));
        if result.exists() {
            println!("done already: {}", result.display());
            continue;
        }
        println!("running {name}");
        let work = std::env::temp_dir().join(format!("shadecast-long-{}-{name}", std::process::id()));
        let options = RunOptions {
            verbose: true,
            motion: true,
            validation: true,
            compare_every: 10,
            ..RunOptions::new(scene, work.clone())
        };
        let report = run(&options).with_context(|| format!("running {name}"))?;
        println!("{}", report.stats);
        let both = serde_json::json!({ "stats": report.stats, "motion": report.motion });
        std::fs::write(&result, serde_json::to_string_pretty(&both)?)
            .with_context(|| format!("writing {}", result.display()))?;
        let _ = std::fs::remove_dir_all(&work);
    }
    Ok(())
}

/// The ways of skinning on the paper's smallest group, with the paper's keys and with ours.
fn skinning_of_nine(out: &Path) -> anyhow::Result<()> {
    let paper = Sampling::Constant { interval_s: DEFAULT_INTERVAL_S };
    for (name, sampling) in
        [("skinning-dragons9", Sampling::default()), ("skinning-dragons9-constant", paper)]
    {
        let result = out.join(format!("{name}.json"));
        if result.exists() {
            println!("done already: {}", result.display());
            continue;
        }
        println!("running {name}");
        let report = skinning::measure(&SceneSource::Dragons(9), sampling)?;
        println!("{report}");
        std::fs::write(&result, serde_json::to_string_pretty(&report)?)
            .with_context(|| format!("writing {}", result.display()))?;
    }
    Ok(())
}
