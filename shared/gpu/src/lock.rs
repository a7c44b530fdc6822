//! The locks of this crate. A lock is held for a few memory accesses, never for a driver call; debug builds assert that at each
//! call. There are two exceptions: the allocator's lock, because the driver allocates under it, and the turn of a server's
//! threads at a queue, which Vulkan requires (`lanes.rs`).

use std::cell::Cell;
use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard};

/// See the module.
#[derive(Default)]
pub(crate) struct Lock<T>(Mutex<T>);

/// What is locked, until it is dropped.
pub(crate) struct Locked<'a, T>(MutexGuard<'a, T>);

thread_local! {
    static HELD: Cell<u32> = const { Cell::new(0) };
}

impl<T> Lock<T> {
    pub(crate) fn lock(&self) -> Locked<'_, T> {
        let guard = self.0.lock().expect("not poisoned");
        HELD.set(HELD.get() + 1);
        Locked(guard)
    }
}

impl<T> Deref for Locked<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<T> DerefMut for Locked<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.0
    }
}

impl<T> Drop for Locked<'_, T> {
    fn drop(&mut self) {
        HELD.set(HELD.get() - 1);
    }
}

/// Whether this thread holds none.
pub(crate) fn none_held() -> bool {
    HELD.get() == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_knows_what_it_holds_and_nothing_of_others() {
        let (a, b) = (Lock::<u32>::default(), Lock::<u32>::default());
        assert!(none_held());
        let (first, mut second) = (a.lock(), b.lock());
        *second += 1;
        drop(first);
        assert!(!none_held());
        std::thread::scope(|scope| scope.spawn(|| assert!(none_held())).join()).expect("no panic");
        drop(second);
        assert!(none_held());
        assert_eq!(*b.lock(), 1);
    }
}
