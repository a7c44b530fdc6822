//! How much a client can be shown at one time. The updates of a viewer hold it; whoever chooses for them is given it with each choice.

/// How much a client can be shown at one time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Patches.
    pub patches: u32,
    /// Vertices of these patches, each counted once.
    pub vertices: u32,
    /// Triangles that are drawn for them: those of two sides twice.
    pub triangles: u32,
}
