//! The paper's error table: the distance of sampled curves from their originals, and of the client's interpolation between
//! samples on a time grid.
//!
//! Curves are compared at their original keys, in percent of their own range: the largest distance between any two of their
//! values, an angle for rotations. Curves that hardly move (below 0.1 mrad, 0.01 mm or 0.00001) have no range and are omitted.
//! Vertices are compared at the keys of all curves, in millimetres.

use super::pose;
use super::sampling::SampledClip;
use super::sampling::SampledTrack;
use super::sampling::curve::Curve;
use super::sampling::probe::{VertexInputs, distances};
use super::sampling::source::{Source, Sources};
use crate::{Model, Repetition};
use glam::{Vec3A, Vec4};
use serde::Serialize;
use shadecast_model::playback::phase_s;
use std::collections::BTreeMap;

/// Most times at which vertices are compared; evenly fewer keys where there are more.
const MAX_VERTEX_TIMES: usize = 1024;
/// Where the grid of the client's samples may lie, in parts of its spacing.
const PHASES: [f64; 4] = [0.0, 0.25, 0.5, 0.75];
/// Distance at which millimetres become pixels, metres.
pub const PIXEL_DISTANCE_M: f64 = 2.0;
/// Millimetres of a pixel in the middle of the paper's picture (1300 pixels over 90 degrees) at 2 m.
pub const PAPER_PIXEL_MM: f64 = 2.0 * PIXEL_DISTANCE_M / 1300.0 * 1e3;
/// Millimetres of a pixel of a headset with 20 pixels a degree at 2 m.
pub const HEADSET_PIXEL_MM: f64 = PIXEL_DISTANCE_M * 0.017_455_064_928_217_585 / 20.0 * 1e3;

/// Errors of one clip.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ErrorTable {
    /// `None` where none moves; likewise the others.
    pub translation: Option<CurveError>,
    /// Rotations.
    pub rotation: Option<CurveError>,
    /// Scales.
    pub scale: Option<CurveError>,
    /// Weights of morph targets.
    pub weight: Option<CurveError>,
    /// Skinned vertices that the clip moves.
    pub vertices: Option<VertexError>,
}

/// Errors of curves of one kind, in percent of each curve's range.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CurveError {
    /// Curves that move.
    pub curves: usize,
    /// Their keys.
    pub samples: usize,
    /// Largest.
    pub max_percent: f64,
    /// 99 of 100 are no larger.
    pub p99_percent: f64,
    /// Mean.
    pub mean_percent: f64,
}

/// Errors of vertices.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct VertexError {
    /// Vertices times moments.
    pub samples: u64,
    /// Largest, millimetres.
    pub max_mm: f64,
    /// 99 of 100 are no larger (to 1.1 % of itself).
    pub p99_mm: f64,
    /// Mean.
    pub mean_mm: f64,
    /// Percent of samples within 0.1 mm.
    pub within_tenth_mm_percent: f64,
    /// The largest in pixels of the paper's picture, seen from 2 m.
    pub max_paper_pixels: f64,
    /// The largest in pixels of a headset with 20 pixels a degree, seen from 2 m.
    pub max_headset_pixels: f64,
}

/// The client's interpolation: weights of the samples at -1, 0, 1, 2 steps for a place in 0..=1.
pub type Weights = fn(f32) -> [f32; 4];

/// The paper's interpolation: between the two samples around.
pub fn linear_weights(f: f32) -> [f32; 4] {
    [0.0, 1.0 - f, f, 0.0]
}

/// What is measured: a clip of a model, and what it was sampled to.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a> {
    /// The model.
    pub model: &'a Model,
    /// Index into its clips.
    pub clip: usize,
    /// The clip sampled.
    pub sampled: &'a SampledClip,
    /// Metres of the world per unit of the model: the scale of its largest instance.
    pub world_scale: f32,
}

