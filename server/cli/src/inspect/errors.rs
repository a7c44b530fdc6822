//! `inspect error`: the paper's error table of each clip, and keys against error for a range of samplings. No client has a
//! part in it: errors on the time grid are those of interpolation alone, before quantisation and with a perfect clock.

use super::load;
use super::table::Table;
use crate::arguments::SamplingArgs;
use clap::{Args, ValueEnum};
use serde::Serialize;
use shadecast_desktop::flags::number;
use shadecast_protocol::text::printable;
use shadecast_scene::animation::error::{
    CurveError, ErrorTable, HEADSET_PIXEL_MM, PAPER_PIXEL_MM, Subject, VertexError, Weights, linear_weights,
};
use shadecast_scene::animation::sampling::{Sampling, sample, world_scale};
use shadecast_scene::{Model, Scene};
use shadecast_shaders::curve::cubic_weights;

/// Intervals of the curve, milliseconds.
const INTERVALS_MS: [f32; 12] =
    [500.0, 400.0, 250.0, 200.0, 125.0, 100.0, 66.666_7, 50.0, 33.333_3, 25.0, 16.666_7, 8.333_33];
/// Bounds of the curve, millimetres.
const BOUNDS_MM: [f32; 10] = [10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01];

/// Below this an error is single precision's, and says nothing about sampling.
const LEAST_ERROR_MM: f64 = 5e-3;

/// `inspect error SCENE`.
#[derive(Args)]
pub struct ErrorArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// JSON, as docs/inspect.md describes it, instead of text
    #[arg(long)]
    json: bool,
    /// Milliseconds between the samples that the client gets
    #[arg(long, default_value_t = 100.0 / 3.0, value_parser = number(1.0..=2000.0, "milliseconds"))]
    spacing_ms: f64,
    /// How the client interpolates [default: both]
    #[arg(long, value_enum)]
    interpolation: Option<ClientInterpolation>,
    #[command(flatten)]
    sampling: SamplingArgs,
    /// Keys and bytes against error, for constant intervals and for bounds
    #[arg(long)]
    curve: bool,
}

/// How the client goes from sample to sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ClientInterpolation {
    /// Between two samples: the paper's
    Linear,
    /// Through four samples
    Cubic,
}

impl ClientInterpolation {
    fn weights(self) -> Weights {
        match self {
            Self::Linear => linear_weights,
            Self::Cubic => cubic_weights,
        }
    }
}

/// Runs the command; returns what it prints.
pub(super) fn run(args: &ErrorArgs) -> anyhow::Result<String> {
    let (scene, _) = load(&args.scene)?;
    let report = ErrorReport::new(&scene, args);
    Ok(if args.json { serde_json::to_string_pretty(&report)? + "\n" } else { report.text() })
}

/// Errors of all clips of a scene.
#[derive(Serialize)]
pub struct ErrorReport {
    sampling: String,
    spacing_ms: f64,
    paper_pixel_mm: f64,
    headset_pixel_mm: f64,
    clips: Vec<ClipErrors>,
}

#[derive(Serialize)]
struct ClipErrors {
    model: String,
    clip: String,
    duration_s: f32,
    keys: usize,
    bytes: usize,
    resampling: ErrorTable,
    on_grid: Vec<GridErrors>,
    #[serde(skip_serializing_if = "Option::is_none")]
    curve: Option<KeyCurve>,
}

#[derive(Serialize)]
struct GridErrors {
    interpolation: ClientInterpolation,
    table: ErrorTable,
}

/// Size against error.
#[derive(Serialize)]
struct KeyCurve {
    constant: Vec<CurvePoint>,
    bounded: Vec<CurvePoint>,
}

#[derive(Serialize)]
struct CurvePoint {
    sampling: String,
    keys: usize,
    bytes: usize,
    table: ErrorTable,
    bends_here: bool,
}

impl ErrorReport {
    fn new(scene: &Scene, args: &ErrorArgs) -> Self {
        let with_clips = scene.models.iter().enumerate().flat_map(|(index, model)| {
            (0..model.clips.len()).map(move |clip| (model, clip, world_scale(scene, index)))
        });
        Self {
            sampling: args.sampling.sampling.to_string(),
            spacing_ms: args.spacing_ms,
            paper_pixel_mm: PAPER_PIXEL_MM,
            headset_pixel_mm: HEADSET_PIXEL_MM,
            clips: with_clips.map(|(model, clip, scale)| ClipErrors::new(model, clip, scale, args)).collect(),
        }
    }

    fn text(&self) -> String {
        let mut text = format!(
            "sampling {}, the grid's samples each {:.1} ms, interpolated before quantisation and with a perfect clock: what a \
             client really shows is measured by shadecast-lab run --measure-motion\n\
             curves: percent of their own range, at the original keys; a pixel at 2 m is {:.3} mm of a picture of 1300 \
             pixels over 90 degrees, {:.3} mm of a headset with 20 pixels a degree\n",
            self.sampling, self.spacing_ms, self.paper_pixel_mm, self.headset_pixel_mm
        );
        if self.clips.is_empty() {
            text += "no clips\n";
        }
        self.clips.iter().for_each(|clip| text += &clip.text());
        text
    }
}

