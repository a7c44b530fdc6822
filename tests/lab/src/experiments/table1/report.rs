//! Results of all rounds: medians by cell, ratios within rounds, growth of the cost, and the table as text and CSV.

use super::bench::{Measured, Stages};
use super::cell::{Cell, Column, Mode, Set, Size};
use super::paper::paper_row;
use super::state::Done;
use crate::measure::fit::exponent;
use crate::measure::percentiles::median;
use crate::report::text_table::table;
use anyhow::{Context, ensure};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Stages of the device that move vertices.
const ANIMATION_STAGES: [&str; 3] = ["palette", "skin", "skin frames"];
/// Parts of the CPU's work that do, or tell a client of it.
const GEOMETRY_PARTS: [&str; 4] = ["animation", "delta", "delta's bytes", "motion"];
/// The number of dragons from which ours is compared with the paper's ways.
const MANY_DRAGONS: u32 = 49;

/// Server and client.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pair {
    /// Updates a second, or a ratio of those.
    pub server: f64,
    /// Display frames a second, or a ratio of those.
    pub client: f64,
}

/// A cell over all rounds: medians.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Full detail without reuse, or as it ships.
    pub set: Set,
    /// As it ships, or the paper's ways.
    pub mode: Mode,
    /// Dragons in view.
    pub dragons: u32,
    /// What of the animation runs.
    pub column: Column,
    /// Updates a second of the server by itself, without codec and link.
    pub server_fps: f64,
    /// Display frames a second of the client by itself.
    pub client_fps: f64,
    /// Both at once on one device.
    pub shared_fps: Pair,
    /// What the paper says, where it has this scene.
    pub paper_fps: Option<Pair>,
    /// An update, milliseconds of real time.
    pub update_ms: f64,
    /// Animation and geometry of it: milliseconds of the device's stages and of the CPU.
    pub animation_geometry_ms: f64,
    /// An update on the device, by stage.
    pub server_ms: Stages,
    /// An update's CPU time, by part.
    pub server_cpu_ms: Stages,
    /// The codec's picture, beside the update.
    pub encode_ms: f64,
    /// A display frame on the device, by stage.
    pub client_ms: Stages,
    /// A display frame's CPU time.
    pub client_cpu_ms: f64,
    /// Dragons that have pixels in the client's picture.
    pub dragons_seen: u32,
    /// Patches of an update.
    pub patches: u32,
    /// Its triangles, those of two sides twice.
    pub triangles: u32,
    /// Patches in view that were left out.
    pub dropped_patches: u64,
    /// Vertices that the client could not move.
    pub withheld_vertices: u32,
    /// Bytes of a delta.
    pub delta_bytes: u64,
    /// Those of them that predict vertices.
    pub prediction_bytes: u64,
    /// Rates over those without animation, medians of the rounds; 1 where there is none.
    pub over_off: Option<Pair>,
    /// Rates over those of dragons for which time stands still.
    pub over_static: Option<Pair>,
}

/// Ours beside the paper's ways, all dragons in flight: how many times less time it takes, medians of the rounds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Speedup {
    /// Dragons in view.
    pub dragons: u32,
    /// Animation and geometry.
    pub animation_geometry: f64,
    /// A whole update.
    pub update: f64,
}

/// Exponents of the dragons' number with which an update's cost grows, all in flight; `None` where there is only one number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Growth {
    /// In full detail, without reuse.
    pub full_detail: Option<f64>,
    /// With levels of detail, as it ships.
    pub shipped: Option<f64>,
    /// By the paper's ways.
    pub as_paper: Option<f64>,
}

/// The worst of all scenes, for the bars.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Worst {
    /// Least rate of updates in flight over that without animation, in the paper's columns.
    pub server_animated_over_off: Option<f64>,
    /// The same of display frames.
    pub client_animated_over_off: Option<f64>,
    /// The same over those of dragons that stand still.
    pub server_animated_over_static: Option<f64>,
    /// The same of display frames.
    pub client_animated_over_static: Option<f64>,
    /// Least [`Speedup::animation_geometry`] from 49 dragons on.
    pub animation_geometry_speedup: Option<f64>,
    /// Dragons that were not in the picture, most of all cells.
    pub dragons_not_seen: u32,
    /// Vertices that could not be moved, most of all cells.
    pub withheld_vertices: u32,
    /// Patches that were left out, most of all cells as they ship.
    pub dropped_patches_shipped: u64,
}

