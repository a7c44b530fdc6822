//! One valid hello after the other, each on a connection that is abandoned after the server's answer. The server must not build
//! for absent clients.

use super::{ANSWER_PATIENCE, Effort, Target, Then, hello_bytes, one_after_the_other};
use std::time::Instant;

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let hello = hello_bytes(|_| {});
    one_after_the_other(target, || {
        let (begun, mut sent) = (Instant::now(), 0);
        let hello = &hello;
        move |stranger| {
            let taken = stranger.write_control(&hello[sent..]);
            sent += taken;
            let is_done = !stranger.heard().is_empty() || begun.elapsed() > ANSWER_PATIENCE;
            if is_done {
                stranger.close();
            }
            (if is_done { Then::Leave } else { Then::GoOn }, taken as u64)
        }
    })
}
