//! A contact sheet: everything that a run shows, titled, in one picture.
//!
//! Made for looking, not for measuring: thumbnails are averages of sRGB bytes, and the font knows capitals only.

use crate::image::{ImageError, Rgb8Image};

const BACKGROUND: [u8; 3] = [24, 24, 28];
const TEXT: [u8; 3] = [235, 235, 235];
const MARGIN_PIXELS: u32 = 12;
/// Pixels of the sheet for one of the font.
const TEXT_SCALE: u32 = 2;
const GLYPH_WIDTH: u32 = 5;
const GLYPH_HEIGHT: u32 = 7;
/// What a line of text takes, with the space below it.
const LINE_PIXELS: u32 = (GLYPH_HEIGHT + 3) * TEXT_SCALE;

/// Titled pictures in a grid, filled row by row.
#[derive(Clone, Debug)]
pub struct Sheet {
    title: String,
    columns: u32,
    cell_extent_pixels: [u32; 2],
    cells: Vec<(String, Rgb8Image)>,
}

impl Sheet {
    /// An empty sheet of so many columns (at least 1), with room for pictures of `cell_extent_pixels` each.
    pub fn new(title: &str, columns: u32, cell_extent_pixels: [u32; 2]) -> Self {
        Self { title: title.to_owned(), columns: columns.max(1), cell_extent_pixels, cells: Vec::new() }
    }

    /// Adds a picture in the next cell, made smaller if it does not fit.
    pub fn add(&mut self, title: &str, image: &Rgb8Image) -> Result<(), ImageError> {
        let thumbnail = thumbnail(image, self.cell_extent_pixels)?;
        self.cells.push((title.to_owned(), thumbnail));
        Ok(())
    }

    /// Leaves the next cell empty.
    pub fn skip(&mut self) {
        let nothing = Rgb8Image { width: 0, height: 0, data: Vec::new() };
        self.cells.push((String::new(), nothing));
    }

    /// Draws the sheet.
    pub fn render(&self) -> Result<Rgb8Image, ImageError> {
        let rows = (self.cells.len() as u32).div_ceil(self.columns);
        let [pitch_x, pitch_y] = self.pitch_pixels();
        let width = MARGIN_PIXELS.saturating_add(pitch_x.saturating_mul(self.columns));
        let top = MARGIN_PIXELS + LINE_PIXELS;
        let height = top.saturating_add(pitch_y.saturating_mul(rows)).saturating_add(MARGIN_PIXELS);
        let mut sheet = Rgb8Image::filled(width, height, BACKGROUND)?;
        draw_text(&mut sheet, MARGIN_PIXELS, MARGIN_PIXELS, &self.title);
        for (at, (title, image)) in (0u32..).zip(&self.cells) {
            let left = MARGIN_PIXELS + at % self.columns * pitch_x;
            let top = top + at / self.columns * pitch_y;
            draw_text(&mut sheet, left, top, &shortened(title, self.cell_extent_pixels[0]));
            draw_image(&mut sheet, left, top + LINE_PIXELS, image);
        }
        Ok(sheet)
    }

    /// The distance between two cells.
    fn pitch_pixels(&self) -> [u32; 2] {
        let [width, height] = self.cell_extent_pixels;
        [width.saturating_add(MARGIN_PIXELS), height.saturating_add(LINE_PIXELS + MARGIN_PIXELS)]
    }
}

/// Where two pictures of one extent differ: the difference of every channel, `gain` times as bright.
pub fn difference(a: &Rgb8Image, b: &Rgb8Image, gain: f32) -> Rgb8Image {
    assert_eq!((a.width, a.height), (b.width, b.height), "pictures to compare have one extent");
    let amplified = |(&a, &b): (&u8, &u8)| (f32::from(a.abs_diff(b)) * gain).round().min(255.0) as u8;
    let data = a.data.iter().zip(&b.data).map(amplified).collect();
    Rgb8Image { width: a.width, height: a.height, data }
}

/// The picture in its own proportions, as large as fits, but never larger than it is.
fn thumbnail(image: &Rgb8Image, [width, height]: [u32; 2]) -> Result<Rgb8Image, ImageError> {
    let scale = (f64::from(width) / f64::from(image.width)).min(f64::from(height) / f64::from(image.height));
    if scale >= 1.0 {
        return Ok(image.clone());
    }
    let scaled = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    shrink(image, scaled(image.width), scaled(image.height))
}