impl Subject<'_> {
    /// Errors of the sampled curves.
    pub fn resampling(&self) -> ErrorTable {
        let curves = self.curves();
        let of_curve = |entry: &Entry, time_s: f32| Some(entry.track.evaluate(f64::from(time_s)));
        self.table(
            &curves,
            |entry, time_s, add| add(of_curve(entry, time_s)),
            |times_s, vertices, add| {
                for time_s in times_s {
                    let [truth, found] = self.moments(f64::from(*time_s));
                    distances(self.model, &truth, &found, vertices, |_, distance| add(distance));
                }
            },
        )
    }

    /// Errors of what the client makes of samples `spacing_s` apart, interpolated with `weights`: of the bones' own
    /// transforms as the paper measures them (rotations componentwise along the shorter arc, then made unit length),
    /// and of vertex positions. Where the grid lies in the clip is a matter of chance: four places are looked at. A
    /// clip that does not end where it began is looked at only where all samples lie inside it.
    pub fn client_side(&self, spacing_s: f64, weights: Weights) -> ErrorTable {
        assert!(spacing_s > 0.0, "spacing {spacing_s} s");
        let curves = self.curves();
        let is_closed = curves.iter().all(Entry::is_closed);
        let duration_s = self.sampled.duration_s;
        let grids = PHASES.map(|phase| Grid {
            spacing_s,
            phase_s: phase * spacing_s,
            duration_s,
            is_closed,
            weights,
        });
        let of_curve = |entry: &Entry, time_s: f32, add: &mut dyn FnMut(Option<Vec4>)| {
            grids.iter().for_each(|grid| add(grid.value(entry, f64::from(time_s))));
        };
        self.table(&curves, of_curve, |times_s, vertices, add| {
            for grid in &grids {
                self.client_vertices(grid, times_s, vertices, add);
            }
        })
    }

    fn client_vertices(&self, grid: &Grid, times_s: &[f32], vertices: &[u32], add: &mut dyn FnMut(f32)) {
        let mut samples: BTreeMap<i64, Vec<Vec3A>> = BTreeMap::new();
        for time_s in times_s {
            let (first, weights) = grid.place(f64::from(*time_s));
            let Some(used) = grid.used(first, weights) else { continue };
            samples.retain(|index, _| *index >= first);
            for (index, at_s, _) in &used {
                samples.entry(*index).or_insert_with(|| {
                    positions(
                        self.model,
                        &VertexInputs::of_samples(self.model, self.sampled, *at_s),
                        vertices,
                    )
                });
            }
            let truth = VertexInputs::of_source(self.model, Some(self.clip), f64::from(*time_s));
            for (place, truth) in positions(self.model, &truth, vertices).into_iter().enumerate() {
                let found: Vec3A =
                    used.iter().map(|(index, _, weight)| samples[index][place] * *weight).sum();
                add(found.distance(truth));
            }
        }
    }

    fn moments(&self, t_s: f64) -> [VertexInputs; 2] {
        let truth = VertexInputs::of_source(self.model, Some(self.clip), t_s);
        [truth, VertexInputs::of_samples(self.model, self.sampled, t_s)]
    }

    /// Curves that move, with what they were sampled to.
    fn curves(&self) -> Vec<Entry<'_>> {
        let duration_s = self.sampled.duration_s;
        if duration_s <= 0.0 {
            return Vec::new();
        }
        let sources = Sources::new(self.model, Some(self.clip));
        let bones = sources.bones.iter().zip(&self.sampled.bones).flat_map(|(sources, tracks)| {
            (0..3).map(move |channel| (channel, sources[channel], &tracks[channel]))
        });
        let morphs =
            sources.morphs.iter().zip(&self.sampled.morphs).map(|(source, track)| (3, *source, track));
        let moving = bones.chain(morphs).filter(|(_, source, _)| source.varies());
        moving.filter_map(|(kind, source, track)| Entry::new(kind, &source, track, duration_s)).collect()
    }

    fn table(
        &self,
        curves: &[Entry],
        of_curve: impl Fn(&Entry, f32, &mut dyn FnMut(Option<Vec4>)),
        of_vertices: impl FnOnce(&[f32], &[u32], &mut dyn FnMut(f32)),
    ) -> ErrorTable {
        let of_kind = |kind: usize| {
            let mut errors = Vec::new();
            let mut count = 0;
            for entry in curves.iter().filter(|entry| entry.kind == kind && entry.range > 0.0) {
                count += 1;
                for key in &entry.curve.own_keys {
                    of_curve(entry, entry.curve.times_s[*key], &mut |value| {
                        let error = value.map(|value| entry.curve.deviation(value, *key) / entry.range);
                        errors.extend(error.map(|error| f64::from(error) * 100.0));
                    });
                }
            }
            CurveError::of(count, errors)
        };
        let moves = pose::animated_vertices(self.model, Some(self.clip));
        let vertices: Vec<u32> = (0..moves.len() as u32).filter(|vertex| moves[*vertex as usize]).collect();
        let mut histogram = Histogram::default();
        let scale = self.world_scale;
        of_vertices(&key_times(curves), &vertices, &mut |distance| {
            histogram.add(f64::from(distance * scale) * 1e3)
        });
        ErrorTable {
            translation: of_kind(0),
            rotation: of_kind(1),
            scale: of_kind(2),
            weight: of_kind(3),
            vertices: histogram.result(),
        }
    }
}

