//! `shadecast-lab table1`: the paper's Table 1 and Figure 4. Up to 169 dragons are in view of a still head. The table has the
//! rates of server and client without animation, with dragons for which time stands still, and with all of them in flight.
//!
//! Numbers of dragons enter, rounds and a scale. A table leaves, with plots beside the paper's figures. Nothing here knows
//! links and metrics of pictures.
//!
//! A table consists of cells ([`cell`]), each measured by itself ([`bench`]), in rounds: all cells of a scene in turn, then all
//! of them again, so a machine of varying speed disturbs all alike. Ratios are within a round; figures are medians of the
//! rounds ([`report`]). Each measurement is stored at once (`state.rs`).
//!
//! The first set is the paper's: full detail, and no reuse between updates, so its columns differ by animation alone; the sun's
//! shadow map is drawn anew for each update in all of them. The paper's ways ([`cell::Mode::AsPaper`]) are measured on the same
//! scenes from the same head in the same rounds. The second set is the shipped program, with levels of detail and with all
//! reuse between updates.

mod bench;
pub mod cell;
pub mod paper;
pub mod plot;
pub mod report;
mod state;

use crate::experiments::run::mock_config;
use anyhow::{Context, ensure};
use cell::{Cell, Set, Size, boxes, eye_for, head_csv, source, whole_in_view};
use report::{Report, word};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_scene::Scene;
use shadecast_scene::cache::Cache;
use shadecast_scene::load::load_scene_with;
use shadecast_scene::process::Loading;
use state::{Done, State, Terms};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The paper's scenes.
pub const DRAGONS: [u32; 6] = [9, 25, 49, 81, 121, 169];
/// Rounds, where none are asked for.
pub const ROUNDS: u32 = 3;
/// The scale at which two cores without a GPU make the whole table in about half an hour, and at which all patches in view of the
/// largest scene in full detail have room on a client (at 0.25 a fifth of them has none).
pub const SOFTWARE_SCALE: f64 = 0.125;

/// The paper's own sizes, or where the device is a CPU what that finishes.
///
/// # Errors
/// There is no such device.
pub fn usual_scale(device: Option<&str>) -> anyhow::Result<f64> {
    let device_name = device.map(str::to_owned);
    let gpu =
        Gpu::open(&GpuOptions { needs: Needs::Server, validation: false, device_name }, &DesktopDevice)?;
    Ok(if gpu.is_cpu() { SOFTWARE_SCALE } else { 1.0 })
}

/// What is measured.
#[derive(Clone, Debug)]
pub struct Table1Options {
    /// Numbers of dragons.
    pub dragons: Vec<u32>,
    /// Rounds of all cells.
    pub rounds: u32,
    /// Updates that each cell measures in a round, by itself and again beside the client.
    pub updates: u32,
    /// Part of the paper's 1300x1300 pixels a side; the number of dragons stays.
    pub scale: f64,
    /// Whether the paper's ways are measured too.
    pub as_paper: bool,
    /// Folder for results, and for what is measured already.
    pub out: PathBuf,
    /// Vulkan validation layers on both sides.
    pub validation: bool,
    /// Part of the server's device's name.
    pub device: Option<String>,
}

impl Table1Options {
    /// All of the paper's scenes.
    pub fn new(out: PathBuf, scale: f64) -> Self {
        Self {
            dragons: DRAGONS.into(),
            rounds: ROUNDS,
            updates: 1,
            scale,
            as_paper: true,
            out,
            validation: false,
            device: None,
        }
    }

    /// All cells in the order in which they are measured, with their rounds.
    fn work(&self) -> Vec<(u32, Cell)> {
        let rounds = |dragons: &u32| {
            let cells = Cell::of_scene(*dragons, self.as_paper);
            (0..self.rounds).flat_map(move |round| cells.clone().into_iter().map(move |cell| (round, cell)))
        };
        self.dragons.iter().flat_map(rounds).collect()
    }

