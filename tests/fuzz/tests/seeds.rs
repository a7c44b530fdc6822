//! The seeds, on the ordinary compiler: each must get past the first bytes, or fuzzing would begin with nothing.

use std::path::{Path, PathBuf};

fn seeds(target: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds").join(target);
    let files = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let paths = files.map(|file| file.unwrap().path());
    paths.map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
}

/// Damaged copies of each seed that are checked.
const COPIES: usize = 300;

/// Some seed must get as far as `least`, and none, however it is damaged, may break a check.
#[track_caller]
fn assert_reaches(target: &str, check: fn(&[u8]) -> usize, least: usize) {
    let seeds = seeds(target);
    let reached = seeds.iter().map(|(_, bytes)| check(bytes)).max();
    assert!(reached >= Some(least), "{target}: the best seed reaches {reached:?} of {least}");
    let mut state = 1;
    for (path, bytes) in &seeds {
        println!("{} of {} bytes reaches {}", path.display(), bytes.len(), check(bytes));
        for _ in 0..COPIES {
            check(&damaged(bytes, &mut state));
        }
    }
}

/// A copy with some bytes changed, and now and then a piece cut out, doubled or left off.
fn damaged(bytes: &[u8], state: &mut u64) -> Vec<u8> {
    let mut copy = bytes.to_vec();
    for _ in 0..=next(state) % 4 {
        let at = next(state) as usize % copy.len().max(1);
        if let Some(byte) = copy.get_mut(at) {
            *byte = if next(state).is_multiple_of(2) {
                *byte ^ 1 << (next(state) % 8)
            } else {
                next(state) as u8
            };
        }
    }
    let (from, length) = (next(state) as usize % copy.len().max(1), next(state) as usize % 64);
    let piece = from..(from + length).min(copy.len());
    match next(state) % 6 {
        0 => drop(copy.drain(piece)),
        1 => {
            let again = copy[piece].to_vec();
            copy.splice(from..from, again);
        }
        2 => copy.truncate(from),
        _ => {}
    }
    copy
}

/// Xorshift: the same damage in every run.
fn next(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state >> 16
}

#[test]
fn recorded_deltas_decode_and_come_back() {
    assert_reaches("deltas", shadecast_fuzz::deltas::check, 8);
}

#[test]
fn a_recorded_server_gives_deltas_and_pictures() {
    assert_reaches("client_session", shadecast_fuzz::client_session::check, 16);
}

#[test]
fn a_recorded_client_is_accepted_and_heard() {
    assert_reaches("server_session", shadecast_fuzz::server_session::check, 8);
}

#[test]
fn recorded_messages_are_read() {
    assert_reaches("messages", shadecast_fuzz::messages::check, 16);
}

#[test]
fn a_recorded_control_stream_falls_into_messages() {
    assert_reaches("framing", shadecast_fuzz::framing::check, 3);
}

#[test]
fn a_recorded_picture_has_a_sequence_header() {
    assert_reaches("sps", shadecast_fuzz::sps::check, 1);
}

#[test]
fn recorded_pictures_are_decoded() {
    assert_reaches("pictures", shadecast_fuzz::pictures::check, 4);
}

#[cfg(feature = "decoder")]
#[test]
fn coded_pictures_are_decoded_on_the_cpu() {
    assert_reaches("decoder", shadecast_fuzz::decoder::check, 10);
}

#[test]
fn devices_are_paired_between_guesses() {
    assert_reaches("pairing", shadecast_fuzz::pairing::check, 3);
}

#[test]
fn the_seeds_are_small() {
    let targets = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("seeds")).unwrap();
    let names = targets.map(|it| it.unwrap().file_name().into_string().unwrap());
    let bytes: usize = names.flat_map(|name| seeds(&name)).map(|(_, bytes)| bytes.len()).sum();
    assert!(bytes < 400_000, "{bytes} bytes of seeds are in the repository");
}