/// Scales a picture down: every pixel is the average of the area that it covers.
pub fn shrink(image: &Rgb8Image, width: u32, height: u32) -> Result<Rgb8Image, ImageError> {
    let columns: Vec<_> = (0..width).map(|x| covered(x, width, image.width)).collect();
    let rows: Vec<_> = (0..height).map(|y| covered(y, height, image.height)).collect();
    Rgb8Image::from_fn(width, height, |x, y| average(image, &columns[x as usize], &rows[y as usize]))
}

/// The source pixels below one pixel of the result, and how much of each lies below it.
fn covered(at: u32, length: u32, source_length: u32) -> Vec<(u32, f64)> {
    let edge = |at: u32| f64::from(at) * f64::from(source_length) / f64::from(length);
    let (from, to) = (edge(at), edge(at + 1));
    let last = (to.ceil() as u32).min(source_length);
    let weight = |pixel: u32| (to.min(f64::from(pixel + 1)) - from.max(f64::from(pixel))).max(0.0);
    (from.floor() as u32..last).map(|pixel| (pixel, weight(pixel))).collect()
}

fn average(image: &Rgb8Image, columns: &[(u32, f64)], rows: &[(u32, f64)]) -> [u8; 3] {
    let (mut sums, mut total) = ([0.0; 3], 0.0);
    for &(y, weight_y) in rows {
        for &(x, weight_x) in columns {
            let weight = weight_x * weight_y;
            total += weight;
            for (sum, byte) in sums.iter_mut().zip(image.pixel(x, y)) {
                *sum += weight * f64::from(byte);
            }
        }
    }
    sums.map(|sum: f64| (sum / total).round() as u8)
}

fn draw_image(sheet: &mut Rgb8Image, left: u32, top: u32, image: &Rgb8Image) {
    for y in 0..image.height {
        for x in 0..image.width {
            sheet.set_pixel(left + x, top + y, image.pixel(x, y));
        }
    }
}

/// As much of a title as fits beside the next one.
fn shortened(title: &str, width_pixels: u32) -> String {
    let most = width_pixels / ((GLYPH_WIDTH + 1) * TEXT_SCALE);
    title.chars().take(most as usize).collect()
}

/// Draws a line of text; what does not fit on the sheet is cut off.
fn draw_text(sheet: &mut Rgb8Image, left: u32, top: u32, text: &str) {
    for (at, character) in (0u32..).zip(text.chars()) {
        let left = left + at * (GLYPH_WIDTH + 1) * TEXT_SCALE;
        for (y, row) in (0u32..).zip(glyph(character)) {
            for x in (0..GLYPH_WIDTH).filter(|x| row >> (GLYPH_WIDTH - 1 - x) & 1 == 1) {
                draw_dot(sheet, left + x * TEXT_SCALE, top + y * TEXT_SCALE);
            }
        }
    }
}

fn draw_dot(sheet: &mut Rgb8Image, left: u32, top: u32) {
    for y in top..(top + TEXT_SCALE).min(sheet.height) {
        for x in left..(left + TEXT_SCALE).min(sheet.width) {
            sheet.set_pixel(x, y, TEXT);
        }
    }
}

/// Seven rows of five pixels, the leftmost in the highest bit. Unknown characters show as a question mark.
fn glyph(character: char) -> [u8; GLYPH_HEIGHT as usize] {
    let capital = character.to_ascii_uppercase();
    let find = |wanted: char| FONT.iter().find(|(known, _)| *known == wanted).map(|(_, rows)| *rows);
    match capital {
        ' ' => [0; GLYPH_HEIGHT as usize],
        _ => find(capital).or_else(|| find('?')).unwrap_or_default(),
    }
}

