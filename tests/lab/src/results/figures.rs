//! `shadecast-lab figures`: the tables of README and docs, from the committed results. A table stands between two comments,
//! `<!-- figures NAME -->` and `<!-- /figures -->`; a test compares each with the results.

use super::bars::{BARS, Bars};
use super::long;
use crate::experiments::causes::Causes;
use crate::experiments::links::Links;
use crate::experiments::live::Live;
use crate::experiments::paper_size::PaperSize;
use crate::experiments::quality::{self, Method, OverLink, Quality, Row, Video};
use crate::experiments::render_thread::RenderThread;
use crate::experiments::slow::Slow;
use crate::experiments::table1::plot;
use crate::experiments::worth::Worth;
use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::fmt::{Display, Write};
use std::path::Path;

const BEGIN: &str = "<!-- figures ";
const BEGIN_END: &str = " -->\n";
const END: &str = "<!-- /figures -->";
/// The documents with tables, from the project's root.
const DOCUMENTS: [&str; 6] =
    ["README.md", "docs/figures.md", "docs/causes.md", "docs/table1.md", "docs/budget.md", "docs/quality.md"];
/// Folder of the results, from the project's root.
pub const RESULTS: &str = "docs/results";
const KEYS: &str = "docs/keys.svg";
const KEYS_RESULT: &str = "inspect-error-dragon";
const TABLE1_RESULT: &str = "table1";
/// Pictures of the paper's table, and what draws them.
const TABLE1_PLOTS: [(&str, Plot); 2] =
    [("docs/table1.svg", plot::rates), ("docs/table1-cost.svg", plot::costs)];

/// Draws a result.
type Plot = fn(&Value) -> anyhow::Result<String>;

/// What stands for a table whose result is not there.
pub(super) const NOT_MEASURED: &str = "Not measured yet.\n";

/// Results and what people call them.
const SCENES: [(&str, &str); 10] = [
    ("dragons3", "three dragons"),
    ("cesium-man", "`CesiumMan.glb`"),
    ("fox-survey", "`Fox.glb`, Survey"),
    ("fox-walk", "`Fox.glb`, Walk"),
    ("fox-run", "`Fox.glb`, Run"),
    ("robot", "stiff robot of 22 boxes"),
    ("morph", "`MorphStressTest.gltf`"),
    ("kenney-fbx", "`maya_kenney_character_7700_binary.fbx`"),
    ("helmet", "`DamagedHelmet.glb`, still"),
    ("walls", "painted walls, still"),
];

/// Those that are looked at in pictures of a headset's size.
pub(super) const PICTURES: [(&str, &str); 4] = [
    ("dragons9", "nine dragons"),
    ("cesium-man", "`CesiumMan.glb`"),
    ("helmet", "`DamagedHelmet.glb`, still"),
    ("walls", "painted walls, still"),
];

/// Those of which there are figures with what the link carries.
const AUTO_SCENES: [(&str, &str); 4] = [SCENES[0], SCENES[1], SCENES[8], SCENES[9]];

/// Writes all tables anew, and the curves; `root` is the project's.
///
/// # Errors
/// A file cannot be read or written, or names a table that does not exist.
pub fn write(root: &Path) -> anyhow::Result<()> {
    for document in DOCUMENTS {
        let path = root.join(document);
        let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
        replace(&path, &filled(&text, &root.join(RESULTS)).with_context(|| document.to_owned())?)?;
    }
    let inspected = read(&root.join(RESULTS), KEYS_RESULT).context("the error table has not been made")?;
    replace(&root.join(KEYS), &crate::results::keys::svg(&inspected)?)?;
    let Some(table) = read(&root.join(RESULTS), TABLE1_RESULT) else { return Ok(()) };
    TABLE1_PLOTS.iter().try_for_each(|(path, plot)| replace(&root.join(path), &plot(&table)?))
}

