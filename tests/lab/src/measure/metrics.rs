//! Quality of a displayed frame against the truth: the forward renderer with the same eye pose, field of view and display time.
//!
//! Every figure covers the pixels with geometry in the truth, because an empty sky would flatter all of them. Two regions have
//! their own figures, because a still ground flatters moving geometry: pixels of animated instances in the truth, and still
//! surfaces with a moving shadow, now or just before. Pictures are compared after display encoding, as sRGB bytes. Filters of
//! SSIM and FLIP read neighbours outside that mask too: only their results are masked.
//!
//! A **hole** is a pixel of the mask where the client's picture has another instance, or none, or a depth more than 1 % behind
//! the truth's. The share is of the mask, not of the picture.

use thiserror::Error;

use super::flip::{DEFAULT_PIXELS_PER_DEGREE, flip_map};
use super::ssim::ssim_map;
use crate::image::Rgb8Image;

/// The least share of the picture that must show geometry for its figures to count.
pub const MIN_TRUTH_COVERAGE: f64 = 0.4;

/// A region of a view with fewer pixels gives no figures: they would be those of an outline.
pub const MIN_REGION_PIXELS: usize = 64;

/// What PSNR is cut at, so that identical pictures do not make means infinite.
pub const MAX_PSNR_DB: f64 = 99.0;

/// How far behind the truth the client's depth may lie, as a factor.
const DEPTH_TOLERANCE: f32 = 1.01;

/// A surface ends where the inverse of its depth bends by more than this part of it from pixel to pixel.
const OUTLINE_BEND: f32 = 0.02;

/// What an eye sees at every pixel, apart from colour. Both lists run row by row from the top left.
#[derive(Clone, Debug)]
pub struct ProbeView {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The nearest instance, [`ProbeView::BACKGROUND`] where there is none.
    pub instance: Vec<u32>,
    /// Its distance from the eye along the view direction, in metres; infinite where there is none.
    pub depth_m: Vec<f32>,
}

impl ProbeView {
    /// The instance where nothing is seen.
    pub const BACKGROUND: u32 = u32::MAX;

    /// Whether each pixel shows geometry.
    pub fn geometry_mask(&self) -> Vec<bool> {
        self.instance.iter().map(|&instance| instance != Self::BACKGROUND).collect()
    }

    /// The share of pixels that show geometry, 0 to 1.
    pub fn coverage(&self) -> f64 {
        let shown = self.instance.iter().filter(|&&instance| instance != Self::BACKGROUND).count();
        shown as f64 / self.instance.len().max(1) as f64
    }

    fn check(&self, name: &'static str) -> Result<(), MetricsError> {
        let want = self.width as usize * self.height as usize;
        if self.instance.len() == want && self.depth_m.len() == want && want > 0 {
            return Ok(());
        }
        let got = [self.instance.len(), self.depth_m.len()];
        Err(MetricsError::Probe { name, width: self.width, height: self.height, got })
    }

    /// Whether `other` shows at pixel `there` what `self` shows at pixel `here`, no more than 1 % behind it.
    fn is_shown_by(&self, here: usize, other: &Self, there: usize) -> bool {
        self.instance[here] == other.instance[there]
            && other.depth_m[there] <= self.depth_m[here] * DEPTH_TOLERANCE
    }

    /// The pixels around one, itself included, as far as they exist.
    fn neighbourhood(&self, at: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, height) = (self.width as usize, self.height as usize);
        let (x, y) = (at % width, at / width);
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        rows.flat_map(move |y| (x.saturating_sub(1)..(x + 2).min(width)).map(move |x| y * width + x))
    }

    /// Whether a surface ends within one pixel: another instance is seen beside it, or its depth jumps. Over a plane the inverse
    /// of depth is linear, however steeply it is seen.
    fn is_outline(&self, at: usize) -> bool {
        let (width, height) = (self.width as usize, self.height as usize);
        let (x, y) = (at % width, at / width);
        let has_both = [x > 0 && x + 1 < width, y > 0 && y + 1 < height];
        let inverse = |at: usize| 1.0 / self.depth_m[at];
        let jumps = has_both.into_iter().zip([1, width]).any(|(both, step)| {
            both && {
                let bend = inverse(at - step) + inverse(at + step) - 2.0 * inverse(at);
                bend.abs() > OUTLINE_BEND * inverse(at)
            }
        });
        jumps || self.neighbourhood(at).any(|near| self.instance[near] != self.instance[at])
    }

    /// Whether the outline of something passes within one pixel.
    fn is_silhouette(&self, at: usize) -> bool {
        self.neighbourhood(at)
            .any(|near| !self.is_shown_by(at, self, near) || !self.is_shown_by(near, self, at))
    }
}

