//! Codes that somebody types at a running server: at its own terminal, or with `shadecast-server pair CODE`.
//!
//! That command reaches the server through two files in the folder of its identity. Whoever may write there holds the server's
//! key anyway, so nothing is to be authenticated, and no port is opened. A code that was given before a device began to wait is
//! never used: it would waste the guess.

use crate::serve::sessions::admission::{Outcome, Register};
use crate::serve::sessions::{Sessions, Surroundings};
use shadecast_protocol::text::printable;
use shadecast_system::PendingFile;
use shadecast_transport::identity::{KnownDevices, Rights};
use shadecast_transport::{Fingerprint, PeerId, random_bytes};
use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::time::{Duration, Instant};

const REQUEST_FILE: &str = "pairing-code";
const ANSWER_FILE: &str = "pairing-answer";
/// More of a file, or of a line of the terminal, is no code.
const MAX_REQUEST_BYTES: u64 = 256;
/// How long `pair` waits for a server to take the code, and then for what comes of it.
const TAKEN_WITHIN: Duration = Duration::from_secs(3);
const ANSWERED_WITHIN: Duration = Duration::from_secs(20);
const LOOK_UP: Duration = Duration::from_millis(20);

/// The list of devices, as sessions see it. A list that cannot be read stays as it was, and is complained of once.
pub(super) struct Devices {
    known: KnownDevices,
    has_complained: bool,
}

impl Devices {
    pub(super) fn new(known: KnownDevices) -> Self {
        Self { known, has_complained: false }
    }
}

impl Register for Devices {
    fn rights(&mut self, fingerprint: Fingerprint) -> Option<Rights> {
        match self.known.refresh() {
            Ok(()) => self.has_complained = false,
            Err(error) if !std::mem::replace(&mut self.has_complained, true) => tracing::warn!("{error}"),
            Err(_) => {}
        }
        self.known.find(fingerprint).map(|device| device.rights)
    }

    fn keep(&mut self, fingerprint: Fingerprint) -> Result<String, String> {
        let kept = self.known.pair(fingerprint, Rights::ALL);
        kept.map(|device| device.name).map_err(|error| error.to_string())
    }
}

/// Lines of the standard input, read by a thread of its own that nothing waits for.
pub(super) struct Terminal(Receiver<String>);

impl Terminal {
    /// Begins to read.
    ///
    /// # Errors
    /// The system gives no thread.
    pub(super) fn read() -> io::Result<Self> {
        shadecast_system::process::read_terminal_in_foreground_alone();
        let (lines, typed) = sync_channel(4);
        std::thread::Builder::new().name("terminal".into()).spawn(move || read_lines(&lines))?;
        Ok(Self(typed))
    }
}

fn read_lines(lines: &SyncSender<String>) {
    let mut line = String::new();
    while io::stdin().read_line(&mut line).is_ok_and(|bytes| bytes > 0) {
        if lines.send(std::mem::take(&mut line)).is_err() {
            return;
        }
    }
}

/// Where codes come from.
pub(super) struct Codes {
    folder: PathBuf,
    terminal: Option<Terminal>,
    /// Who was being paired when it was looked last.
    pairing: Option<PeerId>,
    /// Whose code the server has taken from the file, until it has answered.
    asked: Option<String>,
}

impl Codes {
    pub(super) fn new(folder: &Path, terminal: Option<Terminal>) -> Self {
        Self { folder: folder.to_owned(), terminal, pairing: None, asked: None }
    }

    /// Hands typed codes to the sessions, and what came of them to whoever asked.
    pub(super) fn tend(&mut self, sessions: &mut Sessions, now_ns: i64, around: &Surroundings<'_>) {
        let pairing = sessions.pairing();
        if pairing.is_some() && pairing != self.pairing {
            self.pairing = pairing;
            self.refuse_early();
        }
        self.pairing = pairing;
        if let Some(text) = self.typed().or_else(|| self.requested()) {
            sessions.type_code(&text, &random_bytes(), now_ns, around);
        }
        if let Some(outcome) = sessions.take_outcome() {
            self.answer(&outcome);
        }
    }

    /// What was given before the device began to wait is no code of it.
    fn refuse_early(&mut self) {
        if self.requested().is_some() {
            let text = "the device has only begun to wait; type the code that it shows now".to_owned();
            self.answer(&Outcome { is_paired: false, text });
        }
    }

    fn typed(&mut self) -> Option<String> {
        let line = match self.terminal.as_ref()?.0.try_recv() {
            Ok(line) => line,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => {
                self.terminal = None;
                return None;
            }
        };
        let text = line.trim();
        (!text.is_empty() && text.len() as u64 <= MAX_REQUEST_BYTES).then(|| text.to_owned())
    }

    /// The code of a `pair` command; looked for only while a device waits.
    fn requested(&mut self) -> Option<String> {
        self.pairing.filter(|_| self.asked.is_none())?;
        let path = self.folder.join(REQUEST_FILE);
        let request = read_small(&path)?;
        remove(&path);
        let (number, text) = request.split_once(' ')?;
        self.asked = Some(number.to_owned());
        Some(text.to_owned())
    }

    fn answer(&mut self, outcome: &Outcome) {
        let Some(number) = self.asked.take() else { return };
        let is_paired = if outcome.is_paired { "yes" } else { "no" };
        let text = format!("{number} {is_paired} {}", outcome.text);
        if let Err(error) = write(&self.folder.join(ANSWER_FILE), &text) {
            tracing::warn!("answering shadecast-server pair: {error}");
        }
    }
}

