//! The states of a viewer's updates between begin and collection.
//!
//! One update at most is made ready: it is begun, then placed. One at most is shaded beside it. A placed update is shaded before
//! another is begun, and after the update before it was collected: the device reads the lists of one shading at a time.

use crate::encode::Source;
use crate::motion::delta::UpdateDelta;
use crate::pacing::overlap::Flight;
use crate::update::visibility_step::Begun;
use crate::update::{Shaded, Sharpness};
use crate::visibility::predict::PredictedViews;
use crate::world::{Sampled, World};
use shadecast_gpu::{GpuError, Ticket, Timings};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;

/// An update that lacks only its shading.
pub(crate) struct Placed {
    /// Its number.
    pub update: UpdateId,
    /// When it was begun.
    pub time: ServerTime,
    /// Its views: shading uses the head between them.
    pub views: PredictedViews,
    /// The samples of their times.
    pub sampled: Sampled,
    /// How sharp it is.
    pub sharpness: Sharpness,
    /// Changes to the client's memory.
    pub delta: UpdateDelta,
    /// Device time of its visibility passes.
    pub timings: Timings,
}

/// An update whose shading is on the device.
pub(crate) struct InWork {
    shaded: Shaded,
    ticket: Ticket,
}

/// See the module.
#[derive(Default)]
pub(crate) struct InFlight {
    ahead: Ahead,
    in_work: Option<InWork>,
}

/// The update that is made ready.
#[derive(Default)]
enum Ahead {
    #[default]
    None,
    /// A visibility pass of it is on the device.
    Begun(Begun),
    /// Its shading waits to be recorded.
    Placed(Placed),
}

impl InFlight {
    /// An update has a visibility pass on the device: its first, or another.
    pub(crate) fn begin(&mut self, begun: Begun) {
        assert!(matches!(self.ahead, Ahead::None), "an update is placed and shaded before the next is begun");
        self.ahead = Ahead::Begun(begun);
    }

    /// Whether a visibility pass is on the device.
    pub(crate) fn is_begun(&self) -> bool {
        matches!(self.ahead, Ahead::Begun(_))
    }

    /// The begun update, to be placed or to get another visibility pass.
    pub(crate) fn take_begun(&mut self) -> Option<Begun> {
        match std::mem::take(&mut self.ahead) {
            Ahead::Begun(begun) => Some(begun),
            other => {
                self.ahead = other;
                None
            }
        }
    }

    /// What was begun is placed.
    pub(crate) fn place(&mut self, placed: Placed) {
        assert!(matches!(self.ahead, Ahead::None), "one update is placed at a time");
        self.ahead = Ahead::Placed(placed);
    }

    /// The placed update, to be shaded.
    pub(crate) fn take_placed(&mut self) -> Option<Placed> {
        match std::mem::take(&mut self.ahead) {
            Ahead::Placed(placed) => {
                assert!(self.in_work.is_none(), "the device still reads the lists of the update before");
                Some(placed)
            }
            other => {
                self.ahead = other;
                None
            }
        }
    }

    /// What was placed is before the device.
    pub(crate) fn shade(&mut self, placed: Placed, ticket: Ticket) {
        let Placed { update, time, sharpness, delta, timings, .. } = placed;
        let (picture, blocks) = (Source::default(), Vec::new());
        let shaded = Shaded { update, time, sharpness, delta, picture, blocks, timings };
        self.in_work = Some(InWork { shaded, ticket });
    }

    /// The update that the device shades, without its picture, once it is shaded: waits for it.
    pub(crate) fn wait_shaded(&mut self, world: &World) -> Result<Option<Shaded>, GpuError> {
        let Some(InWork { mut shaded, ticket }) = self.in_work.take() else { return Ok(None) };
        world.gpu().wait_timed_into(ticket, &mut shaded.timings)?;
        Ok(Some(shaded))
    }

    /// The tickets of the visibility pass and of the shading on the device.
    pub(crate) fn tickets(&self) -> [Option<Ticket>; 2] {
        let pass = if let Ahead::Begun(begun) = &self.ahead { Some(begun.ticket()) } else { None };
        [pass, self.in_work.as_ref().map(|work| work.ticket)]
    }

    /// The progress of all.
    pub(crate) fn flight(&self, world: &World) -> Result<Flight, GpuError> {
        let is_done = |ticket: Option<Ticket>| ticket.map_or(Ok(false), |ticket| world.gpu().is_done(ticket));
        let [pass, shading] = self.tickets();
        Ok(Flight {
            is_begun: pass.is_some(),
            is_seen: is_done(pass)?,
            is_placed: matches!(self.ahead, Ahead::Placed(_)),
            is_in_work: shading.is_some(),
            is_shaded: is_done(shading)?,
        })
    }
}
