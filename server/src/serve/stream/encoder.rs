//! The encoder's thread: one picture at a time, so that what leaves is always the newest.

use super::outlet::Outlet;
use super::traced::Row;
use crate::encode::{AccessUnit, EncodeError, Encoder, PATIENCE};
use crate::pacing::quality::SentPicture;
use crate::serve::cause_bits::{CauseBits, Ledger};
use crate::serve::encoding::{Coded, Encoding};
use crate::update::Shaded;
use shadecast_protocol::message::Refused;
use shadecast_protocol::session::picture_stream;
use shadecast_system::monotonic_now_ns;
use shadecast_transport::PeerId;
use std::any::Any;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::thread::JoinHandle;

/// A picture to encode and send.
pub(super) struct Job {
    /// The update.
    pub(super) shaded: Box<Shaded>,
    /// The picture shall need no other.
    pub(super) refresh: bool,
    /// Its quantiser.
    pub(super) qp: u8,
}

/// Who gets an encoder's pictures, and the row of the trace that tells of them.
pub(super) struct Pictures {
    pub(super) outlet: Arc<dyn Outlet>,
    pub(super) peer: PeerId,
    pub(super) row: Row,
}

/// What became of a picture.
pub(super) enum EncodeOutcome {
    /// It was handed to the transport.
    Sent {
        /// The update.
        shaded: Box<Shaded>,
        /// What it came to.
        picture: SentPicture,
        /// Bytes of its access unit.
        unit_bytes: usize,
        /// Where its bits went, where a trace is asked for.
        bits: Option<CauseBits>,
    },
    /// The encoder is of no further use: why.
    Failed(String),
}

/// What encodes a client's pictures beside the pipeline, one at a time.
pub(super) trait PictureEncoder {
    /// Hands over a picture; the one before was polled.
    fn give(&mut self, job: Job);
    /// What became of the picture that was handed over, once that is known.
    fn poll(&mut self) -> Option<EncodeOutcome>;
    /// No picture is wanted any more. Gives the thread that may still be at its last one, for who can wait for it.
    fn end(self: Box<Self>) -> Option<JoinHandle<()>> {
        None
    }
}

/// An encoder on a thread of its own. Dropping it waits for the picture that is being encoded.
pub(super) struct EncoderThread {
    /// `None` while dropping.
    jobs: Option<SyncSender<Job>>,
    outcomes: Receiver<EncodeOutcome>,
    is_busy: bool,
    thread: Option<JoinHandle<()>>,
}

impl EncoderThread {
    pub(super) fn start(encoder: Box<dyn Encoder>, pictures: Pictures) -> io::Result<Self> {
        let Pictures { outlet, peer, row } = pictures;
        let (jobs, jobs_from) = sync_channel(1);
        let (outcomes_to, outcomes) = channel();
        let thread = std::thread::Builder::new().name("encoder".into()).spawn(move || {
            let ledger = row.is_traced().then(Ledger::default);
            let mut to = Recipient { outlet: outlet.as_ref(), peer, row, ledger };
            run(Encoding::new(encoder), &mut to, &jobs_from, &outcomes_to);
        })?;
        Ok(Self { jobs: Some(jobs), outcomes, is_busy: false, thread: Some(thread) })
    }
}

impl PictureEncoder for EncoderThread {
    /// A thread that has ended tells with [`Self::poll`].
    fn give(&mut self, job: Job) {
        self.is_busy = true;
        if let Some(jobs) = &self.jobs {
            // There is room: nothing is given while the thread is busy. Where it has ended, its outcome says so.
            let _ = jobs.try_send(job);
        }
    }

    fn poll(&mut self) -> Option<EncodeOutcome> {
        if !self.is_busy {
            return None;
        }
        let outcome = match self.outcomes.try_recv() {
            Ok(outcome) => outcome,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => EncodeOutcome::Failed("the encoder's thread has ended".into()),
        };
        self.is_busy = false;
        Some(outcome)
    }

