//! The smallest possible messages, as fast as the server takes them.

use super::{
    ANSWER_PATIENCE, Effort, Repeated, Target, Then, control_bytes, hello_bytes, one_after_the_other,
};
use shadecast_protocol::message::ClientMessage;
use std::time::{Duration, Instant};

pub(super) fn before_hello(target: &Target) -> anyhow::Result<Effort> {
    flood(target, &[], |_| Duration::ZERO)
}

/// Every other connection floods at once. A server may end those before it answers, so the others wait for the answer first.
pub(super) fn after_hello(target: &Target) -> anyhow::Result<Effort> {
    flood(
        target,
        &hello_bytes(|_| {}),
        |number| if number % 2 == 0 { ANSWER_PATIENCE } else { Duration::ZERO },
    )
}

/// `patience` is how long the connection of a number, from 0, waits for an answer to `first`.
fn flood(target: &Target, first: &[u8], patience: fn(u32) -> Duration) -> anyhow::Result<Effort> {
    let request = control_bytes(&ClientMessage::RefreshRequest { after: None });
    let mut connections = 0..;
    one_after_the_other(target, || {
        let mut messages = Repeated::new(&request);
        let (begun, mut said_first) = (Instant::now(), false);
        let patience = connections.next().map_or(Duration::ZERO, patience);
        move |stranger| {
            if !std::mem::replace(&mut said_first, true) {
                stranger.write_control(first);
            }
            if stranger.heard().is_empty() && begun.elapsed() < patience {
                return (Then::GoOn, 0);
            }
            (Then::GoOn, messages.write(stranger))
        }
    })
}
