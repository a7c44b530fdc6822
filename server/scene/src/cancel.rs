//! Cancellation. Long operations poll it, so the first Ctrl-C ends a program while it loads.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Whether somebody asked to end. Clones are asked together; the default is asked by nobody.
#[derive(Clone, Debug, Default)]
pub struct Cancel {
    flag: Arc<AtomicBool>,
    /// How often it may still be looked at before it asks by itself.
    #[cfg(test)]
    looks: Option<Arc<std::sync::atomic::AtomicU32>>,
}

/// What was being done was ended because somebody asked for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("interrupted")]
pub struct Cancelled;

impl Cancel {
    /// Asked when this flag is set.
    pub fn on(flag: Arc<AtomicBool>) -> Self {
        Self {
            flag,
            #[cfg(test)]
            looks: None,
        }
    }

    /// The flag, for what knows of no more.
    pub fn flag(&self) -> &Arc<AtomicBool> {
        &self.flag
    }

    /// Asks to end.
    pub fn ask(&self) {
        self.flag.store(true, Ordering::Relaxed);
    }

    /// Whether somebody asked.
    pub fn is_asked(&self) -> bool {
        #[cfg(test)]
        self.count_look();
        self.flag.load(Ordering::Relaxed)
    }

    /// An error once somebody has asked.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn check(&self) -> Result<(), Cancelled> {
        if self.is_asked() { Err(Cancelled) } else { Ok(()) }
    }
}

#[cfg(test)]
impl Cancel {
    /// Asks by itself when it is looked at for this time, counted from 0.
    pub(crate) fn at_look(number: u32) -> Self {
        Self { looks: Some(Arc::new(number.into())), ..Self::default() }
    }

    fn count_look(&self) {
        let Some(looks) = &self.looks else { return };
        let one_less = |left: u32| left.checked_sub(1);
        if looks.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_less).is_err() {
            self.ask();
        }
    }
}