impl ClipErrors {
    fn new(model: &Model, clip: usize, scale: f32, args: &ErrorArgs) -> Self {
        let sampled = sample(model, Some(clip), args.sampling.sampling.in_model(scale));
        let subject = Subject { model, clip, sampled: &sampled, world_scale: scale };
        let wanted =
            args.interpolation.map_or(ClientInterpolation::value_variants().to_vec(), |one| vec![one]);
        let on_grid = wanted.into_iter().map(|interpolation| GridErrors {
            interpolation,
            table: subject.client_side(args.spacing_ms * 1e-3, interpolation.weights()),
        });
        Self {
            model: printable(&model.name),
            clip: model.clips[clip].name.clone(),
            duration_s: sampled.duration_s,
            keys: sampled.key_count(),
            bytes: sampled.byte_count(),
            resampling: subject.resampling(),
            on_grid: on_grid.collect(),
            curve: args.curve.then(|| KeyCurve::new(model, clip, scale)),
        }
    }

    fn text(&self) -> String {
        let Self { model, clip, duration_s, keys, bytes, .. } = self;
        let mut text = format!("\n{model}, clip {clip}: {duration_s:.3} s, {keys} keys, {bytes} bytes\n");
        let mut table = Table::new(&["", "curves", "maximum %", "99th %", "mean %"]);
        add_curves(&mut table, "resampling", &self.resampling);
        for grid in &self.on_grid {
            add_curves(&mut table, grid.name(), &grid.table);
        }
        text += &table.text();
        let heads =
            ["vertices", "maximum mm", "99th mm", "mean mm", "within 0.1 mm %", "pixels", "headset pixels"];
        let mut table = Table::new(&heads);
        add_vertices(&mut table, "resampling", &self.resampling);
        for grid in &self.on_grid {
            add_vertices(&mut table, grid.name(), &grid.table);
        }
        text += &table.text();
        text + &self.curve.as_ref().map_or(String::new(), KeyCurve::text)
    }
}

impl GridErrors {
    fn name(&self) -> &'static str {
        match self.interpolation {
            ClientInterpolation::Linear => "on the grid, linear",
            ClientInterpolation::Cubic => "on the grid, cubic",
        }
    }
}