impl Drop for Codes {
    fn drop(&mut self) {
        self.answer(&Outcome { is_paired: false, text: "the server ends".to_owned() });
    }
}

/// Gives `code` to the server whose identity lies in `folder`; what it says of it.
///
/// # Errors
/// No server takes it, it leads to no pairing, or the folder cannot be written. The text says what to do.
pub fn pair(folder: &Path, code: &str) -> Result<String, String> {
    let [request, answer] = [REQUEST_FILE, ANSWER_FILE].map(|name| folder.join(name));
    let number = format!("{:016x}", u64::from_le_bytes(random_bytes()));
    remove(&answer);
    let nobody = format!(
        "no server with the identity in {} waits for a code; start it, and connect the headset: it shows the code",
        folder.display()
    );
    match write(&request, &format!("{number} {code}")) {
        Ok(()) => {}
        // No server was ever started with this folder.
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(nobody),
        Err(error) => return Err(format!("writing {}: {error}", request.display())),
    }
    if wait(TAKEN_WITHIN, || (!request.exists()).then_some(())).is_none() {
        remove(&request);
        return Err(nobody);
    }
    let own = || {
        let text = read_small(&answer)?;
        let (is_paired, text) = text.strip_prefix(&number)?.trim_start().split_once(' ')?;
        Some((is_paired == "yes", text.to_owned()))
    };
    let answered = wait(ANSWERED_WITHIN, own);
    remove(&answer);
    match answered {
        Some((true, text)) => Ok(text),
        Some((false, text)) => Err(format!("not paired: {text}")),
        None => Err("the server has taken the code, and nothing came of it; see what it says".to_owned()),
    }
}

fn wait<T>(at_most: Duration, mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let deadline = Instant::now() + at_most;
    loop {
        let seen = look();
        if seen.is_some() || Instant::now() >= deadline {
            return seen;
        }
        std::thread::sleep(LOOK_UP);
    }
}

/// The printable text of a small file; `None` where there is none yet.
fn read_small(path: &Path) -> Option<String> {
    let is_small = |metadata: fs::Metadata| metadata.is_file() && metadata.len() <= MAX_REQUEST_BYTES;
    fs::metadata(path).ok().filter(|metadata| is_small(metadata.clone()))?;
    let mut text = String::new();
    fs::File::open(path).ok()?.take(MAX_REQUEST_BYTES).read_to_string(&mut text).ok()?;
    Some(printable(&text))
}

fn write(path: &Path, text: &str) -> io::Result<()> {
    let mut file = PendingFile::create_private(path)?;
    file.write_all(text.as_bytes())?;
    file.commit()
}

/// What is not there needs no removal, and what cannot be removed is noticed by whoever waits for it.
fn remove(path: &Path) {
    let _ = fs::remove_file(path);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A server's end that waits for a device.
    fn waiting(folder: &Path) -> Codes {
        let mut codes = Codes::new(folder, None);
        codes.pairing = Some(PeerId(1));
        codes
    }

    #[test]
    fn a_given_code_is_taken_once_and_its_answer_comes_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let said = std::thread::scope(|scope| {
            let asker = scope.spawn(|| pair(folder.path(), "012345"));
            let mut codes = waiting(folder.path());
            let code = wait(TAKEN_WITHIN, || codes.requested());
            assert_eq!(code.as_deref(), Some("012345"));
            assert_eq!(codes.requested(), None, "one at a time");
            codes.answer(&Outcome { is_paired: true, text: "Paired with \"device 1\"".into() });
            asker.join().expect("it ends")
        });
        assert_eq!(said, Ok("Paired with \"device 1\"".to_owned()));
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0, "nothing is left");
    }

    #[test]
    fn a_code_that_was_given_too_early_is_refused_and_an_ending_server_says_so() {
        let folder = tempfile::tempdir().expect("a folder");
        let asked = |end: fn(Codes)| {
            std::thread::scope(|scope| {
                let asker = scope.spawn(|| pair(folder.path(), "012345"));
                let request = folder.path().join(REQUEST_FILE);
                wait(TAKEN_WITHIN, || request.exists().then_some(())).expect("it asks");
                end(waiting(folder.path()));
                asker.join().expect("it ends").expect_err("not paired")
            })
        };
        let early = asked(|mut codes| codes.refuse_early());
        assert!(early.contains("only begun to wait"), "{early}");
        let ended = asked(|mut codes| assert!(codes.requested().is_some()));
        assert!(ended.contains("the server ends"), "{ended}");
    }

    #[test]
    fn without_a_waiting_device_the_code_is_withdrawn_and_the_remedy_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut idle = Codes::new(folder.path(), None);
        write(&folder.path().join(REQUEST_FILE), "1 012345").expect("written");
        assert_eq!(idle.requested(), None);
        let said = pair(folder.path(), "012345").expect_err("nobody");
        assert!(said.contains("waits for a code; start it"), "{said}");
        assert!(!folder.path().join(REQUEST_FILE).exists());
        assert_eq!(
            pair(&folder.path().join("never"), "012345").map_err(|said| said.contains("start it")),
            Err(true)
        );
    }

    #[test]
    fn what_is_too_large_or_no_file_is_no_request() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(REQUEST_FILE);
        fs::write(&path, "1 ".repeat(200)).expect("written");
        assert_eq!(waiting(folder.path()).requested(), None);
        remove(&path);
        fs::create_dir(&path).expect("a folder in its place");
        assert_eq!(waiting(folder.path()).requested(), None);
    }
}