/// The table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The Vulkan device.
    pub device: String,
    /// Part of the paper's sizes.
    pub scale: f64,
    /// What that makes them.
    pub size: Size,
    /// Rounds of all cells.
    pub rounds: u32,
    /// A row a cell.
    pub rows: Vec<Row>,
    /// A row for each number of dragons.
    pub speedups: Vec<Speedup>,
    /// How the cost grows.
    pub growth: Growth,
    /// For the bars.
    pub worst: Worst,
}

/// Rounds of each cell.
struct Rounds<'a>(BTreeMap<Cell, BTreeMap<u32, &'a Measured>>);

impl<'a> Rounds<'a> {
    fn of(done: &'a [Done]) -> Self {
        let mut cells = BTreeMap::<Cell, BTreeMap<u32, &Measured>>::new();
        for Done { round, cell, measured } in done {
            cells.entry(*cell).or_default().insert(*round, measured);
        }
        Self(cells)
    }

    fn median(&self, cell: Cell, of: impl Fn(&Measured) -> f64) -> f64 {
        let rounds = self.0.get(&cell).into_iter().flat_map(BTreeMap::values);
        median(rounds.map(|measured| of(measured)))
    }

    /// The median of how many times as much one cell has as another in the same round; `None` where one was not measured.
    fn ratio(&self, cell: Cell, over: Cell, of: impl Fn(&Measured) -> f64) -> Option<f64> {
        let (rounds, over) = (self.0.get(&cell)?, self.0.get(&over)?);
        let pairs = rounds.iter().filter_map(|(round, measured)| Some((measured, over.get(round)?)));
        let ratios: Vec<f64> = pairs.map(|(one, other)| of(one) / of(other)).collect();
        (!ratios.is_empty()).then(|| median(ratios.into_iter()))
    }

    /// Rates of a cell over those of another.
    fn rates_over(&self, cell: Cell, over: Column) -> Option<Pair> {
        let mode = if over == Column::Off { Mode::Ours } else { cell.mode };
        let over = Cell { mode, column: over, ..cell };
        Some(Pair {
            server: self.ratio(over, cell, |measured| measured.server.update_ms)?,
            client: self.ratio(over, cell, |measured| measured.client.frame_ms)?,
        })
    }

    fn stages(&self, cell: Cell, of: impl Fn(&Measured) -> &Stages) -> Stages {
        let rounds = self.0.get(&cell).into_iter().flat_map(BTreeMap::values);
        let names: BTreeSet<&String> = rounds.flat_map(|measured| of(measured).keys()).collect();
        let one =
            |name: &String| self.median(cell, |measured| of(measured).get(name).copied().unwrap_or(0.0));
        names.into_iter().map(|name| (name.clone(), one(name))).collect()
    }