fn kinds(table: &ErrorTable) -> [(&'static str, Option<CurveError>); 4] {
    [
        ("translation", table.translation),
        ("rotation", table.rotation),
        ("scale", table.scale),
        ("weight", table.weight),
    ]
}

fn add_curves(table: &mut Table, name: &str, errors: &ErrorTable) {
    for (kind, error) in kinds(errors) {
        let Some(CurveError { curves, max_percent, p99_percent, mean_percent, .. }) = error else { continue };
        let percents = [max_percent, p99_percent, mean_percent].map(|percent| format!("{percent:.4}"));
        table.row(&format!("{name}: {kind}"), std::iter::once(curves.to_string()).chain(percents));
    }
}

fn add_vertices(table: &mut Table, name: &str, errors: &ErrorTable) {
    let Some(VertexError { max_mm, p99_mm, mean_mm, within_tenth_mm_percent, .. }) = errors.vertices else {
        return;
    };
    let VertexError { max_paper_pixels, max_headset_pixels, .. } = errors.vertices.expect("just seen");
    let cells = [max_mm, p99_mm, mean_mm, within_tenth_mm_percent, max_paper_pixels, max_headset_pixels];
    table.row(name, cells.map(|cell| format!("{cell:.4}")));
}

impl KeyCurve {
    fn new(model: &Model, clip: usize, scale: f32) -> Self {
        let point = |sampling: Sampling| {
            let sampled = sample(model, Some(clip), sampling.in_model(scale));
            let subject = Subject { model, clip, sampled: &sampled, world_scale: scale };
            CurvePoint {
                sampling: sampling.to_string(),
                keys: sampled.key_count(),
                bytes: sampled.byte_count(),
                table: subject.resampling(),
                bends_here: false,
            }
        };
        let constant = INTERVALS_MS.map(|ms| point(Sampling::Constant { interval_s: ms * 1e-3 }));
        let bounded = BOUNDS_MM.map(|mm| point(Sampling::bounded(mm * 1e-3)));
        let [constant, bounded] = [constant.into(), bounded.into()].map(with_bend);
        Self { constant, bounded }
    }

    fn text(&self) -> String {
        let heads =
            ["sampling", "keys", "bytes", "translation %", "rotation %", "vertices mm", "99th mm", ""];
        let mut table = Table::new(&heads);
        for point in self.constant.iter().chain(&self.bounded) {
            let percent =
                |e: Option<CurveError>| e.map_or(String::new(), |e| format!("{:.4}", e.max_percent));
            let [(_, translation), (_, rotation), ..] = kinds(&point.table);
            let mm = |of: fn(&VertexError) -> f64| {
                point.table.vertices.as_ref().map_or(String::new(), |v| format!("{:.4}", of(v)))
            };
            let cells = [
                point.keys.to_string(),
                point.bytes.to_string(),
                percent(translation),
                percent(rotation),
                mm(|v| v.max_mm),
                mm(|v| v.p99_mm),
                if point.bends_here { "<- bends" } else { "" }.to_owned(),
            ];
            table.row(&point.sampling, cells);
        }
        format!("largest errors at the original keys against keys\n{}", table.text())
    }
}

/// Marks where the curve of bytes against the largest vertex error, both as logarithms, is farthest below the straight
/// line between its ends: before it, bytes buy much accuracy; after it, little. Points with hardly any
/// error are left out.
fn with_bend(mut points: Vec<CurvePoint>) -> Vec<CurvePoint> {
    let place = |point: &CurvePoint| {
        let error_mm = point.table.vertices.map_or(0.0, |vertices| vertices.max_mm);
        (error_mm > LEAST_ERROR_MM).then(|| ((point.bytes as f64).ln(), error_mm.ln()))
    };
    let places: Vec<(usize, (f64, f64))> =
        points.iter().enumerate().filter_map(|(index, point)| Some((index, place(point)?))).collect();
    let (Some((_, first)), Some((_, last))) = (places.first(), places.last()) else { return points };
    let below = |(x, y): (f64, f64)| (last.0 - first.0) * (first.1 - y) - (first.0 - x) * (last.1 - first.1);
    let farthest = places.iter().max_by(|a, b| below(a.1).total_cmp(&below(b.1)));
    if let Some((index, at)) = farthest.filter(|(_, at)| below(*at) > 1e-9) {
        debug_assert!(at.0.is_finite());
        points[*index].bends_here = true;
    }
    points
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use shadecast_scene::{Bone, Clip, Interpolation, PaletteEntry, Track, TrackValues, Trs, Vertex};

    /// A bone that swings at 1 Hz with one vertex.
    fn swinging() -> Model {
        let times_s: Vec<f32> = (0..=120).map(|key| key as f32 / 60.0).collect();
        let turn = |t: &f32| glam::Quat::from_rotation_x(0.5 * (std::f32::consts::TAU * t).sin());
        let values = TrackValues::Rotation(times_s.iter().map(turn).collect());
        let track = Track { bone: 0, times_s, interpolation: Interpolation::Linear, values };
        let clip = Clip { name: "swing".into(), duration_s: 2.0, tracks: vec![track], ..Clip::default() };
        Model {
            bones: vec![Bone { name: "b".into(), parent: None, rest: Trs::IDENTITY }],
            palette: vec![PaletteEntry { bone: 0, bone_from_mesh: glam::Affine3A::IDENTITY }],
            vertices: vec![Vertex { position: glam::Vec3::Y, ..Vertex::default() }],
            clips: vec![clip],
            ..Model::default()
        }
    }

    fn args() -> ErrorArgs {
        let (sampling, interpolation) = (SamplingArgs { sampling: Sampling::default() }, None);
        ErrorArgs { scene: String::new(), json: true, spacing_ms: 33.3, interpolation, sampling, curve: true }
    }

    /// A report with every key in it.
    pub fn small_report() -> serde_json::Value {
        let clips = vec![ClipErrors::new(&swinging(), 0, 1.0, &args())];
        let report = ErrorReport {
            sampling: Sampling::default().to_string(),
            spacing_ms: 33.3,
            paper_pixel_mm: PAPER_PIXEL_MM,
            headset_pixel_mm: HEADSET_PIXEL_MM,
            clips,
        };
        serde_json::to_value(report).expect("JSON")
    }

    #[test]
    fn longer_intervals_and_wider_bounds_err_more_with_fewer_bytes() {
        let curve = KeyCurve::new(&swinging(), 0, 1.0);
        let error_mm = |point: &CurvePoint| point.table.vertices.expect("moves").max_mm;
        assert!(error_mm(&curve.constant[0]) > 100.0 && error_mm(&curve.constant[10]) < 1e-2);
        assert!(curve.bounded.windows(2).all(|pair| pair[0].bytes <= pair[1].bytes));
        for (point, bound_mm) in curve.bounded.iter().zip(BOUNDS_MM) {
            assert!(error_mm(point) <= f64::from(bound_mm) * 1.001, "{}", point.sampling);
        }
        assert_eq!(curve.constant.iter().filter(|point| point.bends_here).count(), 1);
    }

    #[test]
    fn both_interpolations_are_reported_unless_one_is_asked_for() {
        let both = ClipErrors::new(&swinging(), 0, 1.0, &args());
        assert_eq!(both.on_grid.len(), 2);
        let max = |index: usize| both.on_grid[index].table.rotation.expect("turns").max_percent;
        assert!(max(0) > 0.2 && max(1) < 0.1, "linear {} %, cubic {} %", max(0), max(1));
        let one = ErrorArgs { interpolation: Some(ClientInterpolation::Cubic), ..args() };
        assert_eq!(ClipErrors::new(&swinging(), 0, 1.0, &one).on_grid.len(), 1);
    }
}
