//! Who lived in which slot of the client's memory, for as long as the client may still show it.

use shadecast_protocol::ids::UpdateId;
use shadecast_server::residency::Residency;
use shadecast_server::scene::numbering::SceneVertex;
use std::collections::VecDeque;

/// Updates of which the lab remembers who lived in which slot.
const REMEMBERED_UPDATES: usize = 512;

/// Which animated vertex was in which slot of the client's memory, by update: what the client shows belongs to an update
/// that the server has left behind.
#[derive(Debug, Default)]
pub struct Residents {
    by_update: VecDeque<(UpdateId, Vec<(u32, SceneVertex)>)>,
}

impl Residents {
    /// Notes how an update leaves the client's memory.
    pub fn note(&mut self, update: UpdateId, residency: &Residency) {
        let sampled = residency.moving().map(|(slot, vertex)| (slot.0, vertex)).collect();
        self.by_update.push_back((update, sampled));
        if self.by_update.len() > REMEMBERED_UPDATES {
            self.by_update.pop_front();
        }
    }

    /// Slots and scene-wide vertices of an update, ascending by slot; forgets those that were noted before it. What is shown
    /// comes in the order in which it was noted: a session that follows another one counts its updates anew.
    pub fn at(&mut self, update: UpdateId) -> Option<&[(u32, SceneVertex)]> {
        let place = self.by_update.iter().position(|(known, _)| *known == update)?;
        self.by_update.drain(..place);
        self.by_update.front().map(|(_, sampled)| &sampled[..])
    }
}
