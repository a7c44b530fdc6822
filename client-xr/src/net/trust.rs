//! Whom this client trusts, and how a server becomes known: it is paired by a code, or the user takes it. Pure: the list of known
//! servers, random bytes and time are arguments.
//!
//! A server is its key. It is pinned when it has proved that the code was typed there, when the user has taken or named it, or
//! when it runs on this machine.

use shadecast_transport::identity::pairing::{Answer, AnswerError, Closed, Code, Ends, Panel, Word};
use shadecast_transport::{Binding, Fingerprint, KnownServers};
use std::net::SocketAddr;

/// Digits of a key that are shown to be compared.
const SHOWN_DIGITS: usize = 12;

/// Who has answered on the connection that lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Met {
    pub(super) address: SocketAddr,
    pub(super) fingerprint: Fingerprint,
    pub(super) binding: Binding,
}

/// See the module.
#[derive(Default)]
pub(super) struct Trust {
    panel: Panel,
    met: Option<Met>,
    /// It has proved that the code was typed there.
    is_paired: bool,
    /// A code was shown on this connection.
    was_shown: bool,
    /// Why nothing came of the last code.
    trouble: Option<String>,
    /// An unknown server that would serve us, and what was pressed before it was shown.
    asked: Option<(Met, u32)>,
}

impl Trust {
    /// A server has answered.
    pub(super) fn met(&mut self, met: Met) {
        self.lost();
        self.met = Some(met);
    }

    /// The connection is gone.
    pub(super) fn lost(&mut self) {
        (self.met, self.is_paired, self.was_shown) = (None, false, false);
        self.panel.clear();
    }

    /// Who has answered.
    pub(super) fn whom(&self) -> Option<Met> {
        self.met
    }

    /// Whether whoever has answered is trusted without a question.
    pub(super) fn is_trusted(&self, known: &KnownServers, required: Option<Fingerprint>) -> bool {
        self.met.is_some_and(|Met { address, fingerprint, .. }| {
            let is_local = address.ip().to_canonical().is_loopback();
            self.is_paired || is_local || required == Some(fingerprint) || known.knows(fingerprint)
        })
    }

    /// The server wants to know who we are: the code to show, and what to send.
    ///
    /// # Errors
    /// Too many codes were wrong. `None` where nobody has answered.
    pub(super) fn show_code(
        &mut self,
        own: Fingerprint,
        random: &[u8; 64],
        now_ns: i64,
    ) -> Option<Result<(Code, Word), Closed>> {
        let Met { fingerprint, binding, .. } = self.met?;
        self.was_shown = true;
        Some(self.panel.begin(Ends { client: own, server: fingerprint, binding }, random, now_ns))
    }

    /// A code was typed at the server: the proof to send where it is the one that is shown.
    ///
    /// # Errors
    /// It is another one.
    pub(super) fn judge(&mut self, answer: &Answer, now_ns: i64) -> Result<Word, AnswerError> {
        let proof = self.panel.answered(answer, now_ns)?;
        self.is_paired = true;
        Ok(proof)
    }

    /// The server has refused us: after a code was shown the next one is shown with the reason.
    pub(super) fn refused(&mut self, why: &str) {
        if self.was_shown && !self.is_paired {
            self.trouble = Some(why.to_owned());
        }
    }

    /// What to show with a code.
    pub(super) fn instructions(&mut self, code: Code, server: &str) -> String {
        let trouble = self.trouble.take().map_or(String::new(), |trouble| format!("{trouble}\n"));
        format!(
            "{trouble}Pairing with {server}: type this code at the server's terminal\n{code}\n\
             or run there: shadecast-server pair {}",
            code.to_string().replace(' ', "")
        )
    }

    /// An unknown server would serve us without pairing: it is for the user to take. `takes` counts what was pressed so far.
    pub(super) fn ask(&mut self, takes: u32) -> Option<Met> {
        self.asked = self.met.map(|met| (met, takes));
        self.met
    }

    /// Whether the user is being asked.
    pub(super) fn is_asking(&self) -> bool {
        self.asked.is_some()
    }

    /// The user has pressed something: the server that is taken, if one is.
    pub(super) fn take(&mut self, takes: u32) -> Option<Met> {
        self.asked.take_if(|(_, before)| *before != takes).map(|(met, _)| met)
    }

    /// Somebody else is to be connected to.
    pub(super) fn forget_question(&mut self) {
        self.asked = None;
    }
}

/// What to say of an unknown server.
pub(super) fn question(place: &str, fingerprint: Fingerprint) -> String {
    let key = &fingerprint.to_string()[..SHOWN_DIGITS];
    format!(
        "{place} is not known here, and whoever answers may not be yours. Its identity begins with {key}; the server \
         prints its own at its start.\nTake it: trigger or Enter, or start with --fingerprint"
    )
}
