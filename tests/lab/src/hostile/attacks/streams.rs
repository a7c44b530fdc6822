//! Large unidirectional streams from a client, which may send none.

use super::{Effort, Target, Then, hello_bytes, one_after_the_other};
use shadecast_protocol::limits::MAX_STREAM_BYTES;

/// Streams on one connection.
const STREAMS: usize = 256;
/// Bytes written to a stream at a time.
const PIECE: &[u8] = &[0x5a; 64 << 10];

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let hello = hello_bytes(|_| {});
    one_after_the_other(target, || {
        let (mut streams, mut said_hello, mut turn) = (Vec::new(), false, 0);
        let hello = &hello;
        move |stranger| {
            if !std::mem::replace(&mut said_hello, true) {
                stranger.write_control(hello);
            }
            while streams.len() < STREAMS
                && let Some(id) = stranger.open_uni()
            {
                streams.push((id, 0));
            }
            let count = streams.len().max(1);
            turn = (turn + 1) % count;
            let Some((id, sent)) = streams.get_mut(turn) else { return (Then::GoOn, 0) };
            let room = PIECE.len().min(MAX_STREAM_BYTES - *sent);
            let taken = stranger.write_uni(*id, &PIECE[..room]);
            *sent += taken;
            (Then::GoOn, taken as u64)
        }
    })
}