/// Why two views cannot be compared.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum MetricsError {
    /// Pictures or probes of one frame differ in extent.
    #[error("cannot compare the truth ({}x{} pixels) with {name} ({}x{} pixels): render both at one size",
            .truth[0], .truth[1], .got[0], .got[1])]
    Extents {
        /// What differs from the truth's picture.
        name: &'static str,
        /// Extent of the truth's picture, in pixels.
        truth: [u32; 2],
        /// Extent of the other, in pixels.
        got: [u32; 2],
    },
    /// A probe that does not hold what it says.
    #[error("{name} says {width}x{height} pixels, but holds {} instances and {} depths", .got[0], .got[1])]
    Probe {
        /// Which probe.
        name: &'static str,
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// How many instances and depths there are.
        got: [usize; 2],
    },
}

/// One eye's view of one displayed frame, and what it should have been.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The forward renderer's picture.
    pub truth: &'a Rgb8Image,
    /// What the forward renderer drew there.
    pub truth_probe: &'a ProbeView,
    /// The client's picture.
    pub client: &'a Rgb8Image,
    /// What the client drew there; none if it displayed the frame without a bundle, which makes all of it holes.
    pub client_probe: Option<&'a ProbeView>,
    /// Pixels per degree at the centre of the view: FLIP is given for this number too.
    pub pixels_per_degree: f32,
    /// Parts of the view that are also measured by themselves.
    pub regions: &'a Regions,
}

/// Which pixels belong to the parts of a view that are measured by themselves. Only those with geometry count.
#[derive(Clone, Debug, Default)]
pub struct Regions {
    /// The truth shows an animated instance.
    pub animated: Vec<bool>,
    /// A moving shadow falls there, or has just fallen.
    pub shadowed: Vec<bool>,
}

impl Regions {
    /// Empty ones, for a view of so many pixels.
    pub fn none(pixels: usize) -> Self {
        Self { animated: vec![false; pixels], shadowed: vec![false; pixels] }
    }
}

/// How close two pictures are, over the pixels where the truth shows geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureMetrics {
    /// Peak signal to noise ratio over sRGB bytes in dB, at most [`MAX_PSNR_DB`].
    pub psnr_db: f64,
    /// Structural similarity, -1 to 1 (identical).
    pub ssim: f64,
    /// FLIP at 67 pixels per degree, 0 (identical) to 1.
    pub flip: f64,
    /// FLIP at the view's own pixels per degree, 0 (identical) to 1.
    pub flip_at_view: f64,
}

/// How much of what should be seen is missing, 0 (nothing) to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Holes {
    /// Pixels that are holes: the figure that counts.
    pub strict: f64,
    /// Holes without those along outlines that a shift by one pixel explains. Always beside `strict`, never instead.
    pub beyond_outlines: f64,
}

/// The figures of a part of a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RegionMetrics {
    /// How close the pictures are there; none if the part, or the whole view, has too few pixels for figures to count.
    pub picture: Option<PictureMetrics>,
    /// What is missing there, as a share of it.
    pub holes: Holes,
    /// Pixels of it that show geometry.
    pub pixels: usize,
}

/// The figures of one eye's view of one displayed frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameMetrics {
    /// How close the pictures are; none if the truth shows too little geometry for figures to count.
    pub picture: Option<PictureMetrics>,
    /// What is missing.
    pub holes: Holes,
    /// The share of the picture where the truth shows geometry, 0 to 1.
    pub truth_coverage: f64,
    /// Pixels where the truth shows geometry.
    pub pixels: usize,
    /// Whether the client had a bundle to display.
    pub has_bundle: bool,
    /// Over pixels whose truth shows an animated instance.
    pub animated: RegionMetrics,
    /// Over still surfaces on which a moving shadow falls or has just fallen.
    pub shadowed: RegionMetrics,
}

impl FrameMetrics {
    /// Measures one view.
    pub fn measure(view: &View<'_>) -> Result<Self, MetricsError> {
        check_extents(view)?;
        let truth_coverage = view.truth_probe.coverage();
        let errors = (truth_coverage >= MIN_TRUTH_COVERAGE).then(|| ErrorMaps::new(view));
        let geometry = view.truth_probe.geometry_mask();
        let region = |inside: &[bool]| {
            let mask: Vec<bool> =
                geometry.iter().zip(inside).map(|(shown, inside)| *shown && *inside).collect();
            RegionMetrics::measure(view, errors.as_ref(), &mask)
        };
        Ok(Self {
            picture: errors.as_ref().map(|errors| errors.over(&geometry)),
            holes: Holes::over(view, &geometry),
            truth_coverage,
            pixels: count(&geometry),
            has_bundle: view.client_probe.is_some(),
            animated: region(&view.regions.animated),
            shadowed: region(&view.regions.shadowed),
        })
    }

