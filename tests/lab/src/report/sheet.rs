//! A contact sheet: all pictures of a run, captioned, in one picture, with its figures below.
//!
//! It is for viewing, not for measuring: thumbnails are averages of sRGB bytes.

use super::typeface::{Typeface, WIDEST_GLYPH_EM};
use crate::image::{ImageError, Rgb8Image};

const BACKGROUND: [u8; 3] = [24, 24, 28];
const TEXT: [u8; 3] = [235, 235, 235];
const QUIET_TEXT: [u8; 3] = [168, 170, 180];
const MARGIN_PIXELS: u32 = 16;
const TITLE_PIXELS: u32 = 30;
const HEADING_PIXELS: u32 = 21;
const CAPTION_PIXELS: u32 = 17;
const NOTE_PIXELS: u32 = 15;

/// Captioned pictures in sections, each a grid that is filled row by row.
#[derive(Clone, Debug)]
pub struct Sheet {
    title: String,
    columns: u32,
    cell_extent_pixels: [u32; 2],
    sections: Vec<Section>,
}

#[derive(Clone, Debug)]
struct Section {
    heading: String,
    note: String,
    cells: Vec<Cell>,
}

#[derive(Clone, Debug)]
struct Cell {
    caption: String,
    note: String,
    image: Rgb8Image,
}

/// One line of text of the sheet, where it begins.
#[derive(Clone, Debug, PartialEq)]
struct Line {
    left: u32,
    top: u32,
    pixels: u32,
    colour: [u8; 3],
    text: String,
}

/// Where everything stands.
#[derive(Clone, Debug, Default)]
struct Layout {
    lines: Vec<Line>,
    /// Section, cell, left and top.
    images: Vec<([usize; 2], [u32; 2])>,
    height: u32,
}

impl Sheet {
    /// An empty sheet of so many columns (at least 1), with room for pictures of `cell_extent_pixels` each.
    pub fn new(title: &str, columns: u32, cell_extent_pixels: [u32; 2]) -> Self {
        Self { title: title.to_owned(), columns: columns.max(1), cell_extent_pixels, sections: Vec::new() }
    }

    /// Begins a section: pictures that are added from now on stand below its heading and note.
    pub fn section(&mut self, heading: &str, note: &str) {
        self.sections.push(Section { heading: heading.into(), note: note.into(), cells: Vec::new() });
    }

    /// Adds a picture in the next cell, made smaller if it does not fit, with a caption above and a note below it.
    ///
    /// # Errors
    /// The picture is empty or too large.
    pub fn add(&mut self, caption: &str, image: &Rgb8Image, note: &str) -> Result<(), ImageError> {
        if self.sections.is_empty() {
            self.section("", "");
        }
        let image = thumbnail(image, self.cell_extent_pixels)?;
        if let Some(section) = self.sections.last_mut() {
            section.cells.push(Cell { caption: caption.into(), note: note.into(), image });
        }
        Ok(())
    }

    /// Draws the sheet.
    ///
    /// # Errors
    /// The sheet would be too large for a picture.
    pub fn render(&self) -> Result<Rgb8Image, ImageError> {
        let typeface = Typeface::new();
        let layout = self.layout(&typeface);
        let mut sheet = Rgb8Image::filled(self.width_pixels(), layout.height, BACKGROUND)?;
        for ([section, cell], at) in layout.images {
            draw_image(&mut sheet, at, &self.sections[section].cells[cell].image);
        }
        for line in layout.lines {
            typeface.draw(&mut sheet, [line.left, line.top], line.pixels, line.colour, &line.text);
        }
        Ok(sheet)
    }

    fn width_pixels(&self) -> u32 {
        MARGIN_PIXELS.saturating_add((self.cell_width() + MARGIN_PIXELS).saturating_mul(self.columns))
    }

    /// Wide enough for one letter at least.
    fn cell_width(&self) -> u32 {
        self.cell_extent_pixels[0].max((CAPTION_PIXELS as f32 * WIDEST_GLYPH_EM) as u32)
    }

