//! The intake on its own thread. Arrivals are parsed, decoded and prepared here, so the render thread waits for none of it. The
//! thread sleeps until the network, the decoder or the presenter has work for it.

use super::intake::Intake;
use std::io;
use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

/// It looks by itself so often: for pings that are due, and servers that were found.
const LOOK_UP: Duration = Duration::from_millis(5);

/// Where what arrives comes from.
pub trait Source: Send {
    /// Hands in what has come since the last call, and lets the intake do what is due.
    fn pump(&mut self, intake: &mut Intake);

    /// Takes leave.
    fn leave(&mut self, intake: &mut Intake);
}

/// See the module. Dropping it takes leave of the source, and waits for the thread's end.
pub struct Taking {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Taking {
    /// Begins.
    ///
    /// # Errors
    /// The system has no more threads.
    pub fn start(mut intake: Intake, mut source: impl Source + 'static) -> io::Result<Self> {
        let stop = Arc::<AtomicBool>::default();
        let is_over = stop.clone();
        let take = move || {
            while !is_over.load(Ordering::Acquire) {
                intake.take_presented();
                source.pump(&mut intake);
                while intake.prepare() {}
                std::thread::park_timeout(LOOK_UP);
            }
            source.leave(&mut intake);
        };
        let thread = std::thread::Builder::new().name("intake".into()).spawn(take)?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// The thread, to be woken.
    pub fn thread(&self) -> Option<&Thread> {
        self.thread.as_ref().map(JoinHandle::thread)
    }

    /// A bug that has ended the thread ends this one too.
    pub fn assert_alive(&mut self) {
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