    /// Whether the figures count.
    pub fn compared(&self) -> bool {
        self.picture.is_some()
    }
}

fn check_extents(view: &View<'_>) -> Result<(), MetricsError> {
    view.truth_probe.check("the truth's probe")?;
    view.client_probe.map_or(Ok(()), |probe| probe.check("the client's probe"))?;
    let truth = [view.truth.width, view.truth.height];
    let probe_extent = |probe: &ProbeView| [probe.width, probe.height];
    let others = [
        ("the client's picture", Some([view.client.width, view.client.height])),
        ("the truth's probe", Some(probe_extent(view.truth_probe))),
        ("the client's probe", view.client_probe.map(probe_extent)),
    ];
    for (name, extent) in others {
        if let Some(got) = extent.filter(|&extent| extent != truth) {
            return Err(MetricsError::Extents { name, truth, got });
        }
    }
    let pixels = view.truth.pixel_count();
    let regions = [view.regions.animated.len(), view.regions.shadowed.len()];
    assert_eq!(regions, [pixels; 2], "a region says something of every pixel");
    Ok(())
}

fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|inside| **inside).count()
}

impl RegionMetrics {
    fn measure(view: &View<'_>, errors: Option<&ErrorMaps>, mask: &[bool]) -> Self {
        let pixels = count(mask);
        let picture = errors.filter(|_| pixels >= MIN_REGION_PIXELS).map(|errors| errors.over(mask));
        Self { picture, holes: Holes::over(view, mask), pixels }
    }
}

/// What two pictures differ by, pixel by pixel; made once for all regions.
struct ErrorMaps {
    mean_squares: Vec<f64>,
    ssim: Vec<f64>,
    flip: Vec<f32>,
    flip_at_view: Vec<f32>,
}

impl ErrorMaps {
    fn new(view: &View<'_>) -> Self {
        let flip = |pixels_per_degree| flip_map(view.truth, view.client, pixels_per_degree);
        Self {
            mean_squares: mean_squares(view.truth, view.client).collect(),
            ssim: ssim_map(view.truth, view.client),
            flip: flip(DEFAULT_PIXELS_PER_DEGREE),
            flip_at_view: flip(view.pixels_per_degree),
        }
    }

    /// The figures of the pixels in the mask, which holds at least one.
    fn over(&self, mask: &[bool]) -> PictureMetrics {
        let flip = |map: &[f32]| masked_mean(map.iter().map(|error| f64::from(*error)), mask);
        PictureMetrics {
            psnr_db: decibels(masked_mean(self.mean_squares.iter().copied(), mask)),
            ssim: masked_mean(self.ssim.iter().copied(), mask),
            flip: flip(&self.flip),
            flip_at_view: flip(&self.flip_at_view),
        }
    }
}

/// Peak signal to noise ratio in dB over the bytes of all pixels in the mask, at most [`MAX_PSNR_DB`].
pub fn psnr_db(a: &Rgb8Image, b: &Rgb8Image, mask: &[bool]) -> f64 {
    decibels(masked_mean(mean_squares(a, b), mask))
}

/// By pixel, the mean over the channels of the squared difference.
fn mean_squares(a: &Rgb8Image, b: &Rgb8Image) -> impl Iterator<Item = f64> {
    let pixels = a.data.chunks_exact(3).zip(b.data.chunks_exact(3));
    pixels.map(|(a, b)| {
        let squares: u32 = a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum();
        f64::from(squares) / 3.0
    })
}

fn decibels(mean_square: f64) -> f64 {
    (10.0 * (255.0 * 255.0 / mean_square).log10()).min(MAX_PSNR_DB)
}

/// The mean of the values in the mask, which holds at least one.
fn masked_mean(values: impl IntoIterator<Item = f64>, mask: &[bool]) -> f64 {
    let chosen = values.into_iter().zip(mask).filter(|(_, inside)| **inside);
    let (sum, count) = chosen.fold((0.0, 0), |(sum, count), (value, _)| (sum + value, count + 1));
    sum / f64::from(count)
}

impl Holes {
    /// Compares what two views show. Where the truth shows no geometry, nothing can be missing.
    pub fn measure(truth: &ProbeView, client: &ProbeView) -> Result<Self, MetricsError> {
        Self::within(truth, client, &truth.geometry_mask())
    }

    /// The same of a part of the view that shows geometry in the truth.
    pub fn within(truth: &ProbeView, client: &ProbeView, mask: &[bool]) -> Result<Self, MetricsError> {
        truth.check("the truth's probe")?;
        client.check("the client's probe")?;
        if (truth.width, truth.height) != (client.width, client.height) {
            let [truth, got] = [truth, client].map(|probe| [probe.width, probe.height]);
            return Err(MetricsError::Extents { name: "the client's probe", truth, got });
        }
        Ok(Self::between(truth, client, mask))
    }