/// A curve that varies.
struct Entry<'a> {
    /// 0 translation, 1 rotation, 2 scale, 3 weight.
    kind: usize,
    curve: Curve,
    track: &'a SampledTrack,
    /// 0 for a curve that hardly moves.
    range: f32,
}

impl<'a> Entry<'a> {
    fn new(kind: usize, source: &Source, track: &'a SampledTrack, duration_s: f32) -> Option<Self> {
        let curve = Curve::new(source, duration_s);
        let range = curve.range();
        let range = if range <= curve.still_range() { 0.0 } else { range };
        Some(Self { kind, curve, track, range })
    }

    /// Whether it ends where it began, to 1 % of its range.
    fn is_closed(&self) -> bool {
        let last = self.curve.values.len() - 1;
        self.curve.deviation(self.curve.values[0], last) <= (0.01 * self.range).max(self.curve.still_range())
    }
}

/// The keys of all curves, ascending; evenly fewer of them where there are too many.
fn key_times(curves: &[Entry]) -> Vec<f32> {
    let keys =
        curves.iter().flat_map(|entry| entry.curve.own_keys.iter().map(|key| entry.curve.times_s[*key]));
    let mut times_s: Vec<f32> = keys.collect();
    times_s.sort_unstable_by(f32::total_cmp);
    times_s.dedup();
    let step = times_s.len().div_ceil(MAX_VERTEX_TIMES).max(1);
    times_s.into_iter().step_by(step).collect()
}

/// Where the client has samples.
struct Grid {
    spacing_s: f64,
    /// How much earlier than the clip's start a sample lies.
    phase_s: f64,
    duration_s: f32,
    is_closed: bool,
    weights: Weights,
}

impl Grid {
    /// The number of the first of four samples around a time, and their weights.
    fn place(&self, t_s: f64) -> (i64, [f32; 4]) {
        let position = (t_s + self.phase_s) / self.spacing_s;
        let before = (position + 1e-9).floor();
        (before as i64 - 1, (self.weights)((position - before).clamp(0.0, 1.0) as f32))
    }

    /// Number, time in the clip and weight of the samples that count; `None` where one lies outside the clip.
    fn used(&self, first: i64, weights: [f32; 4]) -> Option<Vec<(i64, f64, f32)>> {
        let numbered = (first..).zip(weights).filter(|(_, weight)| *weight != 0.0);
        numbered.map(|(index, weight)| Some((index, self.time_s(index)?, weight))).collect()
    }

    fn time_s(&self, index: i64) -> Option<f64> {
        let time_s = index as f64 * self.spacing_s - self.phase_s;
        if self.is_closed {
            return Some(phase_s(time_s, self.duration_s, Repetition::Loop));
        }
        (0.0..=f64::from(self.duration_s)).contains(&time_s).then_some(time_s)
    }