fn replace(path: &Path, text: &str) -> anyhow::Result<()> {
    shadecast_system::write_atomically(path, text.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

/// `text` with what stands between the comments made of `results`.
fn filled(text: &str, results: &Path) -> anyhow::Result<String> {
    let (mut out, mut rest) = (String::new(), text);
    while let Some((before, after)) = rest.split_once(BEGIN) {
        let (name, after) = after.split_once(BEGIN_END).context("a comment for figures is not closed")?;
        let (_, after) = after.split_once(END).with_context(|| format!("{name}: {END} is missing"))?;
        write!(out, "{before}{BEGIN}{name}{BEGIN_END}{}{END}", table(name, results)?)?;
        rest = after;
    }
    Ok(out + rest)
}

/// A table of the documents, as Markdown.
pub(super) fn table(name: &str, results: &Path) -> anyhow::Result<String> {
    Ok(match name {
        "scenes" => scenes(&SCENES, &LONG, |scene| format!("{scene}-512"), results),
        "scenes-slow" => scenes(&SCENES, &LONG, |scene| format!("{scene}-512-slow"), results),
        "auto" => scenes(&AUTO_SCENES, &AUTO, |scene| format!("auto-{scene}"), results),
        "picture" => picture(results),
        "picture-short" => scenes(&PICTURES, &PICTURE_SHORT, |scene| format!("picture-{scene}"), results),
        "costs" => costs(results),
        "abrupt" => abrupt(results),
        "slow-link" => slow_link(results),
        "viewers" => viewers(results),
        "headset-off" => headset_off(results),
        "neighbours" => neighbours(results),
        "hostile" => hostile(results),
        "skinning" => skinning(results),
        "table1" => table1(results, "paper", "ours"),
        "table1-as-paper" => table1(results, "paper", "as-paper"),
        "table1-shipped" => table1(results, "shipped", "ours"),
        "table1-stages" => table1_stages(results),
        "table1-growth" => table1_growth(results),
        "paper-size" => printed::<PaperSize>(name, results)?,
        "render-thread" => printed::<RenderThread>(name, results)?,
        name if name.starts_with("links-") => printed::<Links>(name, results)?,
        "quality-short" => quality_short(results)?,
        "quality-cases" => quality_cases(results)?,
        name if name.starts_with("quality-") => printed::<Quality>(name, results)?,
        "worth-dragons3" => printed::<Worth>(name, results)?,
        "slow-dragons3" => printed::<Slow>(name, results)?,
        "live-window-dragons3" | "live-mock-dragons3" => printed::<Live>(name, results)?,
        "budget" => crate::results::budget::table(),
        "memory" => crate::results::budget::memory_table(),
        name if name.starts_with("causes-") => printed::<Causes>(name, results)?,
        "bars" => format!("```text\n{}\n```\n", Bars::parse(BARS)?.check(results)),
        other => bail!("there is no table \"{other}\""),
    })
}

fn read(results: &Path, name: &str) -> Option<Value> {
    let text = std::fs::read_to_string(results.join(format!("{name}.json"))).ok()?;
    serde_json::from_str(&text).ok()
}

/// A result as its own table.
fn printed<T: DeserializeOwned + Display>(name: &str, results: &Path) -> anyhow::Result<String> {
    let Some(found) = read(results, name) else { return Ok(NOT_MEASURED.to_owned()) };
    let found: T = serde_json::from_value(found).with_context(|| name.to_owned())?;
    Ok(format!("```text\n{}\n```\n", found.to_string().trim_end()))
}

/// A number at a way of keys, with so many decimals; `-` where there is none.
pub(super) fn number(value: &Value, way: &str, factor: f64, decimals: usize) -> String {
    let found = way.split('.').fold(value, |value, key| &value[key]);
    found.as_f64().map_or_else(|| "-".to_owned(), |found| format!("{:.decimals$}", found * factor))
}

/// A table of Markdown.
pub(super) fn markdown(heads: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let line = |cells: String| format!("|{cells}\n");
    let mut out = line(heads.iter().map(|head| format!(" {head} |")).collect());
    out += &line(heads.iter().map(|_| " --- |").collect());
    for row in rows {
        out += &line(row.iter().map(|cell| format!(" {cell} |")).collect());
    }
    out
}

// ---- scenes ----

/// A column: its head, and what stands in it, with numbers as `{way,factor,decimals}`.
type Column = (&'static str, &'static str);

const LONG: [Column; 11] = [
    ("animated: PSNR, dB", "{stats.animated.psnr_db,1,1}"),
    ("SSIM", "{stats.animated.ssim,1,4}"),
    ("FLIP", "{stats.animated.flip,1,3}"),
    ("moving shadows: PSNR, dB", "{stats.shadowed.psnr_db,1,1}"),
    ("all: PSNR, dB", "{stats.psnr_db,1,1}"),
    ("FLIP", "{stats.flip,1,3}"),
    ("holes, %", "{stats.hole_fraction,100,3}"),
    ("motion, worst / 99th percentile, mm", "{motion.max_error_mm,1,1} / {motion.p99_error_mm,1,2}"),
    ("worst, pixels", "{motion.max_error_px,1,2}"),
    ("worst, % of range", "{motion.max_error_percent_of_range,1,2}"),
    ("atlas + geometry, Mbit/s", "{stats.mbit_per_s.atlas,1,1} + {stats.mbit_per_s.geometry,1,1}"),
];

/// The same pictures with 20 Mbit/s, and with what the link carries.
const AUTO: [Column; 4] = [
    ("all: PSNR, dB", "{capped.stats.psnr_db,1,1} / {auto.stats.psnr_db,1,1}"),
    ("FLIP", "{capped.stats.flip,1,3} / {auto.stats.flip,1,3}"),
    ("holes, %", "{capped.stats.hole_fraction,100,3} / {auto.stats.hole_fraction,100,3}"),
    ("atlas, Mbit/s", "{capped.stats.mbit_per_s.atlas,1,1} / {auto.stats.mbit_per_s.atlas,1,1}"),
];

/// What the README shows of a picture: both ways of PSNR, and FLIP.
const PICTURE_SHORT: [Column; 4] = [
    (
        "without codec and link",
        "{local.stats.psnr_db,1,1} dB, {local.stats.animated.psnr_db,1,1} dB, {local.stats.flip,1,3}",
    ),
    (
        "20 +- 10 ms",
        "{stream_20_ms.stats.psnr_db,1,1} dB, {stream_20_ms.stats.animated.psnr_db,1,1} dB, {stream_20_ms.stats.flip,1,3}",
    ),
    (
        "110 +- 10 ms",
        "{stream_110_ms.stats.psnr_db,1,1} dB, {stream_110_ms.stats.animated.psnr_db,1,1} dB, {stream_110_ms.stats.flip,1,3}",
    ),
    ("sent in all", "{stream_20_ms.all_mbit_s,1,1}, {stream_110_ms.all_mbit_s,1,1} Mbit/s"),
];

/// A row for each scene whose result is there; `file` names that.
fn scenes(
    scenes: &[(&str, &str)],
    columns: &[Column],
    file: impl Fn(&str) -> String,
    results: &Path,
) -> String {
    let heads: Vec<&str> = std::iter::once("scene").chain(columns.iter().map(|(head, _)| *head)).collect();
    let row = |(scene, label): &(&str, &str)| {
        let value = read(results, &file(scene))?;
        let cells = columns.iter().map(|(_, cell)| cell_of(cell, &value));
        Some(std::iter::once((*label).to_owned()).chain(cells).collect())
    };
    markdown(&heads, scenes.iter().filter_map(row))
}

pub(super) fn cell_of(pattern: &str, value: &Value) -> String {
    let (mut out, mut rest) = (String::new(), pattern);
    while let Some((before, after)) = rest.split_once('{') {
        let (what, after) = after.split_once('}').expect("columns are constants");
        let mut parts = what.split(',');
        let mut part = || parts.next().expect("way, factor and decimals");
        let (way, factor, decimals) = (part(), part(), part());
        let factor = factor.parse().expect("a factor");
        out += before;
        out += &number(value, way, factor, decimals.parse().expect("a count"));
        rest = after;
    }
    out + rest
}

// ---- the others ----

/// Rows of one result, each made of one of its objects.
fn rows(results: &Path, file: &str, rows: &[(&str, &str)], columns: &[Column]) -> String {
    let heads: Vec<&str> = std::iter::once("").chain(columns.iter().map(|(head, _)| *head)).collect();
    let result = read(results, file).unwrap_or_default();
    let row = |(key, label): &(&str, &str)| {
        let cells = columns.iter().map(|(_, cell)| cell_of(cell, &result[*key]));
        std::iter::once((*label).to_owned()).chain(cells).collect()
    };
    markdown(&heads, rows.iter().map(row))
}

/// Pictures of a headset's size: a row a scene and way.
fn picture(results: &Path) -> String {
    let ways = [
        ("local", "local, atlas of 4096x2048"),
        ("local_2048", "local, atlas of 2048x2048"),
        ("stream_20_ms", "20 +- 10 ms"),
        ("stream_110_ms", "110 +- 10 ms"),
    ];
    let columns = [
        ("animated: PSNR, FLIP", "{stats.animated.psnr_db,1,1} dB, {stats.animated.flip,1,3}"),
        ("all: PSNR, worst", "{stats.psnr_db,1,1} dB, {stats.psnr_db_worst,1,1} dB"),
        ("SSIM", "{stats.ssim,1,4}"),
        ("FLIP", "{stats.flip,1,4}"),
        ("holes", "{stats.hole_fraction,100,3} %"),
        ("texels a pixel", "{stats.texels_per_pixel,1,2}"),
        ("quantiser", "{stats.mean_qp,1,0}"),
        ("atlas + geometry", "{stats.mbit_per_s.atlas,1,1} + {stats.mbit_per_s.geometry,1,1} Mbit/s"),
    ];
    let heads: Vec<&str> =
        ["scene", "way"].into_iter().chain(columns.iter().map(|(head, _)| *head)).collect();
    let measured =
        |(scene, label): &(&str, &'static str)| Some((read(results, &format!("picture-{scene}"))?, *label));
    let rows = PICTURES.iter().filter_map(measured).flat_map(|(result, label)| {
        ways.map(|(key, way)| {
            let cells = columns.iter().map(|(_, cell)| cell_of(cell, &result[key]));
            [label.to_owned(), way.to_owned()].into_iter().chain(cells).collect()
        })
    });
    markdown(&heads, rows)
}

/// The atlas beside videos over each link that was measured: FLIP, PSNR of the worst view, flicker.
fn quality_short(results: &Path) -> anyhow::Result<String> {
    let mut links = Vec::new();
    for latency_ms in quality::LATENCIES_MS {
        let name = long::name_against_video(latency_ms);
        let Some(found) = read(results, &name) else { continue };
        let found: Quality = serde_json::from_value(found).with_context(|| name)?;
        links.extend(found.links.into_iter().map(|link| (format!("{latency_ms} ms"), link)));
    }
    if links.is_empty() {
        return Ok(NOT_MEASURED.to_owned());
    }
    let is_video = |row: &&Row, with_depth: bool| matches!(row.method, Method::Video(Video { has_depth, .. }) if has_depth == with_depth);
    type Choice<'a> = &'a dyn Fn(&OverLink) -> Option<Row>;
    let unpredicted = |link: &OverLink| {
        link.others.iter().find(|row| row.method == Method::AtlasWithoutPrediction).cloned()
    };
    // The least FLIP is first.
    let best =
        |with_depth| move |link: &OverLink| link.videos.iter().find(|row| is_video(row, with_depth)).cloned();
    let (with_depth, without) = (best(true), best(false));
    let ways: [(&str, Choice<'_>); 4] = [
        ("atlas", &|link| Some(link.ours.clone())),
        ("atlas without prediction", &unpredicted),
        ("best video with depth", &with_depth),
        ("best video without depth", &without),
    ];
    let heads: Vec<&str> =
        std::iter::once("").chain(links.iter().map(|(latency, _)| latency.as_str())).collect();
    let cell = |row: Option<Row>| match row {
        Some(row) => format!("{:.3}, {:.1} dB, {:.3}", row.flip, row.psnr_db[1], row.flicker.unwrap_or(0.0)),
        None => "-".to_owned(),
    };
    let rows = ways.iter().map(|(name, choose)| {
        std::iter::once((*name).to_owned()).chain(links.iter().map(|(_, link)| cell(choose(link)))).collect()
    });
    Ok(markdown(&heads, rows))
}

/// The atlas beside the best video in each case that was measured: a row a record.
fn quality_cases(results: &Path) -> anyhow::Result<String> {
    let heads = [
        "scene, head",
        "link",
        "Mbit/s",
        "FLIP of the atlas",
        "of the best video",
        "ratio",
        "worst PSNR, both",
        "flicker, both",
        "its settings",
    ];
    let mut rows = Vec::new();
    for name in long::names_against_video() {
        let Some(found) = read(results, &name) else { continue };
        let Quality { scene, head, links } = serde_json::from_value(found).with_context(|| name)?;
        for OverLink { link, ours, videos, flip_ratio, .. } in links {
            let best = videos.first().context("a video")?;
            let flicker = |row: &Row| row.flicker.unwrap_or(0.0);
            rows.push(vec![
                format!("{scene}, {head}"),
                link,
                format!("{:.1}", ours.mbit_per_s),
                format!("{:.4}", ours.flip),
                format!("{:.4}", best.flip),
                format!("{flip_ratio:.2}"),
                format!("{:.1}, {:.1} dB", ours.psnr_db[1], best.psnr_db[1]),
                format!("{:.4}, {:.4}", flicker(&ours), flicker(best)),
                best.method.to_string(),
            ]);
        }
    }
    Ok(if rows.is_empty() { NOT_MEASURED.to_owned() } else { markdown(&heads, rows) })
}

/// What parts of the picture cost.
fn costs(results: &Path) -> String {
    let result = read(results, "costs-dragons3").unwrap_or_default();
    let columns = [
        ("server's device an update", "{with.server_ms,1,0} ms, {ratio.server_ms,1,2}x"),
        ("client's device a frame", "{with.client_ms,1,1} ms, {ratio.client_ms,1,2}x"),
        ("pictures, QP 22", "{with.picture_bytes,0.001,1} kB, {ratio.picture_bytes,1,2}x"),
        ("all else", "{with.other_bytes,0.001,1} kB, {ratio.other_bytes,1,2}x"),
    ];
    let heads: Vec<&str> = std::iter::once("with").chain(columns.iter().map(|(head, _)| *head)).collect();
    let rows = result["rows"].as_array().cloned().unwrap_or_default();
    let row = |row: &Value| {
        let name = row["part"].as_str().unwrap_or("?").to_owned();
        std::iter::once(name).chain(columns.iter().map(|(_, cell)| cell_of(cell, row))).collect()
    };
    markdown(&heads, rows.iter().map(row))
}

fn abrupt(results: &Path) -> String {
    let ways = [
        ("stream_100_mbit", "link of 110 ms one way, 100 Mbit/s"),
        ("stream_1_gbit", "link of 110 ms one way, 1 Gbit/s"),
        ("local", "no link, an update takes 246 ms"),
    ];
    let columns = [
        ("whole after", "{whole_after_s,1,2} s"),
        ("missing at worst", "{worst_hole_fraction,100,1} %"),
        ("sharp after", "{sharp_after_s,1,2} s"),
        ("missing while still", "{still_hole_fraction,100,2} %"),
        ("first picture", "{first_picture_s,1,2} s"),
    ];
    rows(results, "abrupt-room", &ways, &columns)
}

fn slow_link(results: &Path) -> String {
    let links =
        [("dragon_0_4_mbit", "one dragon, 0.4 Mbit/s"), ("dragons3_1_mbit", "three dragons, 1 Mbit/s")];
    let columns = [
        ("first picture", "{first_picture_s,1,1} s"),
        ("longest pause", "{longest_pause_s,1,1} s"),
        ("updates made", "{updates,1,0}"),
        ("sent", "{sent_mbit_s,1,2} Mbit/s"),
    ];
    rows(results, "slow-link", &links, &columns)
}

fn viewers(results: &Path) -> String {
    let result = read(results, "viewers-4").unwrap_or_default();
    let links = ["5 ms", "20 ms", "50 ms", "110 ms"];
    let viewers = result["viewers"].as_array().cloned().unwrap_or_default();
    let row = |(link, viewer): (&str, &Value)| {
        vec![
            link.to_owned(),
            cell_of("{alone_psnr_db,1,2} dB, {alone_updates_s,1,1} a second", viewer),
            cell_of("{among_psnr_db,1,2} dB, {among_updates_s,1,1} a second", viewer),
            cell_of("{clock_error_ms,1,2} ms", viewer),
        ]
    };
    let heads = ["link, one way", "alone: PSNR, updates", "beside the others", "clock"];
    let table = markdown(&heads, links.into_iter().zip(&viewers).map(row));
    let second = read(results, "second-viewer-dragons9").unwrap_or_default();
    let cost = cell_of("{one_ms,1,0} ms, of two {two_ms,1,0} ms: {two_over_one,1,2}x", &second);
    format!("{table}\nAn update of one viewer of nine dragons, 512x512 per eye: {cost}.\n")
}

fn headset_off(results: &Path) -> String {
    let absences = [("hidden", "frames go on, not rendered"), ("resting", "session ended, begun again")];
    let columns = [
        ("off", "{off_s,1,0} s"),
        ("memory", "{grown_mb,1,1} MB more"),
        ("updates meanwhile", "{updates_while_off,1,0}"),
        ("picture back", "{picture_back_s,1,2} s"),
    ];
    rows(results, "headset-off", &absences, &columns)
}

fn neighbours(results: &Path) -> String {
    let result = read(results, "neighbours").unwrap_or_default();
    let list = result["neighbours"].as_array().cloned().unwrap_or_default();
    let row = |neighbour: &Value| {
        vec![
            neighbour["neighbour"].as_str().unwrap_or("?").replace('-', " "),
            cell_of("{pictures_per_s,1,1}", neighbour),
            cell_of("{share_of_lawful,1,2}x", neighbour),
            cell_of("{longest_pause_ms,1,0} ms", neighbour),
        ]
    };
    let heads = ["neighbour", "pictures a second", "of those beside a lawful one", "longest pause"];
    markdown(&heads, list.iter().map(row))
}

fn skinning(results: &Path) -> String {
    let result = read(results, "skinning-dragons9").unwrap_or_default();
    let variants = result["variants"].as_array().cloned().unwrap_or_default();
    let columns = [
        ("positions of vertices", "{position_ms,1,1} ms"),
        ("all animation stages", "{all.ms,1,1} ms"),
        ("over the floor shaped like the stage", "{all.over_floor,1,2}x"),
        ("over the rate of plain copies", "{all.over_copy_floor,1,2}x"),
    ];
    let heads: Vec<&str> = std::iter::once("variant").chain(columns.iter().map(|(head, _)| *head)).collect();
    let row = |variant: &Value| {
        let name = variant["name"].as_str().unwrap_or("?").to_owned();
        std::iter::once(name).chain(columns.iter().map(|(_, cell)| cell_of(cell, variant))).collect()
    };
    markdown(&heads, variants.iter().map(row))
}

/// Rows of the paper's table, of a set and a mode.
fn table1_rows(result: &Value, set: &str, mode: &str) -> Vec<Value> {
    let rows = result["rows"].as_array().cloned().unwrap_or_default();
    rows.into_iter().filter(|row| row["set"] == set && row["mode"] == mode).collect()
}

/// The paper's table, a row a scene and column.
fn table1(results: &Path, set: &str, mode: &str) -> String {
    let Some(result) = read(results, TABLE1_RESULT) else { return NOT_MEASURED.to_owned() };
    let columns = [
        ("updates a second", "{server_fps,1,2}"),
        ("frames a second", "{client_fps,1,1}"),
        ("both at once", "{shared_fps.server,1,2}, {shared_fps.client,1,1}"),
        ("the paper's", "{paper_fps.server,1,0}, {paper_fps.client,1,0}"),
        ("over that without animation", "{over_off.server,1,2}, {over_off.client,1,2}"),
        ("over that of dragons that stand still", "{over_static.server,1,2}, {over_static.client,1,2}"),
        ("an update", "{update_ms,1,0} ms"),
        ("its animation and geometry", "{animation_geometry_ms,1,2} ms"),
        ("its picture's encoder", "{encode_ms,1,0} ms"),
        ("patches, left out", "{patches,1,0}, {dropped_patches,1,0}"),
    ];
    let heads = ["dragons", "animation"].into_iter().chain(columns.map(|(head, _)| head));
    let row = |row: &Value| {
        let first = [cell_of("{dragons,1,0}", row), row["column"].as_str().unwrap_or("?").to_owned()];
        first.into_iter().chain(columns.iter().map(|(_, cell)| cell_of(cell, row))).collect()
    };
    let rows = table1_rows(&result, set, mode);
    let [width, height] = [0, 1].map(|side| result["size"]["extent_pixels"][side].as_u64().unwrap_or(0));
    let atlas = [0, 1].map(|side| result["size"]["atlas_extent_texels"][side].as_u64().unwrap_or(0));
    let table = markdown(&heads.collect::<Vec<_>>(), rows.iter().map(row));
    format!(
        "{}, {width}x{height} pixels an eye (scale {}), atlas of {}x{} texels, medians of {} rounds.\n\n{table}",
        result["device"].as_str().unwrap_or("?"),
        result["scale"],
        atlas[0],
        atlas[1],
        result["rounds"]
    )
}

/// Where an update's and a frame's time goes, all dragons in flight.
fn table1_stages(results: &Path) -> String {
    let Some(result) = read(results, TABLE1_RESULT) else { return NOT_MEASURED.to_owned() };
    let parts = |row: &Value, key: &str| {
        let stages = row[key].as_object().into_iter().flatten();
        let shown = stages.filter_map(|(stage, ms)| {
            ms.as_f64().filter(|ms| *ms >= 0.05).map(|ms| format!("{stage} {ms:.1}"))
        });
        shown.collect::<Vec<_>>().join(", ")
    };
    let ways = [("paper", "ours"), ("paper", "as-paper"), ("shipped", "ours")];
    let rows = ways.iter().flat_map(|(set, mode)| table1_rows(&result, set, mode));
    let cells = rows.filter(|row| row["column"] == "animated").map(|row| {
        let word = |key: &str| row[key].as_str().unwrap_or("?").to_owned();
        let first = [format!("{}, {}", word("set"), word("mode")), cell_of("{dragons,1,0}", &row)];
        let keys = ["server_ms", "server_cpu_ms", "client_ms"];
        first.into_iter().chain(keys.map(|key| parts(&row, key))).collect()
    });
    let heads = [
        "",
        "dragons",
        "an update on the device, ms",
        "its CPU time, ms",
        "a display frame on the device, ms",
    ];
    markdown(&heads, cells)
}

/// How the cost grows, and ours beside the paper's ways.
fn table1_growth(results: &Path) -> String {
    let Some(result) = read(results, TABLE1_RESULT) else { return NOT_MEASURED.to_owned() };
    let growth = cell_of(
        "{full_detail,1,2} in full detail, {shipped,1,2} as it ships, {as_paper,1,2} by the paper's ways",
        &result["growth"],
    );
    let speedups = result["speedups"].as_array().cloned().unwrap_or_default();
    let columns = ["{dragons,1,0}", "{animation_geometry,1,1}x", "{update,1,2}x"];
    let row = |speedup: &Value| columns.map(|cell| cell_of(cell, speedup)).into();
    let heads = ["dragons", "animation and geometry", "a whole update"];
    let table = markdown(&heads, speedups.iter().map(row));
    format!("An update's cost grows with the number of dragons to the power of {growth}.\n\n{table}")
}

/// Of each attack what was worst.
fn hostile(results: &Path) -> String {
    let result = read(results, "hostile").unwrap_or_default();
    let report = &result["report"];
    let ms = |value: &Value| value.as_u64().map_or_else(|| "-".to_owned(), |ms| format!("{ms} ms"));
    let grown = |value: &Value| {
        let of = |key: &str| value[key].as_f64().unwrap_or(0.0) * 1e-6;
        format!("{:.0} MB", (of("memory_peak_bytes") - of("memory_before_bytes")).max(0.0))
    };
    let per_s = |value: &Value| value.as_f64().map_or_else(|| "-".to_owned(), |per_s| format!("{per_s:.1}"));
    let name = |value: &Value, who: &str| format!("{}, {who}", value["attack"].as_str().unwrap_or("?"));
    let list = |key: &str| report[key].as_array().cloned().unwrap_or_default();
    let on_server = list("attacks").into_iter().map(|attack| {
        let is_serving = attack["while_serving"] == true;
        let who = if is_serving { "client served" } else { "nobody served" };
        vec![
            name(&attack, who),
            per_s(&attack["attacked_per_s"]),
            ms(&attack["attacked_pause_ms"]),
            ms(&attack["newcomer_ms"]),
            grown(&attack),
        ]
    });
    let on_client = list("client_attacks").into_iter().map(|attack| {
        vec![
            name(&attack, "on a client"),
            per_s(&attack["attacked_fps"]),
            ms(&attack["attacked_pause_ms"]),
            ms(&attack["back_ms"]),
            grown(&attack),
        ]
    });
    let heads = ["attack", "pictures or frames/s", "longest pause", "served afterwards within", "memory"];
    markdown(&heads, on_server.chain(on_client))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn root() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
    }

    #[test]
    fn the_tables_of_readme_and_docs_are_what_the_results_say() {
        for document in DOCUMENTS {
            let text = std::fs::read_to_string(root().join(document)).expect("it is there");
            assert!(text.contains(BEGIN), "{document} has no table of figures");
            let filled = filled(&text, &root().join(RESULTS)).expect(document);
            assert!(text == filled, "{document} says other than the results: run `shadecast-lab figures`");
        }
        let inspected = read(&root().join(RESULTS), KEYS_RESULT).expect("the error table");
        let keys = std::fs::read_to_string(root().join(KEYS)).expect("the curve");
        assert!(
            keys == crate::results::keys::svg(&inspected).expect("a curve"),
            "{KEYS}: run `shadecast-lab figures`"
        );
        let Some(table) = read(&root().join(RESULTS), TABLE1_RESULT) else { return };
        for (path, plot) in TABLE1_PLOTS {
            let drawn = std::fs::read_to_string(root().join(path)).expect("the plot");
            assert!(drawn == plot(&table).expect("a plot"), "{path}: run `shadecast-lab figures`");
        }
    }

    #[test]
    fn the_papers_table_follows_its_result() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["table1", "table1-as-paper", "table1-shipped", "table1-stages", "table1-growth"] {
            assert_eq!(table(name, folder.path()).expect("a table"), NOT_MEASURED, "{name}");
        }
        let report =
            serde_json::to_string(&crate::experiments::table1::report::tests::report()).expect("JSON");
        std::fs::write(folder.path().join("table1.json"), report).expect("written");
        let shown = table("table1", folder.path()).expect("a table");
        assert!(
            shown.starts_with("a device, 652x652 pixels an eye (scale 0.5), atlas of 4096x1024"),
            "{shown}"
        );
        assert_eq!(shown.lines().count(), 2 + 2 + 6, "{shown}");
        let row = "| 9 | animated | 11.11 | 250.0 | 1.00, 2.0 | 38, 370 | 0.90, 1.00 |";
        assert!(shown.contains(row), "{shown}");
        let stages = table("table1-stages", folder.path()).expect("a table");
        assert!(stages.contains("| paper, as-paper | 49 | id buffer 490.0, skin 980.0 |"), "{stages}");
        let growth = table("table1-growth", folder.path()).expect("a table");
        assert!(
            growth.contains("1.00 in full detail, 0.50 as it ships, 1.00 by the paper's ways"),
            "{growth}"
        );
    }

    #[test]
    fn a_table_is_replaced_between_its_comments_only() {
        let folder = tempfile::tempdir().expect("a folder");
        let result = r#"{"stats": {"psnr_db": 31.25, "hole_fraction": 0.001}, "motion": null}"#;
        std::fs::write(folder.path().join("robot-512.json"), result).expect("written");
        let text = "before\n<!-- figures scenes -->\nold\n<!-- /figures -->\nafter";
        let filled = filled(text, folder.path()).expect("filled");
        assert!(filled.starts_with("before\n<!-- figures scenes -->\n| scene |"), "{filled}");
        let row = "| stiff robot of 22 boxes | - | - | - | - | 31.2 | - | 0.100 | - / - | - | - | - + - |";
        assert!(filled.contains(row), "{filled}");
        assert!(filled.ends_with("\n<!-- /figures -->\nafter") && !filled.contains("old"), "{filled}");
        assert_eq!(super::filled(&filled, folder.path()).expect("again"), filled);
        assert!(super::filled("<!-- figures nothing -->\n<!-- /figures -->", folder.path()).is_err());
        assert!(super::filled("<!-- figures bars -->\n", folder.path()).is_err());
    }
}