    /// What is missing of the pixels in the mask, all of which show geometry: all, where the client had no bundle.
    fn over(view: &View<'_>, mask: &[bool]) -> Self {
        match view.client_probe {
            Some(client) => Self::between(view.truth_probe, client, mask),
            None if count(mask) > 0 => Self { strict: 1.0, beyond_outlines: 1.0 },
            None => Self::default(),
        }
    }

    fn between(truth: &ProbeView, client: &ProbeView, mask: &[bool]) -> Self {
        let holes: Vec<usize> =
            (0..mask.len()).filter(|&at| mask[at] && is_hole(truth, client, at)).collect();
        let beyond = holes.iter().filter(|&&at| !is_shifted_outline(truth, client, at)).count();
        let share = |part: usize| part as f64 / count(mask).max(1) as f64;
        Self { strict: share(holes.len()), beyond_outlines: share(beyond) }
    }
}

/// The client's picture with the truth's pixels at the outlines of both, and where something is missing: what it would be if
/// surfaces ended where they should.
pub fn with_true_outlines(view: &View<'_>) -> Result<Rgb8Image, MetricsError> {
    check_extents(view)?;
    let mut picture = view.client.clone();
    let Some(client) = view.client_probe else { return Ok(picture) };
    let truth = view.truth_probe;
    let pixels = picture.data.chunks_exact_mut(3).zip(view.truth.data.chunks_exact(3));
    for (at, (shown, true_pixel)) in pixels.enumerate() {
        if truth.is_outline(at) || client.is_outline(at) || is_hole(truth, client, at) {
            shown.copy_from_slice(true_pixel);
        }
    }
    Ok(picture)
}

/// The share of the truth's geometry that is missing in the client's view, 0 to 1.
pub fn hole_fraction(truth: &ProbeView, client: &ProbeView) -> Result<f64, MetricsError> {
    Holes::measure(truth, client).map(|holes| holes.strict)
}

fn is_hole(truth: &ProbeView, client: &ProbeView, at: usize) -> bool {
    truth.instance[at] != ProbeView::BACKGROUND && !truth.is_shown_by(at, client, at)
}

/// Whether an outline of the truth passes here, and one side shows within a pixel what the other shows here.
/// A crack inside a surface is no outline of the truth, so it stays a hole.
fn is_shifted_outline(truth: &ProbeView, client: &ProbeView, at: usize) -> bool {
    truth.is_silhouette(at)
        && truth
            .neighbourhood(at)
            .any(|near| truth.is_shown_by(at, client, near) || truth.is_shown_by(near, client, at))
}

/// Two pictures and a mask that are formulas, so that reference tools can be given the very same.
#[cfg(test)]
pub(crate) mod known {
    use super::*;

    pub const WIDTH: u32 = 64;
    pub const HEIGHT: u32 = 48;

    /// Gradients in red and green, a chequerboard of 8 pixels in blue.
    pub fn truth() -> Rgb8Image {
        let pixel = |x, y| {
            let blue = if (x / 8 + y / 8) % 2 == 1 { 200 } else { 40 };
            [(4 * x) as u8, (255 - 5 * y) as u8, blue]
        };
        Rgb8Image::from_fn(WIDTH, HEIGHT, pixel).expect("a small picture")
    }

    /// The truth shifted by one pixel, with less red, and a pattern added to green and taken from blue.
    pub fn client() -> Rgb8Image {
        let truth = truth();
        let pixel = |x: u32, y: u32| {
            let [r, g, b] = truth.pixel((x + 1).min(WIDTH - 1), y).map(u32::from);
            let noise = (7 * x + 13 * y) % 17;
            [(r * 9 / 10) as u8, (g + noise).min(255) as u8, b.saturating_sub(2 * noise) as u8]
        };
        Rgb8Image::from_fn(WIDTH, HEIGHT, pixel).expect("a small picture")
    }

    /// A disc of 20 pixels around (32, 24), 2 m away: 1245 pixels, 40.5 %.
    pub fn probe() -> ProbeView {
        let inside = |at: u32| (at % WIDTH).abs_diff(32).pow(2) + (at / WIDTH).abs_diff(24).pow(2) < 400;
        let pixels = 0..WIDTH * HEIGHT;
        let instance = pixels.clone().map(|at| if inside(at) { 7 } else { ProbeView::BACKGROUND }).collect();
        let depth_m = pixels.map(|at| if inside(at) { 2.0 } else { f32::INFINITY }).collect();
        ProbeView { width: WIDTH, height: HEIGHT, instance, depth_m }
    }
}

#[cfg(test)]
mod tests;