    fn row(&self, cell: Cell) -> Row {
        let Cell { dragons, set, mode, column } = cell;
        let fps = |of: fn(&Measured) -> f64| 1e3 / self.median(cell, of);
        let last = |of: fn(&Measured) -> f64| self.median(cell, of);
        let paper = paper_row(dragons).filter(|_| set == Set::Paper).map(|row| row.fps(column));
        Row {
            set,
            mode,
            dragons,
            column,
            server_fps: fps(|measured| measured.server.update_ms),
            client_fps: fps(|measured| measured.client.frame_ms),
            shared_fps: Pair {
                server: last(|measured| measured.shared.server_fps),
                client: last(|measured| measured.shared.client_fps),
            },
            paper_fps: paper.map(|[server, client]| Pair { server, client }),
            update_ms: last(|measured| measured.server.update_ms),
            animation_geometry_ms: last(animation_geometry_ms),
            server_ms: self.stages(cell, |measured| &measured.server.gpu_ms),
            server_cpu_ms: self.stages(cell, |measured| &measured.server.cpu_ms),
            encode_ms: last(|measured| measured.server.encode_ms),
            client_ms: self.stages(cell, |measured| &measured.client.gpu_ms),
            client_cpu_ms: last(|measured| measured.client.cpu_ms),
            dragons_seen: last(|measured| f64::from(measured.shown.dragons)) as u32,
            patches: last(|measured| f64::from(measured.shown.patches)) as u32,
            triangles: last(|measured| f64::from(measured.shown.triangles)) as u32,
            dropped_patches: last(|measured| measured.shown.dropped_patches as f64) as u64,
            withheld_vertices: last(|measured| f64::from(measured.shown.withheld_vertices)) as u32,
            delta_bytes: last(|measured| measured.shown.delta_bytes as f64) as u64,
            prediction_bytes: last(|measured| measured.shown.prediction_bytes as f64) as u64,
            over_off: self.rates_over(cell, Column::Off),
            over_static: self.rates_over(cell, Column::Static),
        }
    }

    fn speedup(&self, cell: Cell) -> Option<Speedup> {
        let ours = Cell { mode: Mode::Ours, ..cell };
        Some(Speedup {
            dragons: cell.dragons,
            animation_geometry: self.ratio(cell, ours, animation_geometry_ms)?,
            update: self.ratio(cell, ours, |measured| measured.server.update_ms)?,
        })
    }
}

/// What an update takes to move vertices and to tell of them, on device and CPU.
fn animation_geometry_ms(measured: &Measured) -> f64 {
    let of = |stages: &Stages, names: &[&str]| -> f64 {
        names.iter().map(|name| stages.get(*name).copied().unwrap_or(0.0)).sum()
    };
    of(&measured.server.gpu_ms, &ANIMATION_STAGES) + of(&measured.server.cpu_ms, &GEOMETRY_PARTS)
}

impl Report {
    /// Of all that was measured.
    ///
    /// # Errors
    /// Nothing was, or on several devices.
    pub fn of(done: &[Done], scale: f64, size: Size) -> anyhow::Result<Self> {
        let devices: BTreeSet<&String> = done.iter().map(|done| &done.measured.device).collect();
        ensure!(devices.len() <= 1, "the rounds were measured on several devices: {devices:?}");
        let device = devices.first().copied().context("nothing was measured")?.clone();
        let rounds = Rounds::of(done);
        let rows: Vec<Row> = rounds.0.keys().map(|cell| rounds.row(*cell)).collect();
        let as_paper =
            rounds.0.keys().filter(|cell| cell.mode == Mode::AsPaper && cell.column == Column::Animated);
        let speedups: Vec<Speedup> = as_paper.filter_map(|cell| rounds.speedup(*cell)).collect();
        let mut report = Self {
            device,
            scale,
            size,
            rounds: rounds.0.values().map(BTreeMap::len).max().unwrap_or(0) as u32,
            rows,
            speedups,
            growth: Growth::default(),
            worst: Worst::default(),
        };
        let grows = |set, mode| exponent(&report.costs(set, mode));
        report.growth = Growth {
            full_detail: grows(Set::Paper, Mode::Ours),
            shipped: grows(Set::Shipped, Mode::Ours),
            as_paper: grows(Set::Paper, Mode::AsPaper),
        };
        report.worst = report.worst();
        Ok(report)
    }

    /// What an update takes by number of dragons, all in flight: milliseconds.
    pub fn costs(&self, set: Set, mode: Mode) -> Vec<(f64, f64)> {
        let rows = self.rows_of(set, mode, Column::Animated);
        rows.map(|row| (f64::from(row.dragons), row.update_ms)).collect()
    }

    /// Rows of a column, by number of dragons.
    pub fn rows_of(&self, set: Set, mode: Mode, column: Column) -> impl Iterator<Item = &Row> {
        self.rows.iter().filter(move |row| (row.set, row.mode, row.column) == (set, mode, column))
    }