    fn value(&self, entry: &Entry, t_s: f64) -> Option<Vec4> {
        let (first, weights) = self.place(t_s);
        // Which of its two signs a rotation has is of no account: that of the truth.
        let truth = entry.curve.values[entry.curve.times_s.partition_point(|t| f64::from(*t) < t_s)];
        let aligned =
            |value: Vec4| if entry.curve.is_rotation && value.dot(truth) < 0.0 { -value } else { value };
        let used = self.used(first, weights)?;
        Some(used.into_iter().map(|(_, at_s, weight)| aligned(entry.track.evaluate(at_s)) * weight).sum())
    }
}

fn positions(model: &Model, moment: &VertexInputs, vertices: &[u32]) -> Vec<Vec3A> {
    let morphed = pose::morphed(model, &moment.weights);
    let place = |index: &u32| {
        let vertex = &morphed[*index as usize];
        pose::blend(&moment.palette, vertex.joints, vertex.weights).transform_point3a(vertex.position.into())
    };
    vertices.iter().map(place).collect()
}

impl CurveError {
    fn of(curves: usize, mut errors: Vec<f64>) -> Option<Self> {
        errors.sort_unstable_by(f64::total_cmp);
        let samples = errors.len();
        let max_percent = *errors.last()?;
        let p99_percent = errors[(samples * 99).div_ceil(100) - 1];
        let mean_percent = errors.iter().sum::<f64>() / samples as f64;
        Some(Self { curves, samples, max_percent, p99_percent, mean_percent })
    }
}

/// Bins of a 64th of an octave from a picometre on.
struct Histogram {
    bins: Vec<u64>,
    count: u64,
    within: u64,
    sum: f64,
    largest: f64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: vec![0; 64 * 64], count: 0, within: 0, sum: 0.0, largest: 0.0 }
    }
}

const FIRST_BIN_MM: f64 = 1e-9;

impl Histogram {
    fn add(&mut self, mm: f64) {
        let bin = ((mm.max(FIRST_BIN_MM) / FIRST_BIN_MM).log2() * 64.0) as usize;
        let last = self.bins.len() - 1;
        self.bins[bin.min(last)] += 1;
        self.count += 1;
        self.within += u64::from(mm <= 0.1);
        self.sum += mm;
        self.largest = self.largest.max(mm);
    }

