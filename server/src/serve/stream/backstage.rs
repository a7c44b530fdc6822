//! What takes long about clients that come and go, on a thread of its own: nobody's pictures wait for it.
//!
//! An [`Order`] enters, an [`Opening`] is given at once, and what serves the client leaves through it. What a client leaves is
//! waited for, wiped and kept for some seconds: one that returns, or another with the same eyes and atlas, finds its device memory
//! made. Encoders are made anew: they remember pictures. The world, turns and sessions are unknown here.

use super::encoder::{EncoderThread, Pictures};
use super::pipeline::OpenError;
use crate::encode::{EncodeError, Encoder};
use crate::update::policy::UpdatePolicy;
use crate::update::ready::{MemoryTerms, ReadyUpdates, ViewerMemory};
use crate::update::{LeftUpdates, ShowOptions};
use crate::world::Site;
use shadecast_gpu::Gpu;
use shadecast_protocol::message::{Capabilities, Welcome};
use std::any::Any;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SendError, Sender, TryRecvError, channel};
use std::sync::{Arc, Weak};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long what a client leaves is kept.
const KEPT_FOR: Duration = Duration::from_secs(10);
/// Clients whose memory is kept at once. One takes about 60 MB at 2048x2048.
const MOST_KEPT: usize = 2;

/// What is to be made for a client that has come.
pub(super) struct Order {
    pub(super) site: Site,
    pub(super) welcome: Welcome,
    pub(super) capabilities: Capabilities,
    pub(super) show: ShowOptions,
    /// Makes its encoder.
    pub(super) encoder: Box<dyn FnOnce() -> Result<Box<dyn Encoder>, EncodeError> + Send>,
    pub(super) pictures: Pictures,
}

/// What serves a client, once the world has taken its updates in.
type Made = (ReadyUpdates, EncoderThread);
/// A panic goes on where somebody looks.
type Answer = Result<Result<Made, OpenError>, Box<dyn Any + Send>>;

/// What is being made for a client. Dropped, it is not wanted any more.
pub(super) struct Opening {
    answer: Receiver<Answer>,
    _is_wanted: Arc<()>,
}

impl Opening {
    /// What was made, once it is.
    ///
    /// # Panics
    /// Making it has panicked.
    pub(super) fn poll(&mut self) -> Option<Result<Made, OpenError>> {
        match self.answer.try_recv() {
            Ok(Ok(made)) => Some(made),
            Ok(Err(panic)) => resume_unwind(panic),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => panic!("the thread that makes what serves clients has ended"),
        }
    }
}

enum Job {
    Open { order: Box<Order>, answer: Sender<Answer>, is_wanted: Weak<()> },
    Leave { gpu: Arc<Gpu>, left: Box<LeftUpdates>, encoder: Option<JoinHandle<()>>, is_kept: bool },
}

/// See the module. Dropping it waits for what it is at.
pub(super) struct Backstage {
    /// `None` while dropping.
    jobs: Option<Sender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Backstage {
    pub(super) fn start() -> io::Result<Self> {
        let (jobs, jobs_from) = channel();
        let thread = std::thread::Builder::new().name("backstage".into()).spawn(move || run(&jobs_from))?;
        Ok(Self { jobs: Some(jobs), thread: Some(thread) })
    }

    /// Begins to make what serves a client.
    pub(super) fn open(&self, order: Order) -> Opening {
        let (answer, answered) = channel();
        let is_wanted = Arc::new(());
        let order = Box::new(order);
        self.give(Job::Open { order, answer, is_wanted: Arc::downgrade(&is_wanted) });
        Opening { answer: answered, _is_wanted: is_wanted }
    }

    /// Takes what a client has left: its encoder may still be at its last picture. `is_kept`: it may serve another.
    pub(super) fn leave(
        &self,
        gpu: &Arc<Gpu>,
        left: LeftUpdates,
        encoder: Option<JoinHandle<()>>,
        is_kept: bool,
    ) {
        self.give(Job::Leave { gpu: gpu.clone(), left: Box::new(left), encoder, is_kept });
    }

    fn give(&self, job: Job) {
        if let Some(jobs) = &self.jobs {
            // Where the thread has ended, what waits for an answer learns it.
            let _ = jobs.send(job);
        }
    }
}

impl Drop for Backstage {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            // Panics were caught in the thread.
            let _ = thread.join();
        }
    }
}

