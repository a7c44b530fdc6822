//! Reasons for the end of a connection, as the other side receives them. The accompanying text is for people.

/// A reason that programs can tell apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum CloseCode {
    /// Whoever closes leaves of its own will, or ends.
    Leaving = 0,
    /// A client that was told before why it is refused.
    Refused = 1,
    /// A client whose place has been taken.
    Displaced = 2,
    /// What came makes no sense here, or nothing came.
    NotUnderstood = 4,
    /// What came breaks the rules of the transport.
    Violation = 0xbad,
    /// As many clients are connected as may be.
    Full = 0xf11,
}

impl CloseCode {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Leaving, Self::Refused, Self::Displaced, Self::NotUnderstood, Self::Violation, Self::Full];

    /// As on the wire.
    pub fn code(self) -> u32 {
        self as u32
    }

    /// What a code on the wire says; `None` for one that this version does not know.
    pub fn from_code(code: u64) -> Option<Self> {
        Self::ALL.into_iter().find(|known| u64::from(known.code()) == code)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_what_they_were_and_are_told_apart() {
        assert_eq!(CloseCode::ALL.map(CloseCode::code), [0, 1, 2, 4, 0xbad, 0xf11]);
        for code in CloseCode::ALL {
            assert_eq!(CloseCode::from_code(u64::from(code.code())), Some(code));
        }
        assert_eq!(CloseCode::from_code(3), None);
        assert_eq!(CloseCode::from_code(u64::MAX), None);
    }
}