    fn result(&self) -> Option<VertexError> {
        let wanted = (self.count * 99).div_ceil(100).max(1);
        let mut seen = 0;
        let bin = self.bins.iter().position(|count| {
            seen += count;
            seen >= wanted
        })?;
        let p99_mm = (FIRST_BIN_MM * ((bin + 1) as f64 / 64.0).exp2()).min(self.largest);
        Some(VertexError {
            samples: self.count,
            max_mm: self.largest,
            p99_mm,
            mean_mm: self.sum / self.count as f64,
            within_tenth_mm_percent: 100.0 * self.within as f64 / self.count as f64,
            max_paper_pixels: self.largest / PAPER_PIXEL_MM,
            max_headset_pixels: self.largest / HEADSET_PIXEL_MM,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::sampling::{Sampling, sample};
    use super::super::test_models::one_bone;
    use super::*;
    use crate::{Interpolation, PaletteEntry, Track, TrackValues, Vertex};
    use glam::{Affine3A, Quat, Vec3};
    use std::f32::consts::TAU;

    /// Lagrange's polynomial through four samples, as the client's.
    fn cubic(f: f32) -> [f32; 4] {
        let (a, b, c) = (f + 1.0, f - 1.0, f - 2.0);
        [-f * b * c / 6.0, a * b * c / 2.0, -a * f * c / 2.0, a * f * b / 6.0]
    }

    /// A bone that swings 40 degrees to either side at 1 Hz, with a vertex 1 m away; keys each 5 ms.
    fn swinging() -> Model {
        let times_s: Vec<f32> = (0..=800).map(|key| key as f32 / 200.0).collect();
        let turn = |t: &f32| Quat::from_rotation_x(40f32.to_radians() * (TAU * t).sin());
        let values = TrackValues::Rotation(times_s.iter().map(turn).collect());
        let mut model = one_bone(Track { bone: 0, times_s, interpolation: Interpolation::Linear, values });
        model.palette = vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }];
        model.vertices = vec![Vertex { position: Vec3::Y, ..Vertex::default() }];
        model
    }

    fn with_sampled<T>(model: &Model, sampling: Sampling, measure: impl FnOnce(Subject) -> T) -> T {
        measure(Subject { model, clip: 0, sampled: &sample(model, Some(0), sampling), world_scale: 1.0 })
    }

    #[test]
    fn sine_of_1_hz_loses_2_45_percent_at_100_ms() {
        let table = with_sampled(&swinging(), Sampling::Constant { interval_s: 0.1 }, |s| s.resampling());
        let rotation = table.rotation.expect("it turns");
        assert!((rotation.max_percent - 2.447).abs() < 0.03, "{rotation:?}");
        assert!(rotation.mean_percent < rotation.p99_percent && rotation.p99_percent < rotation.max_percent);
        assert_eq!((rotation.curves, rotation.samples, table.translation), (1, 801, None));
        // 2.447 % of 80 degrees at 1 m are 34 mm.
        let vertices = table.vertices.expect("a vertex moves");
        assert!((vertices.max_mm - 34.2).abs() < 1.0, "{vertices:?}");
        assert!((vertices.max_paper_pixels - vertices.max_mm / 3.077).abs() < 0.01);
        assert!((vertices.max_headset_pixels - vertices.max_mm / 1.7455).abs() < 0.01);
    }

    #[test]
    fn linear_clients_err_like_resampling_and_cubic_ones_hardly() {
        with_sampled(&swinging(), Sampling::Constant { interval_s: 0.005 }, |subject| {
            let percent = |table: ErrorTable| table.rotation.expect("it turns").max_percent;
            let linear = percent(subject.client_side(0.1, linear_weights));
            assert!((linear - 2.447).abs() < 0.03, "{linear} %");
            let linear = percent(subject.client_side(1.0 / 30.0, linear_weights));
            assert!((linear - 0.274).abs() < 0.01, "{linear} %");
            let found = subject.client_side(1.0 / 30.0, cubic);
            assert!(percent(found.clone()) < 0.01, "{found:?}");
            assert!(found.vertices.expect("a vertex").max_mm < 0.2, "{found:?}");
        });
    }

    #[test]
    fn exact_samples_have_no_error() {
        let table = with_sampled(&swinging(), Sampling::Constant { interval_s: 0.005 }, |s| s.resampling());
        let (rotation, vertices) = (table.rotation.expect("turns"), table.vertices.expect("moves"));
        assert!(rotation.max_percent < 1e-3 && vertices.max_mm < 0.01, "{table:?}");
        assert_eq!(vertices.within_tenth_mm_percent, 100.0);
    }

    #[test]
    fn world_scale_makes_vertex_errors_larger() {
        let model = swinging();
        let sampled = sample(&model, Some(0), Sampling::Constant { interval_s: 0.1 });
        let of = |world_scale| {
            let subject = Subject { model: &model, clip: 0, sampled: &sampled, world_scale };
            subject.resampling().vertices.expect("moves").max_mm
        };
        assert!((of(3.0) / of(1.0) - 3.0).abs() < 1e-3);
    }

    #[test]
    fn quantile_of_the_histogram_is_right_to_its_bins() {
        let mut histogram = Histogram::default();
        (1..=1000).for_each(|mm| histogram.add(f64::from(mm)));
        let result = histogram.result().expect("filled");
        assert!((result.p99_mm / 990.0 - 1.0).abs() < 0.012, "{result:?}");
        assert_eq!((result.max_mm, result.mean_mm), (1000.0, 500.5));
    }
}
