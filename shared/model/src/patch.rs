//! Kinds of patches: their triangles, and the places of their vertices in the unit square.

/// How many triangles a patch has; this fixes how they lie in its unit square.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum PatchKind {
    /// Half of the square.
    One = 1,
    /// The square, split by the diagonal v0-v2.
    Two = 2,
    /// The square, with v4 on the middle of the edge v0-v1.
    Three = 3,
}

impl PatchKind {
    /// All kinds, in order of their number.
    pub const ALL: [Self; 3] = [Self::One, Self::Two, Self::Three];

    /// The kind of this many triangles.
    pub fn from_triangle_count(count: u8) -> Option<Self> {
        Self::ALL.get(usize::from(count).checked_sub(1)?).copied()
    }

    /// Triangles, 1..=3.
    pub fn triangle_count(self) -> usize {
        self.triangles().len()
    }

    /// Vertices, 3..=5.
    pub fn vertex_count(self) -> usize {
        self.corner_uv().len()
    }

    /// Each vertex's place in the unit square; (0, 0) is the corner of the block's address.
    pub fn corner_uv(self) -> &'static [[f32; 2]] {
        match self {
            Self::One => &[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
            Self::Two => &[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
            Self::Three => &[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.0]],
        }
    }

    /// The triangles, as indices of the patch's vertices. All turn from u to v, as the mesh's triangles do.
    pub fn triangles(self) -> &'static [[u8; 3]] {
        match self {
            Self::One => &[[0, 1, 2]],
            Self::Two => &[[0, 1, 2], [0, 2, 3]],
            Self::Three => &[[0, 4, 3], [4, 2, 3], [4, 1, 2]],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patch_triangles_turn_alike_and_cover_their_share_of_the_square() {
        for (kind, share) in PatchKind::ALL.into_iter().zip([0.5, 1.0, 1.0]) {
            let uv = kind.corner_uv();
            let mut area = 0.0;
            for tri in kind.triangles() {
                let [a, b, c] = tri.map(|i| uv[usize::from(i)]);
                let twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
                assert!(twice > 0.0, "{kind:?} {tri:?}");
                area += twice * 0.5;
            }
            assert_eq!(area, share, "{kind:?}");
            assert_eq!(PatchKind::from_triangle_count(kind.triangle_count() as u8), Some(kind));
        }
        assert_eq!(PatchKind::from_triangle_count(0), None);
        assert_eq!(PatchKind::from_triangle_count(4), None);
    }
}
