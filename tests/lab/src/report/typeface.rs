//! Text in pictures, in a proportional typeface. It has one weight and draws lines; the sheet lays out pages.

use crate::image::Rgb8Image;
use ab_glyph::{Font, FontRef, Glyph, PxScale, ScaleFont, point};

/// No glyph of the typeface is wider, in units of the font's height.
pub const WIDEST_GLYPH_EM: f32 = 1.2;

/// Ubuntu Light, as the font's package embeds it.
#[derive(Debug)]
pub struct Typeface {
    font: FontRef<'static>,
}

impl Typeface {
    /// The one typeface.
    #[expect(clippy::new_without_default, reason = "a default typeface would say less than a new one")]
    pub fn new() -> Self {
        let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT);
        Self { font: font.expect("the embedded font is a font") }
    }

    /// Pixels that a line of text of height `pixels` takes.
    pub fn width(&self, text: &str, pixels: u32) -> u32 {
        self.glyphs(text, pixels).1.ceil() as u32
    }

    /// Glyphs on the baseline y = 0, and the width of all.
    fn glyphs(&self, text: &str, pixels: u32) -> (Vec<Glyph>, f32) {
        let font = self.font.as_scaled(PxScale::from(pixels as f32));
        let (mut glyphs, mut right, mut previous) = (Vec::new(), 0.0, None);
        for character in text.chars() {
            let id = font.glyph_id(character);
            right += previous.map_or(0.0, |previous| font.kern(previous, id));
            glyphs.push(id.with_scale_and_position(font.scale(), point(right, 0.0)));
            right += font.h_advance(id);
            previous = Some(id);
        }
        (glyphs, right)
    }

    /// Lines of whole words of at most `width` pixels each; a word that is wider by itself is broken between letters.
    pub fn wrap(&self, text: &str, pixels: u32, width: u32) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        for word in text.split_whitespace() {
            let joined = lines.last().map(|line| format!("{line} {word}"));
            match (joined, lines.last_mut()) {
                (Some(joined), Some(line)) if self.width(&joined, pixels) <= width => *line = joined,
                _ => lines.extend(self.pieces(word, pixels, width)),
            }
        }
        lines
    }

    fn pieces(&self, word: &str, pixels: u32, width: u32) -> Vec<String> {
        let mut pieces = vec![String::new()];
        for character in word.chars() {
            let last = pieces.last().map_or("", String::as_str);
            let longer = format!("{last}{character}");
            if last.is_empty() || self.width(&longer, pixels) <= width {
                pieces.pop();
                pieces.push(longer);
            } else {
                pieces.push(character.to_string());
            }
        }
        pieces
    }

    /// Draws a line of text with its upper left corner at `at`; what does not fit on the picture is left out.
    pub fn draw(&self, picture: &mut Rgb8Image, at: [u32; 2], pixels: u32, colour: [u8; 3], text: &str) {
        let baseline = self.font.as_scaled(PxScale::from(pixels as f32)).ascent();
        for mut glyph in self.glyphs(text, pixels).0 {
            glyph.position.x += at[0] as f32;
            glyph.position.y += at[1] as f32 + baseline;
            let Some(outline) = self.font.outline_glyph(glyph) else { continue };
            let corner = outline.px_bounds().min;
            outline.draw(|x, y, coverage| {
                let (x, y) = (corner.x as i64 + i64::from(x), corner.y as i64 + i64::from(y));
                if (0..i64::from(picture.width)).contains(&x) && (0..i64::from(picture.height)).contains(&y) {
                    blend(picture, x as u32, y as u32, colour, coverage.min(1.0));
                }
            });
        }
    }
}

fn blend(picture: &mut Rgb8Image, x: u32, y: u32, colour: [u8; 3], coverage: f32) {
    let below = picture.pixel(x, y);
    let mixed = [0, 1, 2].map(|channel| {
        let (from, to) = (f32::from(below[channel]), f32::from(colour[channel]));
        (from + (to - from) * coverage).round() as u8
    });
    picture.set_pixel(x, y, mixed);
}

#[cfg(test)]
mod tests {
    use super::*;

    const LABEL: &str = "Right eye: difference, amplified 4 times";

    #[test]
    fn text_is_wrapped_between_words_and_keeps_every_one() {
        let typeface = Typeface::new();
        for width in [120, 200, 400] {
            let lines = typeface.wrap(LABEL, 17, width);
            assert_eq!(lines.join(" "), LABEL);
            assert!(lines.iter().all(|line| typeface.width(line, 17) <= width), "{lines:?}");
        }
        assert!(typeface.wrap("", 17, 100).is_empty());
    }

    #[test]
    fn word_wider_than_the_line_is_broken_not_cut() {
        let typeface = Typeface::new();
        let lines = typeface.wrap("a abcdefghijklmnopqrstuvwxyz", 17, 60);
        assert_eq!(lines.concat(), "aabcdefghijklmnopqrstuvwxyz");
        assert!(lines.iter().all(|line| typeface.width(line, 17) <= 60), "{lines:?}");
    }

    #[test]
    fn letters_have_width_and_capitals_differ_from_small_ones() {
        let typeface = Typeface::new();
        assert!(typeface.width("WWWW", 20) > 2 * typeface.width("iiii", 20));
        let drawn = |text| {
            let mut picture = Rgb8Image::filled(40, 24, [0; 3]).expect("a small picture");
            typeface.draw(&mut picture, [2, 1], 20, [255; 3], text);
            picture
        };
        assert_ne!(drawn("a"), drawn("A"));
        assert!(drawn("a").data.iter().any(|byte| *byte > 200));
        assert!(drawn(" ").data.iter().all(|byte| *byte == 0));
    }

    #[test]
    fn text_beyond_the_picture_is_left_out() {
        let mut picture = Rgb8Image::filled(10, 6, [0; 3]).expect("a small picture");
        Typeface::new().draw(&mut picture, [8, 4], 30, [255; 3], LABEL);
    }

    #[test]
    fn every_character_of_our_labels_has_a_glyph() {
        let font = Typeface::new().font;
        for character in "AZaz09.,:;-+/%()=_#!'*<>\u{b1}\u{d7}\u{b7}".chars() {
            assert_ne!(font.glyph_id(character).0, 0, "{character:?}");
        }
    }
}
