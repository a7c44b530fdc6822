//! What a client is handed, and when: told to it, and kept for who plays it again.

use anyhow::bail;
use shadecast_client::stream::intake::Intake;
use shadecast_protocol::time::ClientTime;
use shadecast_transport::Event;

/// All that a client was handed, in order.
pub type Recording = Vec<Heard>;

/// Something that a client is handed.
#[derive(Clone, Debug)]
pub struct Heard {
    /// When, nanoseconds of the virtual clock.
    pub at_ns: i64,
    /// What.
    pub what: What,
}

/// See [`Heard`].
#[derive(Clone, Debug)]
pub enum What {
    /// Bytes can flow.
    Connected,
    /// A message of the control stream.
    Control(Vec<u8>),
    /// A whole stream.
    Stream(Vec<u8>),
    /// What had come of a stream that was given up.
    Reset(Vec<u8>),
    /// A datagram.
    Datagram(Vec<u8>),
    /// The network carries nothing, or something again.
    Outage,
    /// A display frame begins.
    Frame,
}

impl Heard {
    /// What an event of the network that is taken at `now_ns` says.
    ///
    /// # Errors
    /// The connection has ended.
    pub fn of(event: Event, now_ns: i64) -> anyhow::Result<Self> {
        let (at_ns, what) = match event {
            Event::Connected { .. } => (now_ns, What::Connected),
            Event::Control { message, at_ns, .. } => (at_ns, What::Control(message)),
            Event::Datagram { bytes, at_ns, .. } => (at_ns, What::Datagram(bytes)),
            Event::Stream { bytes, at_ns, .. } => (at_ns, What::Stream(bytes)),
            Event::StreamReset { head, .. } => (now_ns, What::Reset(head)),
            Event::Away { .. } | Event::Back { .. } => (now_ns, What::Outage),
            Event::Closed { reason, .. } => bail!("the connection ended: {reason}"),
        };
        Ok(Self { at_ns, what })
    }

    /// Hands it to a client.
    pub fn tell(&self, intake: &mut Intake) {
        let at = ClientTime(self.at_ns);
        if !matches!(self.what, What::Outage | What::Frame) {
            intake.note_alive(at);
        }
        match &self.what {
            What::Connected => intake.on_connected(at),
            What::Control(message) => intake.receive_control(at, message),
            What::Stream(bytes) => intake.receive_stream(at, bytes),
            What::Reset(head) => intake.receive_reset(at, head),
            What::Datagram(bytes) => intake.receive_datagram(at, bytes),
            What::Outage => {}
            What::Frame => intake.advance(at),
        }
    }
}
