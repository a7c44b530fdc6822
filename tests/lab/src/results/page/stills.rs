//! Pictures on the page: stills of each way beside the truth, with a slider and an error map; or the README's picture.
//!
//! Files enter, HTML with the pictures in it leaves. Nothing here knows figures.

use crate::image::{ImageError, Rgb8Image};
use crate::measure::flip::{DEFAULT_PIXELS_PER_DEGREE, flip_map};
use crate::report::page::escaped;
use anyhow::{Context, ensure};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Sides of the part in the middle that is shown, the largest that fits; pixels.
const SIDES: [u32; 6] = [512, 400, 320, 256, 192, 128];
/// Bytes that all stills together may take in the page.
const MOST_BYTES: usize = 1_000_000;
/// Pixels that the README's picture is wide at most.
const FIRST_WIDTH: u32 = 912;

/// A client's picture, and the truth for its pose and time.
struct Pair {
    way: String,
    client: Rgb8Image,
    truth: Rgb8Image,
}

/// Stills of a folder with pictures of `run --dump-every`, or with such a folder for each way.
///
/// # Errors
/// There are no pairs of pictures, or one cannot be read.
pub(super) fn stills(folder: &Path) -> anyhow::Result<String> {
    let pairs = pairs(folder)?;
    ensure!(
        !pairs.is_empty(),
        "no client-NNNNNN-left.png beside truth-NNNNNN-left.png in {} or its folders: make them with run --dump-every",
        folder.display()
    );
    for side in SIDES {
        let html =
            pairs.iter().map(|pair| pair.html(side)).collect::<Result<String, png::EncodingError>>()?;
        if html.len() <= MOST_BYTES || side == SIDES[SIDES.len() - 1] {
            return Ok(format!("<div class=\"stills\">\n{html}</div>\n"));
        }
    }
    Ok(String::new())
}

/// The README's picture, as wide as the page needs it; nothing where it is not there.
///
/// # Errors
/// It is no picture.
pub(super) fn first_picture(path: &Path) -> anyhow::Result<String> {
    if !path.exists() {
        return Ok(String::new());
    }
    let picture = Rgb8Image::read_png(path)?;
    let height = (picture.height * FIRST_WIDTH / picture.width.max(1)).max(1);
    let picture =
        if picture.width > FIRST_WIDTH { smaller(&picture, [FIRST_WIDTH, height])? } else { picture };
    Ok(format!(
        "<figure><img class=\"whole\" src=\"{}\" alt=\"Dragons in a courtyard at evening\"><figcaption>A generated courtyard, as the client \
         drew it over a simulated link of 20 +- 10 ms.</figcaption></figure>\n",
        data(&picture)?
    ))
}

fn pairs(folder: &Path) -> anyhow::Result<Vec<Pair>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("reading {}", folder.display()))?;
    let mut ways: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(|path| path.is_dir()).collect();
    ways.sort();
    ways.insert(0, folder.to_owned());
    let moments: Vec<(PathBuf, BTreeSet<String>)> = ways
        .into_iter()
        .map(|way| (way.clone(), moments(&way)))
        .filter(|(_, found)| !found.is_empty())
        .collect();
    let shared = moments.iter().map(|(_, found)| found.clone()).reduce(|all, found| &all & &found);
    let shared = shared.and_then(|shared| shared.last().cloned());
    let pair = |(way, found): &(PathBuf, BTreeSet<String>)| -> anyhow::Result<Pair> {
        let moment = shared.as_ref().or(found.last()).context("a way has moments")?;
        let read = |kind: &str| Rgb8Image::read_png(&way.join(format!("{kind}-{moment}-left.png")));
        let name = if way == folder {
            "client".into()
        } else {
            way.file_name().unwrap_or_default().to_string_lossy()
        };
        let (client, truth) = (read("client")?, read("truth")?);
        ensure!(
            (client.width, client.height) == (truth.width, truth.height),
            "{}: client and truth have different extents",
            way.display()
        );
        Ok(Pair { way: name.into_owned(), client, truth })
    };
    moments.iter().map(pair).collect()
}

/// Numbers of display frames of which both pictures are there.
fn moments(folder: &Path) -> BTreeSet<String> {
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let names = files.filter_map(|file| file.file_name().into_string().ok());
    let moments =
        names.filter_map(|name| Some(name.strip_prefix("client-")?.strip_suffix("-left.png")?.to_owned()));
    moments.filter(|moment| folder.join(format!("truth-{moment}-left.png")).exists()).collect()
}

