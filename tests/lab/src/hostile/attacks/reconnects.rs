//! One valid hello after the other, each on a connection that is abandoned after the server's answer. The server must not build
//! for absent clients.

use super::{Effort, Target, Then, hello_bytes, one_after_the_other};
use std::time::{Duration, Instant};

/// How long an answer is waited for.
const PATIENCE: Duration = Duration::from_millis(500);

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let hello = hello_bytes(|_| {});
    one_after_the_other(target, || {
        let (begun, mut sent) = (Instant::now(), 0);
        let hello = &hello;
        move |stranger| {
            let taken = stranger.write_control(&hello[sent..]);
            sent += taken;
            let is_done = !stranger.heard().is_empty() || begun.elapsed() > PATIENCE;
            if is_done {
                stranger.close();
            }
            (if is_done { Then::Leave } else { Then::GoOn }, taken as u64)
        }
    })
}
