//! The smallest possible messages, as fast as the server takes them.

use super::{Effort, Repeated, Target, Then, control_bytes, hello_bytes, one_after_the_other};
use shadecast_protocol::message::ClientMessage;

pub(super) fn before_hello(target: &Target) -> anyhow::Result<Effort> {
    flood(target, &[])
}

pub(super) fn after_hello(target: &Target) -> anyhow::Result<Effort> {
    flood(target, &hello_bytes(|_| {}))
}

fn flood(target: &Target, first: &[u8]) -> anyhow::Result<Effort> {
    let request = control_bytes(&ClientMessage::RefreshRequest { after: None });
    one_after_the_other(target, || {
        let mut messages = Repeated::new(&request);
        let mut said_first = false;
        move |stranger| {
            if !std::mem::replace(&mut said_first, true) {
                stranger.write_control(first);
            }
            (Then::GoOn, messages.write(stranger))
        }
    })
}