    fn worst(&self) -> Worst {
        let least = |values: &mut dyn Iterator<Item = f64>| values.min_by(f64::total_cmp);
        let kept = |over: fn(&Row) -> Option<Pair>, of: fn(Pair) -> f64| {
            let rows = self.rows_of(Set::Paper, Mode::Ours, Column::Animated);
            least(&mut rows.filter_map(|row| over(row).map(of)))
        };
        let over_off = |row: &Row| row.over_off;
        let over_static = |row: &Row| row.over_static;
        let many = self.speedups.iter().filter(|speedup| speedup.dragons >= MANY_DRAGONS);
        let shipped = self.rows.iter().filter(|row| row.set == Set::Shipped);
        Worst {
            server_animated_over_off: kept(over_off, |pair| pair.server),
            client_animated_over_off: kept(over_off, |pair| pair.client),
            server_animated_over_static: kept(over_static, |pair| pair.server),
            client_animated_over_static: kept(over_static, |pair| pair.client),
            animation_geometry_speedup: least(&mut many.map(|speedup| speedup.animation_geometry)),
            dragons_not_seen: self.rows.iter().map(|row| row.dragons - row.dragons_seen).max().unwrap_or(0),
            withheld_vertices: self.rows.iter().map(|row| row.withheld_vertices).max().unwrap_or(0),
            dropped_patches_shipped: shipped.map(|row| row.dropped_patches).max().unwrap_or(0),
        }
    }

    /// A line a row, with a column for every stage of any of them.
    pub fn csv(&self) -> String {
        let names =
            |of: StagesOf| -> BTreeSet<&String> { self.rows.iter().flat_map(|row| of(row).keys()).collect() };
        let kinds: [(&str, StagesOf); 3] = [
            ("server device", |row| &row.server_ms),
            ("server CPU", |row| &row.server_cpu_ms),
            ("client device", |row| &row.client_ms),
        ];
        let stages: Vec<_> = kinds.map(|(kind, of)| (kind, of, names(of))).into();
        let mut out = format!("set,mode,column,{}", FIGURES.map(|(name, _)| name).join(","));
        for (kind, _, names) in &stages {
            names.iter().for_each(|name| out += &format!(",{kind}: {name} ms"));
        }
        for row in &self.rows {
            out += &format!("\n{},{},{}", word(row.set), word(row.mode), word(row.column));
            FIGURES
                .iter()
                .for_each(|(_, of)| out += &of(row).map_or(",".into(), |value| format!(",{value}")));
            for (_, of, names) in &stages {
                let cell = |name: &String| of(row).get(name).map_or(",".into(), |ms| format!(",{ms}"));
                names.iter().for_each(|name| out += &cell(name));
            }
        }
        out + "\n"
    }
}