/// Our own letters, five by seven.
#[rustfmt::skip]
const FONT: &[(char, [u8; GLYPH_HEIGHT as usize])] = &[
    ('!', [0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00000, 0b00100]),
    ('#', [0b01010, 0b01010, 0b11111, 0b01010, 0b11111, 0b01010, 0b01010]),
    ('%', [0b11000, 0b11001, 0b00010, 0b00100, 0b01000, 0b10011, 0b00011]),
    ('\'', [0b00100, 0b00100, 0b01000, 0b00000, 0b00000, 0b00000, 0b00000]),
    ('(', [0b00010, 0b00100, 0b01000, 0b01000, 0b01000, 0b00100, 0b00010]),
    (')', [0b01000, 0b00100, 0b00010, 0b00010, 0b00010, 0b00100, 0b01000]),
    ('*', [0b00000, 0b10101, 0b01110, 0b11111, 0b01110, 0b10101, 0b00000]),
    ('+', [0b00000, 0b00100, 0b00100, 0b11111, 0b00100, 0b00100, 0b00000]),
    (',', [0b00000, 0b00000, 0b00000, 0b00000, 0b01100, 0b00100, 0b01000]),
    ('-', [0b00000, 0b00000, 0b00000, 0b11111, 0b00000, 0b00000, 0b00000]),
    ('.', [0b00000, 0b00000, 0b00000, 0b00000, 0b00000, 0b01100, 0b01100]),
    ('/', [0b00001, 0b00001, 0b00010, 0b00100, 0b01000, 0b10000, 0b10000]),
    ('0', [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110]),
    ('1', [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110]),
    ('2', [0b01110, 0b10001, 0b00001, 0b00010, 0b00100, 0b01000, 0b11111]),
    ('3', [0b01110, 0b10001, 0b00001, 0b00110, 0b00001, 0b10001, 0b01110]),
    ('4', [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010]),
    ('5', [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110]),
    ('6', [0b01110, 0b10000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110]),
    ('7', [0b11111, 0b00001, 0b00010, 0b00100, 0b00100, 0b01000, 0b01000]),
    ('8', [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110]),
    ('9', [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00001, 0b01110]),
    (':', [0b00000, 0b01100, 0b01100, 0b00000, 0b01100, 0b01100, 0b00000]),
    ('<', [0b00010, 0b00100, 0b01000, 0b10000, 0b01000, 0b00100, 0b00010]),
    ('=', [0b00000, 0b00000, 0b11111, 0b00000, 0b11111, 0b00000, 0b00000]),
    ('>', [0b01000, 0b00100, 0b00010, 0b00001, 0b00010, 0b00100, 0b01000]),
    ('?', [0b01110, 0b10001, 0b00001, 0b00010, 0b00100, 0b00000, 0b00100]),
    ('A', [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001]),
    ('B', [0b11110, 0b10001, 0b10001, 0b11110, 0b10001, 0b10001, 0b11110]),
    ('C', [0b01110, 0b10001, 0b10000, 0b10000, 0b10000, 0b10001, 0b01110]),
    ('D', [0b11110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b11110]),
    ('E', [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b11111]),
    ('F', [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b10000]),
    ('G', [0b01110, 0b10001, 0b10000, 0b10111, 0b10001, 0b10001, 0b01111]),
    ('H', [0b10001, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001]),
    ('I', [0b01110, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110]),
    ('J', [0b00111, 0b00010, 0b00010, 0b00010, 0b00010, 0b10010, 0b01100]),
    ('K', [0b10001, 0b10010, 0b10100, 0b11000, 0b10100, 0b10010, 0b10001]),
    ('L', [0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b11111]),
    ('M', [0b10001, 0b11011, 0b10101, 0b10101, 0b10001, 0b10001, 0b10001]),
    ('N', [0b10001, 0b11001, 0b11001, 0b10101, 0b10011, 0b10011, 0b10001]),
    ('O', [0b01110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110]),
    ('P', [0b11110, 0b10001, 0b10001, 0b11110, 0b10000, 0b10000, 0b10000]),
    ('Q', [0b01110, 0b10001, 0b10001, 0b10001, 0b10101, 0b10010, 0b01101]),
    ('R', [0b11110, 0b10001, 0b10001, 0b11110, 0b10100, 0b10010, 0b10001]),
    ('S', [0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110]),
    ('T', [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100]),
    ('U', [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110]),
    ('V', [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01010, 0b00100]),
    ('W', [0b10001, 0b10001, 0b10001, 0b10101, 0b10101, 0b11011, 0b10001]),
    ('X', [0b10001, 0b10001, 0b01010, 0b00100, 0b01010, 0b10001, 0b10001]),
    ('Y', [0b10001, 0b10001, 0b01010, 0b00100, 0b00100, 0b00100, 0b00100]),
    ('Z', [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b10000, 0b11111]),
    ('_', [0b00000, 0b00000, 0b00000, 0b00000, 0b00000, 0b00000, 0b11111]),
];

#[cfg(test)]
mod tests {
    use super::*;

    fn chequers(width: u32, height: u32) -> Rgb8Image {
        Rgb8Image::from_fn(width, height, |x, y| [if (x + y) % 2 == 0 { 200 } else { 100 }; 3])
            .expect("a picture")
    }

