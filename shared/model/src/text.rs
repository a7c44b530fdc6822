//! Printable text. A peer's or a file's text reaches terminals, logs and the headset's panel.
//!
//! A terminal obeys control characters, and bidirectional characters let a line read otherwise than it is. Both are shown as
//! escapes. This module does not know the source of a text: callers apply it where foreign text enters.

use crate::limits::MAX_PRINTED_CHARS;
use std::error::Error;

/// What stands for the rest of a text that was cut.
const ELLIPSIS: char = '…';

/// `text` with everything escaped that a terminal would obey instead of show, cut to [`MAX_PRINTED_CHARS`] characters.
/// Once printable it stays as it is: doing this twice changes nothing.
pub fn printable(text: &str) -> String {
    let mut out = String::with_capacity(text.len().min(MAX_PRINTED_CHARS));
    let mut held = 0;
    // The end of what is kept where the rest has to give way to the ellipsis.
    let mut cut = 0;
    for character in text.chars() {
        let shown = shown_chars(character);
        if held + shown > MAX_PRINTED_CHARS {
            out.truncate(cut);
            out.push(ELLIPSIS);
            return out;
        }
        push_shown(&mut out, character);
        held += shown;
        if held < MAX_PRINTED_CHARS {
            cut = out.len();
        }
    }
    out
}

/// True for what must not reach a terminal: controls (C0, DEL, C1), line breaks of Unicode, and marks that turn the
/// direction of writing.
fn is_obeyed(character: char) -> bool {
    character.is_control()
        || matches!(character,
            '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn push_shown(out: &mut String, character: char) {
    if is_obeyed(character) {
        out.extend(character.escape_default());
    } else {
        out.push(character);
    }
}

fn shown_chars(character: char) -> usize {
    if is_obeyed(character) { character.escape_default().len() } else { 1 }
}

/// An error with its causes, as a program says it before it ends. What was said already is not said again: some errors
/// name their cause themselves.
pub fn with_causes(error: &(dyn Error + 'static)) -> String {
    let mut said = error.to_string();
    for cause in std::iter::successors(error.source(), |&cause| cause.source()) {
        let text = cause.to_string();
        if !said.contains(&text) {
            said = format!("{said}: {text}");
        }
    }
    said
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ordinary_text_stays_as_it_is() {
        for text in ["", "the scene has gone", "Größe 5 µm \\ 日本語 🐉", &"x".repeat(MAX_PRINTED_CHARS)]
        {
            assert_eq!(printable(text), text);
        }
    }

    #[derive(Debug, thiserror::Error)]
    enum Nested {
        #[error("writing stats.json: {source}; choose another place")]
        NamesItsCause { source: std::io::Error },
        #[error("opening the scene")]
        LeavesIt(#[source] Box<Nested>),
    }

    #[test]
    fn a_cause_is_said_once() {
        let full = Nested::NamesItsCause { source: std::io::Error::other("the disk is full") };
        assert_eq!(with_causes(&full), "writing stats.json: the disk is full; choose another place");
        let outer = Nested::LeavesIt(Box::new(full));
        assert_eq!(
            with_causes(&outer),
            "opening the scene: writing stats.json: the disk is full; choose another place"
        );
    }

    #[test]
    fn what_a_terminal_obeys_is_escaped() {
        assert_eq!(printable("\x1b]0;owned\x07"), "\\u{1b}]0;owned\\u{7}");
        assert_eq!(printable("a\r\nerror: b\t\0"), "a\\r\\nerror: b\\t\\u{0}");
        assert_eq!(printable("\u{7f}\u{9b}31m\u{85}"), "\\u{7f}\\u{9b}31m\\u{85}");
        let marks =
            "\u{61c}\u{200e}\u{200f}\u{202a}\u{202b}\u{202c}\u{202d}\u{202e}\u{2066}\u{2067}\u{2068}\u{2069}";
        assert!(printable(marks).is_ascii(), "{}", printable(marks));
        assert!(printable("\u{2028}\u{2029}").is_ascii());
    }

    #[test]
    fn long_text_is_cut_and_no_escape_is_cut_in_half() {
        let cut = printable(&"ä".repeat(MAX_PRINTED_CHARS + 1));
        assert_eq!(cut, "ä".repeat(MAX_PRINTED_CHARS - 1) + "…");
        let escapes = printable(&"\x1b".repeat(MAX_PRINTED_CHARS));
        assert!(escapes.chars().count() <= MAX_PRINTED_CHARS);
        assert_eq!(escapes, "\\u{1b}".repeat((MAX_PRINTED_CHARS - 1) / 6) + "…");
    }

    #[test]
    fn whatever_comes_is_short_shown_and_settled_at_once() {
        let mut state = 1u64;
        for _ in 0..2000 {
            let mut next = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) as u32
            };
            let length = next() % 300;
            let text: String = (0..length).filter_map(|_| char::from_u32(next() % 0x2100)).collect();
            let shown = printable(&text);
            assert!(shown.chars().count() <= MAX_PRINTED_CHARS, "{text:?}");
            assert!(!shown.chars().any(is_obeyed), "{text:?}");
            assert_eq!(printable(&shown), shown, "{text:?}");
        }
    }
}