/// A figure of a row, where it has it.
type Figure = (&'static str, fn(&Row) -> Option<f64>);

/// Stages of a row.
type StagesOf = fn(&Row) -> &Stages;

/// What the CSV has beside stages.
const FIGURES: [Figure; 24] = [
    ("dragons", |row| Some(f64::from(row.dragons))),
    ("server fps", |row| Some(row.server_fps)),
    ("client fps", |row| Some(row.client_fps)),
    ("server fps shared", |row| Some(row.shared_fps.server)),
    ("client fps shared", |row| Some(row.shared_fps.client)),
    ("paper server fps", |row| row.paper_fps.map(|fps| fps.server)),
    ("paper client fps", |row| row.paper_fps.map(|fps| fps.client)),
    ("server over off", |row| row.over_off.map(|over| over.server)),
    ("client over off", |row| row.over_off.map(|over| over.client)),
    ("server over static", |row| row.over_static.map(|over| over.server)),
    ("client over static", |row| row.over_static.map(|over| over.client)),
    ("update ms", |row| Some(row.update_ms)),
    ("animation and geometry ms", |row| Some(row.animation_geometry_ms)),
    ("encode ms", |row| Some(row.encode_ms)),
    ("client frame ms", |row| Some(1e3 / row.client_fps)),
    ("client CPU ms", |row| Some(row.client_cpu_ms)),
    ("dragons seen", |row| Some(f64::from(row.dragons_seen))),
    ("patches", |row| Some(f64::from(row.patches))),
    ("triangles", |row| Some(f64::from(row.triangles))),
    ("dropped patches", |row| Some(row.dropped_patches as f64)),
    ("withheld vertices", |row| Some(f64::from(row.withheld_vertices))),
    ("delta bytes", |row| Some(row.delta_bytes as f64)),
    ("prediction bytes", |row| Some(row.prediction_bytes as f64)),
    ("encode over update", |row| Some(row.encode_ms / row.update_ms)),
];

/// As it stands in files.
pub fn word(value: impl Serialize) -> String {
    let word = serde_json::to_value(value).ok();
    word.and_then(|word| word.as_str().map(str::to_owned)).unwrap_or_default()
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.size.extent_pixels;
        writeln!(
            f,
            "{}; {width}x{height} (scale {}), atlas {}, medians of {} rounds",
            self.device, self.scale, self.size.atlas_extent_texels, self.rounds
        )?;
        let row = |row: &Row| {
            let rates =
                |pair: Pair, decimals| format!("{:.decimals$} {:.decimals$}", pair.server, pair.client);
            let or_none =
                |pair: Option<Pair>, decimals| pair.map_or("-".into(), |pair| rates(pair, decimals));
            [
                format!("{} {}", word(row.set), word(row.mode)),
                row.dragons.to_string(),
                word(row.column),
                rates(Pair { server: row.server_fps, client: row.client_fps }, 2),
                rates(row.shared_fps, 2),
                or_none(row.paper_fps, 0),
                or_none(row.over_off, 2),
                or_none(row.over_static, 2),
                format!("{:.1}", row.update_ms),
                format!("{:.2}", row.animation_geometry_ms),
                format!("{:.1}", row.encode_ms),
                format!("{} {}", row.dragons_seen, row.patches),
            ]
        };
        let heads = [
            "",
            "dragons",
            "animation",
            "server client a second",
            "sharing",
            "paper",
            "over off",
            "over static",
            "update ms",
            "animation, geometry ms",
            "encode ms",
            "seen, patches",
        ];
        write!(f, "{}", table(heads, self.rows.iter().map(row)))?;
        for Speedup { dragons, animation_geometry, update } in &self.speedups {
            writeln!(
                f,
                "{dragons} dragons by the paper's ways: animation and geometry {animation_geometry:.1}x, updates {update:.2}x"
            )?;
        }
        let power = |power: Option<f64>| power.map_or("-".into(), |power| format!("{power:.2}"));
        writeln!(
            f,
            "cost grows with the dragons to the power of {} in full detail, {} as it ships, {} by the paper's ways",
            power(self.growth.full_detail),
            power(self.growth.shipped),
            power(self.growth.as_paper)
        )
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::experiments::table1::bench::{ClientCost, ServerCost, SharedRates, Shown};

    fn stages<const N: usize>(stages: [(&str, f64); N]) -> Stages {
        stages.map(|(name, ms)| (name.to_owned(), ms)).into()
    }

    /// What a cell takes whose update and frame take so long.
    fn measured(dragons: u32, update_ms: f64, skin_ms: f64) -> Measured {
        Measured {
            device: "a device".into(),
            server: ServerCost {
                update_ms,
                gpu_ms: stages([("skin", skin_ms), ("id buffer", update_ms - skin_ms)]),
                cpu_ms: stages([("delta", 1.0), ("all else", 2.0)]),
                encode_ms: 5.0,
            },
            client: ClientCost { frame_ms: 4.0, gpu_ms: stages([("draw", 3.0)]), cpu_ms: 1.0 },
            shared: SharedRates { server_fps: 1.0, client_fps: 2.0 },
            shown: Shown { dragons, ..Shown::default() },
        }
    }

    /// Two scenes in three rounds, one of which the machine was twice as slow in.
    pub(crate) fn report() -> Report {
        let mut done = Vec::new();
        for (round, slow) in (0..3).zip([1.0, 2.0, 1.0]) {
            for cell in [9, 49].into_iter().flat_map(|dragons| Cell::of_scene(dragons, true)) {
                let dragons = f64::from(cell.dragons);
                let ms = match (cell.set, cell.mode, cell.column) {
                    (Set::Shipped, ..) => 10.0 * dragons.sqrt(),
                    (_, Mode::AsPaper, _) => 30.0 * dragons,
                    (.., Column::Animated) => 10.0 * dragons,
                    _ => 9.0 * dragons,
                };
                let skin_ms = if cell.mode == Mode::AsPaper { 20.0 * dragons } else { dragons };
                done.push(Done { round, cell, measured: measured(cell.dragons, slow * ms, slow * skin_ms) });
            }
        }
        Report::of(&done, 0.5, Size::at(0.5).expect("a size")).expect("a report")
    }

    #[test]
    fn ratios_are_within_a_round_and_rates_of_the_median() {
        let report = report();
        assert_eq!((report.rounds, report.rows.len(), report.speedups.len()), (3, 16, 2));
        let row = report.rows_of(Set::Paper, Mode::Ours, Column::Animated).next().expect("a row");
        assert_eq!((row.dragons, row.update_ms, row.client_fps), (9, 90.0, 250.0));
        assert!((row.server_fps - 1e3 / 90.0).abs() < 1e-9);
        assert!(row.over_off.is_some_and(|over| (over.server - 0.9).abs() < 1e-9 && over.client == 1.0));
        assert_eq!(row.paper_fps.map(|fps| [fps.server, fps.client]), Some([38.0, 370.0]));
        assert_eq!(row.animation_geometry_ms, 10.0, "the skin stage and the delta");
        let off = report.rows_of(Set::Paper, Mode::Ours, Column::Off).next().expect("a row");
        assert_eq!(off.over_static.map(|over| over.server), Some(1.0));
        let paper = report.rows_of(Set::Paper, Mode::AsPaper, Column::Animated).next().expect("a row");
        assert!(
            paper.over_off.is_some_and(|over| (over.server - 0.3).abs() < 1e-9),
            "beside ours without it"
        );
    }

    #[test]
    fn growth_and_the_worst_of_all_scenes_are_told() {
        let Report { growth, worst, speedups, .. } = report();
        assert!(growth.full_detail.is_some_and(|power| (power - 1.0).abs() < 1e-9), "{growth:?}");
        assert!(growth.shipped.is_some_and(|power| (power - 0.5).abs() < 1e-9), "{growth:?}");
        assert_eq!(worst.animation_geometry_speedup, Some(speedups[1].animation_geometry), "of 49, not of 9");
        assert!(worst.server_animated_over_off.is_some_and(|least| (least - 0.9).abs() < 1e-9));
        assert_eq!((worst.dragons_not_seen, worst.withheld_vertices), (0, 0));
    }

    #[test]
    fn the_csv_has_a_line_a_row_and_as_many_cells_in_each() {
        let report = report();
        let csv = report.csv();
        let cells: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
        assert_eq!(cells.len(), 1 + report.rows.len());
        assert!(cells.iter().all(|count| *count == cells[0]), "{csv}");
        assert!(
            csv.starts_with("set,mode,column,dragons,") && csv.contains("server device: skin ms"),
            "{csv}"
        );
        assert!(csv.contains("\npaper,as-paper,animated,9,"), "{csv}");
    }

    #[test]
    fn nothing_and_two_devices_make_no_report() {
        let size = Size::at(0.5).expect("a size");
        assert!(Report::of(&[], 0.5, size).is_err());
        let of = |device: &str, round| Done {
            round,
            cell: Cell::of_scene(9, false)[0],
            measured: Measured { device: device.into(), ..measured(9, 1.0, 0.5) },
        };
        let error = Report::of(&[of("a", 0), of("b", 1)], 0.5, size).expect_err("two devices").to_string();
        assert!(error.contains("several devices"), "{error}");
    }
}
