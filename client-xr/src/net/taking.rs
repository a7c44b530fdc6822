//! The intake on a thread of its own: what arrives is parsed, decoded and prepared here, so that the thread that draws waits for
//! none of it. It sleeps until the network, the decoder or the presenter has something for it.

use super::connector::Connector;
use crate::intake::Intake;
use std::io;
use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

/// It looks by itself so often: for pings that are due, and servers that were found.
const LOOK_UP: Duration = Duration::from_millis(5);

/// See the module. Dropping it takes leave of the server, and waits for the thread's end.
pub(super) struct Taking {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Taking {
    /// Begins.
    ///
    /// # Errors
    /// The system has no more threads.
    pub(super) fn start(mut intake: Intake, mut connector: Connector) -> io::Result<Self> {
        let stop = Arc::<AtomicBool>::default();
        let is_over = stop.clone();
        let take = move || {
            while !is_over.load(Ordering::Acquire) {
                connector.pump(&mut intake);
                while intake.prepare() {}
                std::thread::park_timeout(LOOK_UP);
            }
            connector.leave(&mut intake);
        };
        let thread = std::thread::Builder::new().name("intake".into()).spawn(take)?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// The thread, to be woken.
    pub(super) fn thread(&self) -> Option<&Thread> {
        self.thread.as_ref().map(JoinHandle::thread)
    }

    /// A bug that has ended the thread ends this one too.
    pub(super) fn assert_alive(&mut self) {
        if self.thread.as_ref().is_some_and(JoinHandle::is_finished) {
            self.join();
        }
    }

    fn join(&mut self) {
        if let Some(Err(panic)) = self.thread.take().map(JoinHandle::join)
            && !std::thread::panicking()
        {
            resume_unwind(panic);
        }
    }
}

impl Drop for Taking {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.thread().into_iter().for_each(Thread::unpark);
        self.join();
    }
}