    fn layout(&self, typeface: &Typeface) -> Layout {
        let mut layout = Layout { height: MARGIN_PIXELS, ..Layout::default() };
        let page = self.width_pixels() - 2 * MARGIN_PIXELS;
        layout.text(typeface, MARGIN_PIXELS, page, TITLE_PIXELS, TEXT, &self.title);
        for (number, section) in self.sections.iter().enumerate() {
            layout.text(typeface, MARGIN_PIXELS, page, HEADING_PIXELS, TEXT, &section.heading);
            layout.text(typeface, MARGIN_PIXELS, page, NOTE_PIXELS, QUIET_TEXT, &section.note);
            for (row, cells) in section.cells.chunks(self.columns as usize).enumerate() {
                layout.height += MARGIN_PIXELS / 2;
                self.row(typeface, &mut layout, cells, [number, row * self.columns as usize]);
            }
            layout.height += MARGIN_PIXELS;
        }
        layout
    }

    /// One row of cells: captions, pictures and notes each begin at one height.
    fn row(&self, typeface: &Typeface, layout: &mut Layout, cells: &[Cell], [section, first]: [usize; 2]) {
        let width = self.cell_width();
        let lefts: Vec<u32> =
            (0..cells.len() as u32).map(|column| MARGIN_PIXELS + column * (width + MARGIN_PIXELS)).collect();
        layout.side_by_side(cells.iter().zip(&lefts), |layout, (cell, left)| {
            layout.text(typeface, *left, width, CAPTION_PIXELS, TEXT, &cell.caption);
        });
        let top = layout.height;
        for (at, left) in lefts.iter().enumerate() {
            layout.images.push(([section, first + at], [*left, top]));
        }
        layout.height += cells.iter().map(|cell| cell.image.height).max().unwrap_or(0) + NOTE_PIXELS / 3;
        layout.side_by_side(cells.iter().zip(&lefts), |layout, (cell, left)| {
            layout.text(typeface, *left, width, NOTE_PIXELS, QUIET_TEXT, &cell.note);
        });
    }
}

impl Layout {
    /// Sets text below what is there, wrapped at spaces to `width` pixels; empty text takes no room.
    fn text(&mut self, typeface: &Typeface, left: u32, width: u32, pixels: u32, colour: [u8; 3], text: &str) {
        for line in typeface.wrap(text, pixels, width) {
            self.lines.push(Line { left, top: self.height, pixels, colour, text: line });
            self.height += pixels * 4 / 3;
        }
    }

    /// Sets every item from the same height on, and goes on below the longest.
    fn side_by_side<T>(&mut self, items: impl Iterator<Item = T>, mut set: impl FnMut(&mut Self, T)) {
        let (top, mut bottom) = (self.height, self.height);
        for item in items {
            self.height = top;
            set(self, item);
            bottom = bottom.max(self.height);
        }
        self.height = bottom;
    }
}

/// Where two pictures of one extent differ: the difference of every channel, `gain` times as bright.
pub fn difference(a: &Rgb8Image, b: &Rgb8Image, gain: f32) -> Rgb8Image {
    assert_eq!((a.width, a.height), (b.width, b.height), "pictures to compare have one extent");
    let amplified = |(&a, &b): (&u8, &u8)| (f32::from(a.abs_diff(b)) * gain).round().min(255.0) as u8;
    let data = a.data.iter().zip(&b.data).map(amplified).collect();
    Rgb8Image { width: a.width, height: a.height, data }
}

/// The picture in its own proportions, as large as fits; what is small grows by whole numbers only, pixel by pixel.
fn thumbnail(image: &Rgb8Image, [width, height]: [u32; 2]) -> Result<Rgb8Image, ImageError> {
    let scale = (f64::from(width) / f64::from(image.width)).min(f64::from(height) / f64::from(image.height));
    if scale >= 1.0 {
        return enlarged(image, scale as u32);
    }
    let scaled = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    shrink(image, scaled(image.width), scaled(image.height))
}

