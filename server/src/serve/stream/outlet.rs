//! What pipeline and encoders hand their messages to.

use crate::pacing::share::WayState;
use shadecast_protocol::message::Refused;
use shadecast_protocol::session::Out;
use shadecast_transport::{PeerId, SendError};

/// The way to the clients.
pub(crate) trait Outlet: Send + Sync {
    /// Sends a stream.
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError>;
    /// What is known of the way to a client; `None` where nothing is yet.
    fn way(&self, peer: PeerId) -> Option<WayState>;
    /// Ends a session; the client learns why.
    fn refuse(&self, peer: PeerId, refused: Refused);
}
