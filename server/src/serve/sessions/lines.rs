//! Lines for the user that strangers can cause: so many as can be read, and no more. Pure: time is an argument.

/// Lines within [`WINDOW_NS`].
const MAX_LINES: u32 = 4;
const WINDOW_NS: i64 = 10_000_000_000;

/// One kind of line.
#[derive(Debug, Default)]
pub(super) struct Sparse {
    begun_ns: Option<i64>,
    said: u32,
    unsaid: u64,
}

impl Sparse {
    /// Whether the line may be said now: how many were not since the last one.
    pub(super) fn ask(&mut self, now_ns: i64) -> Option<u64> {
        if self.begun_ns.is_none_or(|begun_ns| now_ns - begun_ns >= WINDOW_NS) {
            (self.begun_ns, self.said) = (Some(now_ns), 0);
        }
        if self.said == MAX_LINES {
            self.unsaid += 1;
            return None;
        }
        self.said += 1;
        Some(std::mem::take(&mut self.unsaid))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thousand_lines_are_a_few_and_their_number() {
        let mut lines = Sparse::default();
        let said = (0..1000).filter_map(|n| lines.ask(n * 1_000_000)).collect::<Vec<_>>();
        assert_eq!(said, [0; MAX_LINES as usize]);
        assert_eq!(lines.ask(WINDOW_NS), Some(996));
        assert_eq!(lines.ask(WINDOW_NS + 1), Some(0));
    }
}