fn enlarged(image: &Rgb8Image, factor: u32) -> Result<Rgb8Image, ImageError> {
    Rgb8Image::from_fn(image.width * factor, image.height * factor, |x, y| {
        image.pixel(x / factor, y / factor)
    })
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

/// Copies a picture onto the sheet, its upper left corner at `left`, `top`.
fn draw_image(sheet: &mut Rgb8Image, [left, top]: [u32; 2], image: &Rgb8Image) {
    for y in 0..image.height {
        for x in 0..image.width {
            sheet.set_pixel(left + x, top + y, image.pixel(x, y));
        }
    }
}

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
    fn thumbnails_keep_proportions_and_grow_by_whole_numbers() {
        let wide = thumbnail(&chequers(400, 100), [200, 200]).expect("a small picture");
        assert_eq!((wide.width, wide.height), (200, 50));
        assert_eq!(thumbnail(&chequers(120, 110), [200, 200]).expect("a picture"), chequers(120, 110));
        let grown = thumbnail(&chequers(60, 20), [200, 200]).expect("a picture");
        assert_eq!((grown.width, grown.height), (180, 60));
        assert_eq!([grown.pixel(2, 2), grown.pixel(3, 2)], [[200; 3], [100; 3]]);
        let thin = thumbnail(&chequers(400, 1), [20, 20]).expect("a small picture");
        assert_eq!((thin.width, thin.height), (20, 1));
    }

    fn sheet_of(greys: &[u8]) -> Sheet {
        let mut sheet = Sheet::new("A run", 2, [64, 16]);
        sheet.section(
            "Heading",
            "A note that is longer than the sheet is wide, so that it takes several lines",
        );
        for grey in greys {
            let picture = Rgb8Image::filled(64, 16, [*grey; 3]).expect("a picture");
            sheet.add("Caption of several words", &picture, "31.4 dB").expect("it fits");
        }
        sheet
    }

    #[test]
    fn pictures_stand_in_rows_below_their_captions() {
        let sheet = sheet_of(&[60, 90, 120]);
        let layout = sheet.layout(&Typeface::new());
        let drawn = sheet.render().expect("a small sheet");
        let places: Vec<[u32; 2]> = layout.images.iter().map(|(_, at)| *at).collect();
        assert_eq!(places[0][1], places[1][1]);
        assert!(places[1][0] >= places[0][0] + 64 && places[2][1] >= places[0][1] + 16);
        for ([left, top], grey) in places.into_iter().zip([60, 90, 120]) {
            assert_eq!(drawn.pixel(left, top), [grey; 3]);
            assert_eq!(drawn.pixel(left + 63, top + 15), [grey; 3]);
        }
    }

    #[test]
    fn every_word_stands_on_the_sheet_and_no_line_on_another() {
        let sheet = sheet_of(&[60, 90, 120]);
        let typeface = Typeface::new();
        let layout = sheet.layout(&typeface);
        let text: Vec<&str> = layout.lines.iter().map(|line| line.text.as_str()).collect();
        let text = text.join(" ");
        for words in
            ["A run", "Heading", "so that it takes several lines", "Caption of several words", "31.4 dB"]
        {
            assert!(text.contains(words), "{words:?} is missing in {text:?}");
        }
        let boxes: Vec<[u32; 4]> = layout
            .lines
            .iter()
            .map(|l| [l.left, l.top, l.left + typeface.width(&l.text, l.pixels), l.top + l.pixels])
            .chain(layout.images.iter().map(|(_, [left, top])| [*left, *top, left + 64, top + 16]))
            .collect();
        for (at, a) in boxes.iter().enumerate() {
            assert!(a[2] <= sheet.width_pixels() && a[3] <= layout.height, "{a:?} leaves the sheet");
            for b in &boxes[at + 1..] {
                let apart = a[2] <= b[0] || b[2] <= a[0] || a[3] <= b[1] || b[3] <= a[1];
                assert!(apart, "{a:?} and {b:?} overlap");
            }
        }
    }
}
