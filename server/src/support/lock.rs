//! How the server's threads take what they share: one place for what a thread that panicked means to the others.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// What is shared, for a moment. A thread that panicked with it keeps nobody else from going on: what is shared is whole after
/// every statement, or belongs to a client that is sent away.
pub fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_thread_that_panicked_has_changed_can_still_be_taken() {
        let shared = Mutex::new(1);
        std::thread::scope(|scope| {
            let thread = scope.spawn(|| {
                *lock(&shared) = 2;
                let _held = lock(&shared);
                panic!("on purpose");
            });
            assert!(thread.join().is_err());
        });
        assert!(shared.is_poisoned());
        assert_eq!(*lock(&shared), 2);
    }
}
