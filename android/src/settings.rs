//! What a user can set on a headset, where there is no command line: one small text file in the app's folder.
//!
//! Plain data in and out, so that it is tested on the host.

use std::net::SocketAddr;

/// The file's name in the app's external folder, where `adb push` can put it.
pub const FILE_NAME: &str = "server.txt";

/// Longest file that is read, in bytes: an address and a few comments.
pub const FILE_BYTES_MAX: usize = 4096;

/// Settings of one start.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Settings {
    /// The server to connect to; `None`: as the client does without an address.
    pub connect: Option<SocketAddr>,
}

/// Why the settings file was not understood.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum SettingsError {
    /// A line is not an address.
    #[error("{FILE_NAME}:{line}: '{text}' is not IP:PORT, such as 192.168.1.20:47000")]
    Address {
        /// Line number, from 1.
        line: usize,
        /// What stood there.
        text: String,
    },
    /// A second address follows the first.
    #[error("{FILE_NAME}:{line}: a second address; keep one")]
    Second {
        /// Line number, from 1.
        line: usize,
    },
    /// The file is longer than [`FILE_BYTES_MAX`] or not text.
    #[error("{FILE_NAME}: not a text file of at most {FILE_BYTES_MAX} bytes")]
    NotText,
}

impl Settings {
    /// Reads the file's bytes: empty lines, `#` comments, and at most one `IP:PORT`.
    pub fn parse(bytes: &[u8]) -> Result<Self, SettingsError> {
        if bytes.len() > FILE_BYTES_MAX {
            return Err(SettingsError::NotText);
        }
        let text = std::str::from_utf8(bytes).map_err(|_| SettingsError::NotText)?;
        let mut settings = Self::default();
        for (index, line) in text.lines().enumerate() {
            let content = line.split('#').next().unwrap_or_default().trim();
            if content.is_empty() {
                continue;
            }
            let address = content
                .parse()
                .map_err(|_| SettingsError::Address { line: index + 1, text: content.to_owned() })?;
            if settings.connect.replace(address).is_some() {
                return Err(SettingsError::Second { line: index + 1 });
            }
        }
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn connect(text: &str) -> Option<SocketAddr> {
        Settings::parse(text.as_bytes()).expect("valid settings").connect
    }

    #[test]
    fn address_is_found_between_comments() {
        let text = "# living room\r\n\r\n 192.168.1.20:47000 # the desktop\r\n";
        assert_eq!(connect(text), Some(SocketAddr::from(([192, 168, 1, 20], 47000))));
    }

    #[test]
    fn ipv6_address_needs_brackets() {
        assert_eq!(connect("[::1]:5"), Some("[::1]:5".parse().expect("literal")));
        assert!(Settings::parse(b"fe80::1:5 x").is_err());
    }

    #[test]
    fn empty_file_leaves_the_choice_to_the_client() {
        assert_eq!(connect(""), None);
        assert_eq!(connect("# nothing\n"), None);
    }

    #[test]
    fn error_names_line_and_text() {
        let error = Settings::parse(b"\nmy-pc\n").expect_err("no address");
        assert_eq!(error.to_string(), "server.txt:2: 'my-pc' is not IP:PORT, such as 192.168.1.20:47000");
    }

    #[test]
    fn second_address_is_refused() {
        assert_eq!(Settings::parse(b"1.2.3.4:5\n1.2.3.4:6"), Err(SettingsError::Second { line: 2 }));
    }

    #[test]
    fn bytes_that_are_not_text_are_refused() {
        assert_eq!(Settings::parse(&[0xff, 0xfe]), Err(SettingsError::NotText));
        assert_eq!(Settings::parse(&[b'\n'; FILE_BYTES_MAX + 1]), Err(SettingsError::NotText));
    }
}