    #[test]
    fn difference_is_amplified_and_saturates() {
        let a = Rgb8Image::new(2, 1, vec![10, 20, 30, 0, 255, 7]).expect("a small picture");
        let b = Rgb8Image::new(2, 1, vec![12, 15, 30, 255, 0, 7]).expect("a small picture");
        assert_eq!(difference(&a, &b, 8.0).data, [16, 40, 0, 255, 255, 0]);
        assert_eq!(difference(&a, &b, 8.0), difference(&b, &a, 8.0));
    }

    #[test]
    fn shrinking_averages_what_a_pixel_covers() {
        let small = shrink(&chequers(8, 8), 4, 4).expect("a small picture");
        assert!(small.data.iter().all(|&byte| byte == 150), "{:?}", small.data);
        let thirds = Rgb8Image::new(3, 1, [[0; 3], [90; 3], [30; 3]].concat()).expect("a small picture");
        // The middle pixel is shared: (0 + 90 / 2) / 1.5 and (90 / 2 + 30) / 1.5.
        assert_eq!(shrink(&thirds, 2, 1).expect("a small picture").data, [30, 30, 30, 50, 50, 50]);
    }

    #[test]
    fn thumbnails_keep_proportions_and_never_grow() {
        let wide = thumbnail(&chequers(400, 100), [200, 200]).expect("a small picture");
        assert_eq!((wide.width, wide.height), (200, 50));
        assert_eq!(thumbnail(&chequers(20, 10), [200, 200]).expect("a small picture"), chequers(20, 10));
        let thin = thumbnail(&chequers(400, 1), [20, 20]).expect("a small picture");
        assert_eq!((thin.width, thin.height), (20, 1));
    }

    #[test]
    fn pictures_stand_below_their_titles_in_rows() {
        let mut sheet = Sheet::new("run", 2, [32, 16]);
        for (title, grey) in [("a", 60), ("b", 90), ("c", 120)] {
            sheet.add(title, &Rgb8Image::filled(32, 16, [grey; 3]).expect("a picture")).expect("it fits");
        }
        let drawn = sheet.render().expect("a small sheet");
        let [pitch_x, pitch_y] = sheet.pitch_pixels();
        assert_eq!([drawn.width, drawn.height], [12 + 2 * pitch_x, 12 + LINE_PIXELS + 2 * pitch_y + 12]);
        let (left, top) = (MARGIN_PIXELS, MARGIN_PIXELS + 2 * LINE_PIXELS);
        assert_eq!(drawn.pixel(left, top), [60; 3]);
        assert_eq!(drawn.pixel(left + pitch_x + 31, top + 15), [90; 3]);
        assert_eq!(drawn.pixel(left, top + pitch_y), [120; 3]);
        assert_eq!(drawn.pixel(left + pitch_x, top + pitch_y), BACKGROUND);
        assert!(drawn.data.chunks_exact(3).any(|pixel| pixel == TEXT));
    }

    #[test]
    fn a_skipped_cell_stays_empty() {
        let mut sheet = Sheet::new("", 2, [32, 16]);
        sheet.skip();
        sheet.add("", &Rgb8Image::filled(32, 16, [60; 3]).expect("a picture")).expect("it fits");
        let drawn = sheet.render().expect("a small sheet");
        let (left, top) = (MARGIN_PIXELS, MARGIN_PIXELS + 2 * LINE_PIXELS);
        assert_eq!(drawn.pixel(left, top), BACKGROUND);
        assert_eq!(drawn.pixel(left + sheet.pitch_pixels()[0], top), [60; 3]);
    }

    #[test]
    fn long_titles_are_cut_not_drawn_over_others() {
        let mut sheet = Sheet::new(&"x".repeat(500), 1, [24, 16]);
        sheet.add(&"y".repeat(500), &chequers(24, 16)).expect("it fits");
        sheet.render().expect("a small sheet");
        assert_eq!(shortened("abcdef", 24), "ab");
    }

    #[test]
    fn every_character_of_the_titles_has_a_glyph_of_its_own() {
        let known = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.,:-+/%()=_#!'*<>";
        let glyphs: Vec<_> = known.chars().map(glyph).collect();
        for (at, rows) in glyphs.iter().enumerate() {
            assert!(!glyphs[..at].contains(rows) && *rows != glyph('?'), "{:?}", known.chars().nth(at));
            assert!(rows.iter().all(|row| *row < 32));
        }
        assert_eq!(glyph('a'), glyph('A'));
        assert_eq!(glyph('\u{2603}'), glyph('?'));
    }
}
