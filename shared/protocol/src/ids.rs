//! Newtypes of ids that must not be mixed up.

use crate::limits::MAX_FRAMES_AHEAD;
use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty)) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $name(pub $inner);

        impl $name {
            /// The bare number as an index into an array.
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

id!(/** One update of the server. Rises by one per update within a session; 0 is the first. */ UpdateId(u32));
id!(/** A vertex place in the client's memory, assigned by the server. */ VertexSlot(u32));
id!(/** A patch place in the client's memory, assigned by the server. */ PatchSlot(u32));
id!(/** One placed model of the scene. */ InstanceId(u16));
id!(/** A mesh of the scene; instances of one mesh have the same patches and vertices. */ MeshId(u32));
id!(/** A skeleton of the scene. */ SkeletonId(u16));
id!(/** A clip of the scene; paths of instances are clips too. */ ClipId(u32));
id!(/** A vertex of a mesh as it is before skinning, over all meshes of the scene: equal meshes share them. */ RestId(u32));
id!(/** Changes with every jump of the head or stage; prediction restarts when it does. */ DiscontinuityId(u32));

impl UpdateId {
    /// The update after this one; the last that there can be (at 30 Hz after four years) has none.
    pub fn next(self) -> Self {
        Self(self.0.saturating_add(1))
    }

    /// True where this update is so far after `due`, the next to come, that it is nonsense.
    pub fn is_too_far_after(self, due: Self) -> bool {
        self.0 > due.0.saturating_add(MAX_FRAMES_AHEAD)
    }
}
