//! The six digits.

use std::fmt;
use std::str::FromStr;

/// Codes that there are.
const CODES: u64 = 1_000_000;
/// Digits of a code.
const DIGITS: usize = 6;

/// Six digits, shown by a headset and typed at a server.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Code(u32);

/// What was typed is no code.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("this is no code; a code has six digits, such as 123 456, and the headset shows it")]
pub struct CodeError;

impl Code {
    /// The code of these random bytes: each code is as likely as any other, but for one part in 10^13.
    pub(super) fn from_random(bytes: [u8; 8]) -> Self {
        Self((u64::from_le_bytes(bytes) % CODES) as u32)
    }

    /// Its digits, as the password of the exchange.
    pub(super) fn digits(self) -> String {
        format!("{:06}", self.0)
    }
}

impl fmt::Display for Code {
    /// In two groups: `123 456`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (left, right) = (self.0 / 1000, self.0 % 1000);
        write!(f, "{left:03} {right:03}")
    }
}

impl fmt::Debug for Code {
    /// Without the digits: logs are read by others.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Code(..)")
    }
}

impl FromStr for Code {
    type Err = CodeError;

    /// Spaces and hyphens between the digits are the writer's own affair.
    fn from_str(text: &str) -> Result<Self, CodeError> {
        let digits: String = text.chars().filter(|c| !matches!(c, ' ' | '-' | '\t' | '\r' | '\n')).collect();
        if digits.len() != DIGITS || !digits.bytes().all(|b| b.is_ascii_digit()) {
            return Err(CodeError);
        }
        digits.parse().map(Self).map_err(|_| CodeError)
    }
}