    fn end(mut self: Box<Self>) -> Option<JoinHandle<()>> {
        self.jobs = None;
        self.thread.take()
    }
}

impl Drop for EncoderThread {
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            // Panics were caught in the thread and told as outcomes.
            let _ = thread.join();
        }
    }
}

/// Who gets the pictures, and where it is told how long they took.
struct Recipient<'a> {
    outlet: &'a dyn Outlet,
    peer: PeerId,
    row: Row,
    /// Where a trace is asked for, until it meets a stream that it cannot read.
    ledger: Option<Ledger>,
}

/// Ends when the pipeline lets go, or with the first picture that fails.
fn run(
    mut encoding: Encoding,
    to: &mut Recipient<'_>,
    jobs: &Receiver<Job>,
    outcomes: &Sender<EncodeOutcome>,
) {
    while let Ok(job) = jobs.recv() {
        // What a panic leaves behind in the encoder is not used again.
        let worked = AssertUnwindSafe(|| encode(&mut encoding, to, job));
        let outcome =
            catch_unwind(worked).unwrap_or_else(|panic| EncodeOutcome::Failed(words_of(panic.as_ref())));
        let has_failed = matches!(outcome, EncodeOutcome::Failed(_));
        if outcomes.send(outcome).is_err() || has_failed {
            return;
        }
    }
}

fn encode(encoding: &mut Encoding, to: &mut Recipient<'_>, job: Job) -> EncodeOutcome {
    let (began_ns, update) = (monotonic_now_ns(), job.shaded.update);
    if let Err(error) = encoding.submit(job.shaded, job.refresh, job.qp) {
        return EncodeOutcome::Failed(error.to_string());
    }
    let Coded { shaded, header, unit } = match encoding.poll(PATIENCE).unwrap_or(Err(EncodeError::Stalled)) {
        Ok(coded) => coded,
        Err(error) => return EncodeOutcome::Failed(error.to_string()),
    };
    let (encode_s, is_refresh) = ((monotonic_now_ns() - began_ns) as f64 * 1e-9, header.is_refresh);
    to.row.ended("encode", began_ns, Some(update));
    let out = match picture_stream(header, &unit.bytes) {
        Ok(out) => out,
        Err(error) => {
            return EncodeOutcome::Failed(format!(
                "{error}; a coarser quantisation (--qp, --bitrate) makes it smaller"
            ));
        }
    };
    let picture = SentPicture { stream_bytes: out.bytes(), is_refresh, encode_s };
    let unit_bytes = unit.bytes.len();
    match to.outlet.send(to.peer, out) {
        Ok(()) => EncodeOutcome::Sent { bits: to.divide(&unit, &shaded), shaded, picture, unit_bytes },
        Err(error) => EncodeOutcome::Failed(format!("a picture could not be sent: {error}")),
    }
}

impl Recipient<'_> {
    /// Where the bits of a picture went, told to the trace too. It has left already.
    fn divide(&mut self, unit: &AccessUnit, shaded: &Shaded) -> Option<CauseBits> {
        match self.ledger.as_mut()?.divide(unit, &shaded.blocks) {
            Ok(bits) => {
                self.row.bits(&bits);
                Some(bits)
            }
            Err(error) => {
                tracing::warn!("the trace has no bits by cause: {error}");
                self.ledger = None;
                None
            }
        }
    }
}

/// Why the session ends of a client whose part of the program has panicked.
pub(super) fn refused_by(panic: &(dyn Any + Send)) -> Refused {
    Refused::new(&words_of(panic), "connect again; if it stays so, report it with the server's log")
}

/// What a panic said.
fn words_of(panic: &(dyn Any + Send)) -> String {
    let words = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let words = words.or_else(|| panic.downcast_ref::<String>().cloned());
    format!("a fault of the program: {}", words.as_deref().unwrap_or("no words"))
}
