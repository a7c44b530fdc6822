//! The client's half: the code on the headset's panel.

use super::exchange::{Offered, Stream};
use super::lockout::{Closed, Lockout};
use super::{Answer, Code, Ends, Word, WrongCode};

/// Why an answer proves nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AnswerError {
    /// The code is used up: a new one is to be shown.
    #[error(transparent)]
    Wrong(#[from] WrongCode),
    /// There is no code that it could be about.
    #[error("the server answers a code that is not shown")]
    Unasked,
}

/// Shows a code for a server, and judges its answer. One for all servers: whoever guesses at one code guesses at all.
#[derive(Default)]
pub struct Panel {
    lockout: Lockout,
    shown: Option<Offered>,
}

impl Panel {
    /// Nothing is shown.
    pub fn new() -> Self {
        Self::default()
    }

    /// A new code to show, and what the server is to be sent with it. An earlier code is worth nothing from now on.
    ///
    /// # Errors
    /// Pairing is closed after wrong codes.
    pub fn begin(&mut self, ends: Ends, random: &[u8; 64], now_ns: i64) -> Result<(Code, Word), Closed> {
        self.shown = None;
        self.lockout.check(now_ns)?;
        let (mut random, mut bytes) = (Stream::new(random), [0; 8]);
        random.fill(&mut bytes);
        let code = Code::from_random(bytes);
        let offered = Offered::new(code, ends, &mut random);
        let element = offered.element();
        self.shown = Some(offered);
        Ok((code, element))
    }

    /// Judges the server's answer: where it is right, the server is the one at which the code was typed, and the returned
    /// proof is for it. A code serves once.
    ///
    /// # Errors
    /// The answer was made with another code or for another connection, or nothing was shown.
    pub fn answered(&mut self, answer: &Answer, now_ns: i64) -> Result<Word, AnswerError> {
        let shown = self.shown.take().ok_or(AnswerError::Unasked)?;
        match shown.finish(answer) {
            Ok(proof) => {
                self.lockout.succeeded();
                Ok(proof)
            }
            Err(wrong) => {
                self.lockout.failed(now_ns);
                Err(wrong.into())
            }
        }
    }

    /// The connection for which a code was shown is gone.
    pub fn clear(&mut self) {
        self.shown = None;
    }

    /// Whether a code is shown.
    pub fn is_shown(&self) -> bool {
        self.shown.is_some()
    }
}
