//! How long what was seen counts as visible.

/// A patch that was seen stays for this many updates, so that what flickers at the limit of the ID buffer's sampling
/// does not flicker on the client.
pub(crate) const HOLD_UPDATES: u32 = 10;
