//! Where the bytes of deltas went.

/// A part of a delta.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// Numbers, times and lengths before the sections.
    Head,
    /// Patches and vertices that leave.
    Evicted,
    /// Instances, skeletons and meshes.
    Skeletons,
    /// Vertices before skinning.
    Rests,
    /// Vertices that enter.
    Vertices,
    /// Slots and instances of patches that enter.
    PatchSlots,
    /// Their kinds.
    PatchKinds,
    /// Their corners.
    Corners,
    /// Slots of patches that get another block, or none.
    PlacedSlots,
    /// The blocks.
    Blocks,
    /// Which texels of blocks are covered.
    Coverage,
    /// Blocks that settle.
    Settled,
    /// Samples.
    Samples,
    /// Predictions.
    Predictions,
}

impl Part {
    /// All parts, in order.
    pub const ALL: [Self; 14] = [
        Self::Head,
        Self::Evicted,
        Self::Skeletons,
        Self::Rests,
        Self::Vertices,
        Self::PatchSlots,
        Self::PatchKinds,
        Self::Corners,
        Self::PlacedSlots,
        Self::Blocks,
        Self::Coverage,
        Self::Settled,
        Self::Samples,
        Self::Predictions,
    ];

    /// As results name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Head => "head",
            Self::Evicted => "evicted",
            Self::Skeletons => "skeletons",
            Self::Rests => "rests",
            Self::Vertices => "vertices",
            Self::PatchSlots => "patch_slots",
            Self::PatchKinds => "patch_kinds",
            Self::Corners => "corners",
            Self::PlacedSlots => "placed_slots",
            Self::Blocks => "blocks",
            Self::Coverage => "coverage",
            Self::Settled => "settled",
            Self::Samples => "samples",
            Self::Predictions => "predictions",
        }
    }
}

/// Bytes by part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PartBytes([u64; Part::ALL.len()]);

impl PartBytes {
    /// Those of a part.
    pub fn of(&self, part: Part) -> u64 {
        self.0[part as usize]
    }

    /// Those of all parts.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// A part has so many bytes more.
    pub fn add(&mut self, part: Part, bytes: usize) {
        self.0[part as usize] += bytes as u64;
    }
}

impl std::ops::AddAssign for PartBytes {
    fn add_assign(&mut self, other: Self) {
        self.0.iter_mut().zip(other.0).for_each(|(sum, bytes)| *sum += bytes);
    }
}
