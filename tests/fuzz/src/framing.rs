//! The control stream's framing: however the bytes are cut, the same messages come out, or the same error.

use shadecast_protocol::limits::{MAX_CONTROL_BYTES, MAX_EMPTY_CONTROL_MESSAGES};
use shadecast_protocol::wire::{ControlReader, WireError, frame_control};

/// The first byte says how the rest is cut. Gives the number of messages.
pub fn check(data: &[u8]) -> usize {
    let Some((&cut, stream)) = data.split_first() else { return 0 };
    let (whole, error) = read([stream]);
    let (pieces, same_error) = read(stream.chunks(usize::from(cut) + 1));
    assert_eq!(error.is_some(), same_error.is_some(), "cut every {} bytes", cut + 1);
    // With an error, what came before it in the same piece is lost.
    assert!(error.is_some() && pieces.starts_with(&whole) || whole == pieces, "cut every {} bytes", cut + 1);
    assert!(whole.iter().all(|message| (1..=MAX_CONTROL_BYTES).contains(&message.len())));
    let again: Vec<u8> = whole.iter().flat_map(|message| frame_control(message)).collect();
    assert_eq!(read([&again[..]]), (whole.clone(), None));
    if error.is_none() {
        let least = whole.iter().map(|message| 4 + message.len()).sum::<usize>();
        let most = least + 4 * MAX_EMPTY_CONTROL_MESSAGES + 4 + MAX_CONTROL_BYTES;
        assert!((least..=most).contains(&stream.len()), "bytes were lost or held back");
    }
    whole.len()
}

/// The messages before the first error.
fn read<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> (Vec<Vec<u8>>, Option<WireError>) {
    let mut reader = ControlReader::default();
    let mut messages = Vec::new();
    for piece in pieces {
        match reader.push(piece) {
            Ok(more) => messages.extend(more),
            Err(error) => return (messages, Some(error)),
        }
    }
    (messages, None)
}