/// In turn, so that however many come and go, one thread is busy with it.
fn run(jobs: &Receiver<Job>) {
    let mut kept = Kept::default();
    loop {
        let job = match kept.next_end() {
            None => jobs.recv().map_err(|_| RecvTimeoutError::Disconnected),
            Some(end) => jobs.recv_timeout(end.saturating_duration_since(Instant::now())),
        };
        match job {
            Ok(job) => {
                // What a panic leaves behind is not used again.
                let worked = catch_unwind(AssertUnwindSafe(|| work(job, &mut kept)));
                if worked.is_err() {
                    kept = Kept::default();
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        kept.end(Instant::now());
    }
}

fn work(job: Job, kept: &mut Kept<MemoryTerms, ViewerMemory>) {
    match job {
        Job::Open { is_wanted, .. } if is_wanted.strong_count() == 0 => {}
        Job::Open { order, answer, .. } => {
            let made = catch_unwind(AssertUnwindSafe(|| make(*order, kept)));
            // It has gone meanwhile: the next one may have use for what nobody has used.
            if let Err(SendError(Ok(Ok((updates, _))))) = answer.send(made) {
                keep(updates.into_memory(), kept);
            }
        }
        Job::Leave { gpu, left, encoder, is_kept } => {
            // Its panics were caught, and told as outcomes.
            encoder.into_iter().for_each(|thread| drop(thread.join()));
            if !is_kept {
                return;
            }
            // A device that is lost has nothing to keep.
            if let Ok(memory) = left.wiped(&gpu) {
                keep(memory, kept);
            }
        }
    }
}

fn keep(memory: ViewerMemory, kept: &mut Kept<MemoryTerms, ViewerMemory>) {
    kept.keep(memory.terms(), memory, Instant::now() + KEPT_FOR);
}

fn make(order: Order, kept: &mut Kept<MemoryTerms, ViewerMemory>) -> Result<Made, OpenError> {
    let Order { site, welcome, capabilities, show, encoder, pictures } = order;
    let of_encoder = |error: &dyn std::fmt::Display| OpenError::Encoder(error.to_string());
    let encoder = encoder().map_err(|error| of_encoder(&error))?;
    let memory = kept.take(&MemoryTerms::of(&welcome, &capabilities));
    let ready =
        |memory| ReadyUpdates::new(&site, memory, &welcome, &capabilities, show, UpdatePolicy::default());
    let updates = ready(memory).or_else(|error| match kept.is_empty() || error.is_lost() {
        true => Err(error),
        false => {
            // What is kept is in the way of one who has come.
            *kept = Kept::default();
            site.gpu.destroy_retired();
            ready(None)
        }
    });
    let updates = updates.map_err(OpenError::Device)?;
    let encoder = EncoderThread::start(encoder, pictures).map_err(|error| of_encoder(&error))?;
    Ok((updates, encoder))
}

/// A few things for some seconds, the oldest first. Pure.
struct Kept<K, T>(Vec<(Instant, K, T)>);

impl<K, T> Default for Kept<K, T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<K: PartialEq, T> Kept<K, T> {
    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn keep(&mut self, key: K, thing: T, end: Instant) {
        if self.0.len() == MOST_KEPT {
            self.0.remove(0);
        }
        self.0.push((end, key, thing));
    }

    /// The newest of this key.
    fn take(&mut self, key: &K) -> Option<T> {
        let place = self.0.iter().rposition(|(_, of, _)| of == key)?;
        Some(self.0.remove(place).2)
    }

    fn next_end(&self) -> Option<Instant> {
        self.0.iter().map(|(end, ..)| *end).min()
    }

    fn end(&mut self, now: Instant) {
        self.0.retain(|(end, ..)| *end > now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_of_a_key_is_given_once_and_none_of_another() {
        let (mut kept, end) = (Kept::default(), Instant::now() + KEPT_FOR);
        kept.keep("a", 1, end);
        kept.keep("a", 2, end);
        assert_eq!(kept.take(&"b"), None);
        assert_eq!([(); 3].map(|()| kept.take(&"a")), [Some(2), Some(1), None]);
    }

    #[test]
    fn no_more_than_some_are_kept_and_none_for_ever() {
        let (mut kept, start) = (Kept::default(), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        (0..4).for_each(|number| kept.keep(number, (), after(number)));
        assert_eq!((kept.take(&0), kept.take(&1), kept.next_end()), (None, None, Some(after(2))));
        kept.end(after(2));
        assert_eq!((kept.take(&2), kept.next_end()), (None, Some(after(3))));
        kept.end(after(3));
        assert!(kept.is_empty() && kept.next_end().is_none());
    }
}
