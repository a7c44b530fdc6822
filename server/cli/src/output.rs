//! Output of the program. No working thread waits for a reader. A closed pipe ends nothing.

use std::io::Write;
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::time::Duration;

/// Lines that wait for a slow reader. Further lines are dropped.
const MAX_WAITING_LINES: usize = 256;
/// Longest wait for a slow reader at the end of the program.
const LAST_LINES: Duration = Duration::from_millis(500);

/// Standard output, written by a thread of its own.
pub(crate) struct Output {
    voice: Voice,
    written: Receiver<()>,
}

/// Prints lines, from any thread.
#[derive(Clone)]
pub(crate) struct Voice {
    /// `None` ends the thread.
    lines: SyncSender<Option<String>>,
}

impl Voice {
    /// Queues a line.
    pub(crate) fn say(&self, line: &str) {
        // A full queue drops the line.
        let _ = self.lines.try_send(Some(line.to_owned()));
    }
}

impl Output {
    /// Starts the writing thread.
    ///
    /// # Errors
    /// The system gives no thread.
    pub(crate) fn start() -> std::io::Result<Self> {
        let (lines, to_write) = sync_channel::<Option<String>>(MAX_WAITING_LINES);
        let (done, written) = channel();
        std::thread::Builder::new().name("output".into()).spawn(move || {
            while let Ok(Some(line)) = to_write.recv() {
                let _ = writeln!(std::io::stdout(), "{line}");
            }
            let _ = done.send(());
        })?;
        Ok(Self { voice: Voice { lines }, written })
    }

    /// A handle that queues lines.
    pub(crate) fn voice(&self) -> Voice {
        self.voice.clone()
    }

    /// Waits until all lines are written, at most [`LAST_LINES`].
    pub(crate) fn finish(self) {
        if self.voice.lines.try_send(None).is_ok() {
            let _ = self.written.recv_timeout(LAST_LINES);
        }
    }
}

/// Prints a line to standard error.
pub(crate) fn note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context;
    use shadecast_protocol::text::with_causes;

    #[derive(Debug, thiserror::Error)]
    #[error("reading /key: {source}")]
    struct Embeds {
        source: std::io::Error,
    }

    #[test]
    fn a_cause_is_printed_once() {
        let source = std::io::Error::from_raw_os_error(13);
        let error = Err::<(), _>(Embeds { source }).context("starting the server").expect_err("an error");
        assert_eq!(
            with_causes(error.as_ref()),
            "starting the server: reading /key: Permission denied (os error 13)"
        );
        let plain =
            Err::<(), _>(std::io::Error::from_raw_os_error(2)).context("writing x").expect_err("an error");
        assert_eq!(with_causes(plain.as_ref()), "writing x: No such file or directory (os error 2)");
    }

    #[test]
    fn unread_output_blocks_nobody() {
        let (lines, to_write) = sync_channel(2);
        let (_done, written) = channel();
        let output = Output { voice: Voice { lines }, written };
        let voice = output.voice();
        (0..1000).for_each(|_| voice.say("a line"));
        assert_eq!(to_write.try_iter().count(), 2, "unread lines are dropped");
        drop(to_write);
        voice.say("a line more");
        output.finish();
    }
}
