//! What a user can set on a headset, where there is no command line: one small text file in the app's folder.
//!
//! Plain data in and out, so that it is tested on the host.

/// The file's name in the app's external folder, where `adb push` can put it.
pub const FILE_NAME: &str = "server.txt";

/// Longest file that is read, in bytes: an address and a few comments.
pub const FILE_BYTES_MAX: usize = 4096;

/// What is tried without a file: a server that announces itself on this network. The client's own word for that
/// (`shadecast_client::net::FIND`), which the host's tests of this file do without.
pub const DEFAULT_SERVER: &str = "find";

/// Settings of one start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Settings {
    /// The server to connect to, as `HOST:PORT`, or `find`.
    pub server: String,
}

impl Default for Settings {
    fn default() -> Self {
        Self { server: DEFAULT_SERVER.to_owned() }
    }
}

/// Why the settings file was not understood.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum SettingsError {
    /// A line is not an address.
    #[error("{FILE_NAME}:{line}: '{text}' is neither find nor HOST:PORT, such as 192.168.1.20:7400")]
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
    /// Reads the file's bytes: empty lines, `#` comments, and at most one `HOST:PORT`, or `find`.
    pub fn parse(bytes: &[u8]) -> Result<Self, SettingsError> {
        if bytes.len() > FILE_BYTES_MAX {
            return Err(SettingsError::NotText);
        }
        let text = std::str::from_utf8(bytes).map_err(|_| SettingsError::NotText)?;
        let mut server = None;
        for (index, line) in text.lines().enumerate() {
            let content = line.split('#').next().unwrap_or_default().trim();
            if content.is_empty() {
                continue;
            }
            if content != DEFAULT_SERVER && !is_address(content) {
                return Err(SettingsError::Address { line: index + 1, text: content.to_owned() });
            }
            if server.replace(content.to_owned()).is_some() {
                return Err(SettingsError::Second { line: index + 1 });
            }
        }
        Ok(server.map_or_else(Self::default, |server| Self { server }))
    }
}

/// Looks like `HOST:PORT`; whether the host is known only the network can say. An IPv6 host stands in brackets.
fn is_address(text: &str) -> bool {
    let Some((host, port)) = text.rsplit_once(':') else { return false };
    let is_bracketed = host.starts_with('[') && host.ends_with(']');
    let is_host =
        !host.is_empty() && !host.contains(char::is_whitespace) && (is_bracketed || !host.contains(':'));
    is_host && port.parse::<u16>().is_ok_and(|port| port > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(text: &str) -> String {
        Settings::parse(text.as_bytes()).expect("valid settings").server
    }

    #[test]
    fn address_is_found_between_comments() {
        assert_eq!(server("# living room\r\n\r\n 192.168.1.20:7400 # the desktop\r\n"), "192.168.1.20:7400");
        assert_eq!(server("desktop.local:7401"), "desktop.local:7401");
    }

    #[test]
    fn ipv6_address_needs_brackets() {
        assert_eq!(server("[fe80::1]:7400"), "[fe80::1]:7400");
        assert!(Settings::parse(b"fe80::1:7400").is_err());
    }

    #[test]
    fn file_without_address_means_the_default() {
        assert_eq!(server(""), DEFAULT_SERVER);
        assert_eq!(server("# nothing\n"), DEFAULT_SERVER);
        assert_eq!(server("find"), DEFAULT_SERVER);
    }

    #[test]
    fn host_and_port_are_both_wanted() {
        for wrong in ["desktop", ":7400", "desktop:", "desktop:0", "desktop:70000", "my desktop:7400"] {
            let error = Settings::parse(wrong.as_bytes()).expect_err(wrong);
            assert_eq!(error, SettingsError::Address { line: 1, text: wrong.to_owned() });
        }
    }

    #[test]
    fn error_names_line_and_text() {
        let error = Settings::parse(b"\nmy-pc\n").expect_err("no port");
        assert_eq!(
            error.to_string(),
            "server.txt:2: 'my-pc' is neither find nor HOST:PORT, such as 192.168.1.20:7400"
        );
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
