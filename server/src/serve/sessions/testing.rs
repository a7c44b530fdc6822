//! A client that this module's tests accept.

use super::mailbox::Accepted;
use shadecast_protocol::message::ClientMessage;
use shadecast_protocol::session::{ServerEvent, ServerSession};
use shadecast_test_support::peers::{hello, offer};

/// A client whose session has just been accepted.
pub(crate) fn accepted() -> Accepted {
    let mut session = ServerSession::new(offer());
    session.on_control(&ClientMessage::Hello(hello()).encode());
    let Some(ServerEvent::Asked { hello, welcome }) = session.poll_event() else { panic!("not asked") };
    let sender = session.accept().expect("it asks");
    Accepted { welcome: *welcome, capabilities: hello.capabilities, sender }
}
