//! Memory of what is not needed any more, for what comes. Pure.

/// As many as can be under way at once: of three updates one is placed, one shaded and one encoded, and the last one is kept.
const MOST: usize = 4;

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Pool<T>(Vec<T>);

impl<T> Default for Pool<T> {
    fn default() -> Self {
        Self(Vec::with_capacity(MOST))
    }
}

impl<T: Default> Pool<T> {
    /// One that was given, as it was; a new one where there is none.
    pub(crate) fn take(&mut self) -> T {
        self.0.pop().unwrap_or_default()
    }

    /// This one is not needed any more. Of more than can be under way it goes.
    pub(crate) fn give(&mut self, item: T) {
        if self.0.len() < MOST {
            self.0.push(item);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_given_is_taken_and_no_more_than_can_be_used_is_kept() {
        let mut pool: Pool<Vec<u8>> = Pool::default();
        assert_eq!(pool.take().capacity(), 0);
        (0..10).for_each(|_| pool.give(Vec::with_capacity(8)));
        let kept = (0..10).filter(|_| pool.take().capacity() >= 8).count();
        assert_eq!(kept, MOST);
    }
}