    fn terms(&self) -> Terms {
        Terms {
            scale: self.scale,
            updates: self.updates,
            device: self.device.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

/// Measures what is not measured yet, and writes `table1.json`, `table1.csv`, `table1.svg` (rates, the paper's Figure 4) and
/// `table1-cost.svg` (how an update's cost grows) into the folder. `say` is told of the progress. To be called where
/// [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Options that cannot be, a device that fails, a file; a state of a run on other terms.
pub fn measure(options: &Table1Options, say: &dyn Fn(&str)) -> anyhow::Result<Report> {
    ensure!(options.rounds > 0 && options.updates > 0, "a table has at least one round of one update");
    ensure!(
        options.scale > 0.0 && options.scale <= 1.0,
        "--scale {} must lie above 0 and be at most 1",
        options.scale
    );
    std::fs::create_dir_all(&options.out).with_context(|| format!("making {}", options.out.display()))?;
    let mut state = State::open(options.out.join("table1.state.json"), options.terms())?;
    let work = options.work();
    let left: Vec<(u32, Cell)> =
        work.iter().copied().filter(|(round, cell)| !state.has(*round, *cell)).collect();
    if left.len() < work.len() {
        say(&format!("{} of {} cells are measured already", work.len() - left.len(), work.len()));
    }
    let mut stage = Stage::new(options)?;
    let weights: Vec<f64> = left.iter().map(|(_, cell)| cell.weight()).collect();
    let began = Instant::now();
    for (index, (round, cell)) in left.iter().copied().enumerate() {
        let measured = stage.measure(cell)?;
        let (server, client) = (measured.server.update_ms, measured.client.frame_ms);
        let seen = measured.shown.dragons;
        state.add(Done { round, cell, measured })?;
        let left_s = seconds_left(&weights, index + 1, began.elapsed().as_secs_f64());
        say(&format!(
            "{} dragons, round {} of {}, {} {} {}: update {server:.1} ms, frame {client:.2} ms, {seen} seen; about {:.0} min left",
            cell.dragons,
            round + 1,
            options.rounds,
            word(cell.set),
            word(cell.mode),
            word(cell.column),
            left_s / 60.0
        ));
    }
    let is_asked = |done: &&Done| work.contains(&(done.round, done.cell));
    let done: Vec<Done> = state.done().iter().filter(is_asked).cloned().collect();
    let report = Report::of(&done, options.scale, stage.size)?;
    write(&report, &options.out)?;
    state.remove();
    Ok(report)
}

fn write(report: &Report, out: &Path) -> anyhow::Result<()> {
    let json = serde_json::to_value(report)?;
    state::write(&out.join("table1.json"), &(serde_json::to_string_pretty(&json)? + "\n"))?;
    state::write(&out.join("table1.csv"), &report.csv())?;
    state::write(&out.join("table1.svg"), &plot::rates(&json)?)?;
    state::write(&out.join("table1-cost.svg"), &plot::costs(&json)?)
}

/// Seconds that the rest takes, where those done so far took so long and each takes as its weight says.
fn seconds_left(weights: &[f64], done: usize, elapsed_s: f64) -> f64 {
    let of = |weights: &[f64]| weights.iter().sum::<f64>();
    let (before, after) = weights.split_at(done.min(weights.len()));
    if before.is_empty() { f64::NAN } else { (elapsed_s * of(after) / of(before)).max(0.0) }
}

/// Where cells are measured: the scene of the last one stays loaded for the next.
struct Stage<'a> {
    options: &'a Table1Options,
    size: Size,
    loaded: Option<Loaded>,
}

/// A scene and who looks at it.
struct Loaded {
    dragons: u32,
    set: Set,
    scene: Scene,
    head: PathBuf,
}

impl<'a> Stage<'a> {
    fn new(options: &'a Table1Options) -> anyhow::Result<Self> {
        Ok(Self { options, size: Size::at(options.scale)?, loaded: None })
    }

    fn measure(&mut self, cell: Cell) -> anyhow::Result<bench::Measured> {
        let what = || format!("measuring {cell:?}");
        let is_there = |loaded: &&Loaded| (loaded.dragons, loaded.set) == (cell.dragons, cell.set);
        if self.loaded.as_ref().filter(is_there).is_none() {
            self.loaded = Some(self.load(cell).with_context(what)?);
        }
        let Loaded { scene, head, .. } = self.loaded.as_ref().context("it was loaded")?;
        let Table1Options { out, validation, device, updates, .. } = self.options;
        let run = crate::session::options::RunOptions {
            validation: *validation,
            device: device.clone(),
            ..cell.run_options(self.size, head, &out.join("run"))
        };
        let config = MockConfig { capture_dir: None, ..mock_config(&run, ClockKind::Virtual, 0)? };
        bench::measure(cell, scene, &run, &config, *updates).with_context(what)
    }

    /// Loads a scene, with its levels of detail where they are shown, and has its head look at all of it.
    fn load(&self, cell: Cell) -> anyhow::Result<Loaded> {
        let Cell { dragons, set, .. } = cell;
        let cache = Cache::new(self.options.out.join("cache"));
        let loading = Loading { lods: set == Set::Shipped, ..Loading::complete(cache) };
        let scene = load_scene_with(&source(dragons), &loading)?;
        let boxes = boxes(&scene);
        let eye = eye_for(&boxes);
        let (seen, all) = (whole_in_view(&boxes, eye), boxes.len());
        ensure!(seen == all, "{seen} of {all} dragons are whole in view from {eye}");
        let head = self.options.out.join("head.csv");
        state::write(&head, &head_csv(&scene, eye))?;
        Ok(Loaded { dragons, set, scene, head })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_is_done_in_rounds_of_all_its_cells() {
        let options = Table1Options { dragons: vec![4, 9], rounds: 2, ..Table1Options::new("x".into(), 0.1) };
        let work = options.work();
        assert_eq!(work.len(), 2 * 2 * 8);
        assert!(work[..8].iter().all(|(round, cell)| *round == 0 && cell.dragons == 4));
        assert!(work[8..16].iter().all(|(round, cell)| *round == 1 && cell.dragons == 4));
        let without = Table1Options { as_paper: false, ..options }.work();
        assert_eq!(without.len(), 2 * 2 * 6);
    }

    #[test]
    fn time_left_goes_by_what_the_rest_weighs() {
        assert_eq!(seconds_left(&[1.0, 3.0], 1, 10.0), 30.0);
        assert_eq!(seconds_left(&[1.0, 3.0], 2, 40.0), 0.0);
        assert!(seconds_left(&[1.0], 0, 0.0).is_nan());
    }

    #[test]
    fn options_that_cannot_be_are_refused() {
        let usual = Table1Options::new("/nonexistent/x".into(), 1.5);
        assert!(measure(&usual, &|_| {}).expect_err("too large").to_string().contains("--scale 1.5"));
        let none = Table1Options { rounds: 0, ..usual };
        assert!(measure(&none, &|_| {}).is_err());
    }
}