impl Pair {
    /// The middle of both, with a slider, and how visible the difference is.
    fn html(&self, side: u32) -> Result<String, png::EncodingError> {
        let (client, truth) = (middle(&self.client, side), middle(&self.truth, side));
        let map = flip_map(&truth, &client, DEFAULT_PIXELS_PER_DEGREE);
        let mean = map.iter().map(|error| f64::from(*error)).sum::<f64>() / map.len().max(1) as f64;
        let errors =
            Rgb8Image { data: map.iter().flat_map(|error| heat(*error)).collect(), ..client.clone() };
        let way = escaped(&self.way);
        Ok(format!(
            "<figure><div class=\"pair\"><img src=\"{}\" alt=\"Ground truth of {way}\"><img class=\"top\" src=\"{}\" alt=\"Picture of {way}\"></div>\
             <input type=\"range\" min=\"0\" max=\"100\" value=\"50\" aria-label=\"Share of the picture of {way}, the rest is truth, percent\">\
             <div class=\"ends\"><span>all truth</span><span>all {way}</span></div>\
             <img class=\"whole\" src=\"{}\" alt=\"Error map of {way}\">\
             <figcaption>{way}: picture beside truth, and its error map; black is none, white is largest. FLIP of this part: {mean:.3}.\
             </figcaption></figure>\n",
            data(&truth)?,
            data(&client)?,
            data(&errors)?
        ))
    }
}

/// Black, red, yellow, white.
fn heat(error: f32) -> [u8; 3] {
    let level = |from: f32| ((error.clamp(0.0, 1.0) * 3.0 - from).clamp(0.0, 1.0) * 255.0) as u8;
    [level(0.0), level(1.0), level(2.0)]
}

/// The middle, at most so many pixels wide and high.
fn middle(image: &Rgb8Image, side: u32) -> Rgb8Image {
    let (width, height) = (image.width.min(side), image.height.min(side));
    let (left, top) = ((image.width - width) / 2, (image.height - height) / 2);
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    Rgb8Image { width, height, data: pixels.flat_map(|(x, y)| image.pixel(left + x, top + y)).collect() }
}

/// With fewer pixels, each the mean of the bytes below it.
fn smaller(image: &Rgb8Image, [width, height]: [u32; 2]) -> Result<Rgb8Image, ImageError> {
    let below = |at: u32, count: u32, all: u32| (at * all / count)..((at + 1) * all).div_ceil(count).min(all);
    Rgb8Image::from_fn(width, height, |x, y| {
        let (mut sum, mut count) = ([0u32; 3], 0);
        for row in below(y, height, image.height) {
            for column in below(x, width, image.width) {
                for (sum, byte) in sum.iter_mut().zip(image.pixel(column, row)) {
                    *sum += u32::from(byte);
                }
                count += 1;
            }
        }
        sum.map(|sum| (sum / count) as u8)
    })
}

/// A picture as text within the page.
fn data(image: &Rgb8Image) -> Result<String, png::EncodingError> {
    Ok(format!("data:image/png;base64,{}", STANDARD.encode(image.png()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(folder: &Path, way: &str, moment: u32, grey: u8) {
        let folder = folder.join(way);
        std::fs::create_dir_all(&folder).expect("a folder");
        for (kind, grey) in [("client", grey), ("truth", 128)] {
            let picture = Rgb8Image::filled(40, 30, [grey; 3]).expect("a picture");
            picture.write_png(&folder.join(format!("{kind}-{moment:06}-left.png"))).expect("written");
        }
    }

    #[test]
    fn each_way_has_a_pair_and_an_error_map() {
        let folder = tempfile::tempdir().expect("a folder");
        write(folder.path(), "atlas", 24, 128);
        write(folder.path(), "video <b>", 24, 0);
        write(folder.path(), "video <b>", 48, 255);
        let html = stills(folder.path()).expect("stills");
        assert_eq!(html.matches("<figure>").count(), 2, "{html}");
        assert_eq!(html.matches("data:image/png;base64,").count(), 6);
        assert!(html.contains("FLIP of this part: 0.000") && html.contains("all video &lt;b&gt;"), "{html}");
    }

    #[test]
    fn a_folder_without_pictures_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = stills(folder.path()).expect_err("it is empty").to_string();
        assert!(error.contains("--dump-every"), "{error}");
        assert_eq!(first_picture(&folder.path().join("none.png")).expect("no picture"), "");
    }

    #[test]
    fn the_larger_picture_is_made_smaller_by_means() {
        let picture = Rgb8Image::from_fn(4, 2, |x, _| [if x < 2 { 0 } else { 200 }; 3]).expect("a picture");
        let small = smaller(&picture, [2, 1]).expect("a picture");
        assert_eq!(small.data, [0, 0, 0, 200, 200, 200]);
        assert_eq!(middle(&picture, 2).data, [[0u8; 3], [200; 3]].concat().repeat(2));
    }

    #[test]
    fn error_maps_go_from_black_to_white() {
        assert_eq!([heat(0.0), heat(1.0)], [[0; 3], [255; 3]]);
        assert!(heat(0.2)[0] > 100 && heat(0.2)[2] == 0);
    }
}
