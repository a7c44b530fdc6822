//! The launcher's icon: two lenses, and in them a textured and lit triangle. It is drawn here and committed as files. This test
//! compares the files with the drawing. Rewrite the files after a change of the drawing: `SHADECAST_WRITE_ICON=1 cargo test -p
//! shadecast-android --test icon`.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::{Path, PathBuf};

/// Folders of Android's densities, and the pixels of an icon's side in each.
const DENSITIES: [(&str, u32); 5] =
    [("mdpi", 48), ("hdpi", 72), ("xhdpi", 96), ("xxhdpi", 144), ("xxxhdpi", 192)];
/// Samples of a pixel, along each axis.
const SAMPLES: u32 = 8;
/// How far a colour's level may be off: floating point is not the same everywhere.
const TOLERANCE: u8 = 2;

/// The middles of both lenses; the icon is the unit square, its origin the upper left.
const LENSES: [[f32; 2]; 2] = [[0.355, 0.5], [0.645, 0.5]];
const LENS_RADIUS: f32 = 0.25;
const RIM: f32 = 0.03;
/// Half the side of the square behind them, and the radius of its corners.
const PLATE: [f32; 2] = [0.47, 0.12];
/// Apex, left and right foot.
const TRIANGLE: [[f32; 2]; 3] = [[0.5, 0.32], [0.19, 0.66], [0.81, 0.66]];
/// Fields of the triangle's texture along its base.
const FIELDS: f32 = 6.0;

const PLATE_COLOUR: [f32; 3] = [0.07, 0.10, 0.15];
const GLASS_COLOUR: [f32; 3] = [0.13, 0.21, 0.30];
const RIM_COLOUR: [f32; 3] = [0.62, 0.74, 0.84];
/// The texture's two colours.
const FIELD_COLOURS: [[f32; 3]; 2] = [[1.0, 0.70, 0.24], [0.87, 0.36, 0.22]];

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Inside of the plate; negative is inside.
fn plate(at: [f32; 2]) -> f32 {
    let [half, radius] = PLATE;
    let beyond = at.map(|x| ((x - 0.5).abs() - (half - radius)).max(0.0));
    beyond[0].hypot(beyond[1]) - radius
}

/// The weights of the triangle's corners, if it is there.
fn weights(at: [f32; 2]) -> Option<[f32; 3]> {
    let [a, b, c] = TRIANGLE;
    let area =
        |p: [f32; 2], q: [f32; 2], r: [f32; 2]| (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1]);
    let whole = area(a, b, c);
    let weights = [area(at, b, c), area(a, at, c), area(a, b, at)].map(|part| part / whole);
    weights.iter().all(|weight| *weight >= 0.0).then_some(weights)
}

/// Texture times light, which comes from the upper left.
fn surface([_, left, right]: [f32; 3]) -> [f32; 3] {
    let field = (left * FIELDS).floor() + (right * FIELDS).floor();
    let light = 1.0 - 0.62 * right;
    FIELD_COLOURS[usize::from(field.rem_euclid(2.0) > 0.5)].map(|level| level * light)
}

/// Colour at a place; `None` beside the icon.
fn colour(at: [f32; 2]) -> Option<[f32; 3]> {
    if plate(at) > 0.0 {
        return None;
    }
    let from_lenses = LENSES.map(|lens| distance(at, lens) - LENS_RADIUS);
    let nearest = from_lenses[0].min(from_lenses[1]);
    if nearest > RIM {
        return Some(PLATE_COLOUR);
    }
    // Where the lenses overlap both rims are seen.
    if from_lenses.iter().any(|lens| (0.0..RIM).contains(lens)) && nearest > -2.0 * RIM {
        return Some(RIM_COLOUR);
    }
    Some(weights(at).map_or(GLASS_COLOUR, surface))
}

/// An icon of so many pixels a side: RGBA, row by row.
fn drawn(side: u32) -> Vec<u8> {
    let mut pixels = Vec::new();
    for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
        let mut sum = [0.0_f32; 4];
        for (v, u) in (0..SAMPLES).flat_map(|v| (0..SAMPLES).map(move |u| (v, u))) {
            let place = |pixel: u32, sample: u32| {
                (pixel as f32 + (sample as f32 + 0.5) / SAMPLES as f32) / side as f32
            };
            let Some([r, g, b]) = colour([place(x, u), place(y, v)]) else { continue };
            sum = std::array::from_fn(|channel| sum[channel] + [r, g, b, 1.0][channel]);
        }
        let covered = sum[3].max(1.0);
        let alpha = sum[3] / (SAMPLES * SAMPLES) as f32;
        let levels = [sum[0] / covered, sum[1] / covered, sum[2] / covered, alpha];
        pixels.extend(levels.map(|level| (level * 255.0).round() as u8));
    }
    pixels
}

fn path(density: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("res/mipmap-{density}/ic_launcher.png"))
}

fn write(path: &Path, side: u32) {
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("the folder is made");
    let file = BufWriter::new(File::create(path).expect("the file is made"));
    let mut encoder = png::Encoder::new(file, side, side);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header().expect("a header is written");
    writer.write_image_data(&drawn(side)).expect("pixels are written");
}

#[test]
fn the_launchers_icons_are_those_that_are_drawn() {
    for (density, side) in DENSITIES {
        let path = path(density);
        if std::env::var_os("SHADECAST_WRITE_ICON").is_some() {
            write(&path, side);
        }
        let file = File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let mut reader = png::Decoder::new(BufReader::new(file)).read_info().expect("a PNG file");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let info = reader.next_frame(&mut pixels).expect("a picture");
        let is = (info.width, info.height, info.color_type, info.bit_depth);
        assert_eq!(is, (side, side, png::ColorType::Rgba, png::BitDepth::Eight), "{}", path.display());
        let off = pixels.iter().zip(drawn(side)).map(|(is, wanted)| is.abs_diff(wanted)).max();
        assert!(off <= Some(TOLERANCE), "{}: off by {off:?}; see the top of this test", path.display());
    }
}
