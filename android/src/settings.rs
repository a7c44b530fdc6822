//! Settings of a headset, which has no command line: a small text file in the app's folder, and the extras of the intent that
//! starts the app. The extras take precedence.
//!
//! Pure: plain data enters and leaves, and the tests run on the host.

use shadecast_transport::Fingerprint;
use std::fmt;
use std::net::SocketAddr;

/// The file's name in the app's external folder, where `adb push` can put it.
pub const FILE_NAME: &str = "server.txt";

/// Longest file that is read, in bytes: an address, a few settings and comments.
pub const FILE_BYTES_MAX: usize = 4096;

/// What is tried without an address: a server that announces itself on this network. The client's own word for that
/// (`shadecast_client::net::FIND`), which the host's tests of this file do without.
pub const DEFAULT_SERVER: &str = "find";

/// What a user does so that the app forgets which servers it knows, as a part of a sentence: their list is in the app's own
/// folder, which nobody can open.
pub const FORGETTING: &str =
    "clear this app's data in the headset's settings, or run: adb shell pm clear org.shadecast.client";

/// Frames a second that can be asked for, as on the desktop.
const REFRESH_HZ: std::ops::RangeInclusive<f32> = 1.0..=1000.0;

/// Characters of a wrong value that are said again: a headset has few rows.
const SHOWN_CHARACTERS: usize = 40;

/// No server has this key. Who demands one and writes it wrong must not be shown to another.
const NOBODY: Fingerprint = Fingerprint([0; 32]);

/// What can be set. The names are those of the extras, and of the file's lines but for the server, which stands alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// The server to connect to, as `HOST:PORT`, or `find`.
    Server,
    /// The only identity that the server may have.
    Fingerprint,
    /// Frames a second that the headset is asked for.
    Refresh,
    /// How much less is shaded towards the border.
    Foveation,
}

impl Key {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Server, Self::Fingerprint, Self::Refresh, Self::Foveation];

    /// What it is called.
    pub fn name(self) -> &'static str {
        match self {
            Self::Server => "server",
            Self::Fingerprint => "fingerprint",
            Self::Refresh => "refresh",
            Self::Foveation => "foveation",
        }
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How much less is shaded towards the border. The client's own has the same levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Foveation {
    /// All is shaded.
    None,
    /// Hardly seen.
    Low,
    /// In between.
    Medium,
    /// Seen where a lens is sharp to its border.
    High,
}

/// Settings of one start; what is `None` is the client's choice.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    server: Option<String>,
    /// The intent has named the server or its identity, which any app could have sent.
    is_of_intent: bool,
    /// The only identity that the server may have.
    pub fingerprint: Option<Fingerprint>,
    /// Frames a second that the headset is asked for.
    pub refresh_hz: Option<f32>,
    /// How much less is shaded towards the border.
    pub foveation: Option<Foveation>,
}

/// What is wrong with a value.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum Wrong {
    /// It is not an address.
    #[error("'{0}' is neither find nor HOST:PORT, such as 192.168.1.20:7400")]
    Address(String),
    /// It is not a fingerprint.
    #[error(
        "'{0}' is not a fingerprint, so every server is refused; write the 64 digits printed by the server"
    )]
    Fingerprint(String),
    /// It is not a rate.
    #[error("'{0}' is not a number of frames a second, such as 90")]
    Refresh(String),
    /// It is not a level.
    #[error("'{0}' is not a foveation level; write none, low, medium or high")]
    Foveation(String),
    /// Nothing of this name can be set.
    #[error("there is no setting '{0}'; settings are fingerprint, refresh and foveation")]
    Name(String),
    /// It was set before.
    #[error("a second {0}; keep one")]
    Second(Key),
}

/// Why settings were not understood. The others count all the same.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum SettingsError {
    /// A line of the file.
    #[error("{FILE_NAME}:{line}: {wrong}")]
    Line {
        /// Line number, from 1.
        line: usize,
        /// What is wrong with it.
        wrong: Wrong,
    },
    /// An extra of the intent.
    #[error("--es {key}: {wrong}")]
    Extra {
        /// Its name.
        key: Key,
        /// What is wrong with it.
        wrong: Wrong,
    },
    /// The file is longer than [`FILE_BYTES_MAX`] or not text.
    #[error("{FILE_NAME}: not a text file of at most {FILE_BYTES_MAX} bytes")]
    NotText,
}

impl Settings {
    /// Those of the extras, and for what these leave out those of the file's bytes.
    pub fn gather(extras: &[(Key, String)], file: &[u8]) -> (Self, Vec<SettingsError>) {
        let mut errors = Vec::new();
        let mut of_extras = Self::default();
        for (key, text) in extras {
            if let Err(wrong) = of_extras.set(*key, text.trim()) {
                errors.push(SettingsError::Extra { key: *key, wrong });
            }
        }
        let names_server = of_extras.server.as_deref().is_some_and(|server| server != DEFAULT_SERVER);
        of_extras.is_of_intent = names_server || of_extras.fingerprint.is_some();
        let of_file = Self::parse(file, &mut errors);
        (of_extras.or(of_file), errors)
    }

    /// The server to connect to, as `HOST:PORT`, or `find`.
    pub fn server(&self) -> &str {
        self.server.as_deref().unwrap_or(DEFAULT_SERVER)
    }

    /// Whether the user is to agree before an unknown server is dialled. The user's own file needs no such question.
    pub fn asks_first(&self) -> bool {
        self.is_of_intent
    }

    /// The file's: empty lines, `#` comments, at most one `HOST:PORT`, or `find`, and `name = value`.
    fn parse(bytes: &[u8], errors: &mut Vec<SettingsError>) -> Self {
        let mut settings = Self::default();
        let text = std::str::from_utf8(bytes).ok().filter(|_| bytes.len() <= FILE_BYTES_MAX);
        let Some(text) = text else {
            errors.push(SettingsError::NotText);
            return settings;
        };
        for (index, line) in text.lines().enumerate() {
            let content = line.split('#').next().unwrap_or_default().trim();
            if content.is_empty() {
                continue;
            }
            if let Err(wrong) = settings.take(content) {
                errors.push(SettingsError::Line { line: index + 1, wrong });
            }
        }
        settings
    }

    /// Takes a line of the file.
    fn take(&mut self, content: &str) -> Result<(), Wrong> {
        let Some((name, value)) = content.split_once('=') else { return self.set(Key::Server, content) };
        let key = Key::ALL.into_iter().find(|key| key.name() == name.trim());
        self.set(key.ok_or_else(|| Wrong::Name(shortened(name.trim())))?, value.trim())
    }

    fn set(&mut self, key: Key, text: &str) -> Result<(), Wrong> {
        let is_second = match key {
            Key::Server => self.server.is_some(),
            Key::Fingerprint => self.fingerprint.is_some(),
            Key::Refresh => self.refresh_hz.is_some(),
            Key::Foveation => self.foveation.is_some(),
        };
        if is_second {
            return Err(Wrong::Second(key));
        }
        match key {
            Key::Server if text == DEFAULT_SERVER || is_address(text) => self.server = Some(text.to_owned()),
            Key::Server => return Err(Wrong::Address(shortened(text))),
            Key::Fingerprint => {
                let fingerprint = text.parse();
                self.fingerprint = Some(*fingerprint.as_ref().unwrap_or(&NOBODY));
                fingerprint.map_err(|_| Wrong::Fingerprint(shortened(text)))?;
            }
            Key::Refresh => {
                let rate = text.parse().ok().filter(|rate| REFRESH_HZ.contains(rate));
                self.refresh_hz = Some(rate.ok_or_else(|| Wrong::Refresh(shortened(text)))?);
            }
            Key::Foveation => self.foveation = Some(foveation(text)?),
        }
        Ok(())
    }

    fn or(self, other: Self) -> Self {
        Self {
            server: self.server.or(other.server),
            is_of_intent: self.is_of_intent || other.is_of_intent,
            fingerprint: self.fingerprint.or(other.fingerprint),
            refresh_hz: self.refresh_hz.or(other.refresh_hz),
            foveation: self.foveation.or(other.foveation),
        }
    }
}

fn foveation(text: &str) -> Result<Foveation, Wrong> {
    match text {
        "none" => Ok(Foveation::None),
        "low" => Ok(Foveation::Low),
        "medium" => Ok(Foveation::Medium),
        "high" => Ok(Foveation::High),
        _ => Err(Wrong::Foveation(shortened(text))),
    }
}

/// Has the form `HOST:PORT`; whether the host is known only the network can say. An IPv6 host stands in brackets.
fn is_address(text: &str) -> bool {
    if let Ok(address) = text.parse::<SocketAddr>() {
        return address.port() > 0;
    }
    let Some((host, port)) = text.rsplit_once(':') else { return false };
    let is_host = !host.is_empty() && !host.contains(|c: char| c.is_whitespace() || "[:]".contains(c));
    is_host && port.parse::<u16>().is_ok_and(|port| port > 0)
}

fn shortened(text: &str) -> String {
    let shown: String = text.chars().take(SHOWN_CHARACTERS).collect();
    if shown.len() < text.len() { shown + "..." } else { shown }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_file(text: &str) -> (Settings, Vec<SettingsError>) {
        Settings::gather(&[], text.as_bytes())
    }

    #[track_caller]
    fn server(text: &str) -> String {
        let (settings, errors) = of_file(text);
        assert_eq!(errors, [], "{text}");
        settings.server().to_owned()
    }

    #[track_caller]
    fn refusal(text: &str) -> String {
        let (settings, errors) = of_file(text);
        assert_eq!((settings.server(), errors.len()), (DEFAULT_SERVER, 1), "{text}: {errors:?}");
        errors[0].to_string()
    }

    #[test]
    fn address_is_found_between_comments() {
        assert_eq!(server("# living room\r\n\r\n 192.168.1.20:7400 # the desktop\r\n"), "192.168.1.20:7400");
        assert_eq!(server("desktop.local:7401"), "desktop.local:7401");
    }

    #[test]
    fn ipv6_address_needs_brackets() {
        assert_eq!(server("[fe80::1]:7400"), "[fe80::1]:7400");
        refusal("fe80::1:7400");
        refusal("[desktop]:7400");
    }

    #[test]
    fn file_without_address_means_the_default() {
        assert_eq!(server(""), DEFAULT_SERVER);
        assert_eq!(server("# nothing\n"), DEFAULT_SERVER);
        assert_eq!(server("find"), DEFAULT_SERVER);
    }

    #[test]
    fn host_and_port_are_both_wanted() {
        for wrong in
            ["desktop", ":7400", "desktop:", "desktop:0", "desktop:70000", "my desktop:7400", "1.2.3.4:0"]
        {
            assert!(refusal(wrong).contains(&format!("'{wrong}' is neither find nor HOST:PORT")), "{wrong}");
        }
    }

    #[test]
    fn error_names_line_and_text_and_not_all_of_a_long_one() {
        assert_eq!(
            refusal("\nmy-pc\n"),
            "server.txt:2: 'my-pc' is neither find nor HOST:PORT, such as 192.168.1.20:7400"
        );
        assert!(refusal(&"é".repeat(1000)).len() < 200);
    }

    #[test]
    fn a_second_address_is_refused_and_the_first_one_counts() {
        let (settings, errors) = of_file("1.2.3.4:5\n1.2.3.4:6");
        assert_eq!(settings.server(), "1.2.3.4:5");
        assert_eq!(errors, [SettingsError::Line { line: 2, wrong: Wrong::Second(Key::Server) }]);
    }

    #[test]
    fn bytes_that_are_not_text_are_refused() {
        for bytes in [&[0xff, 0xfe][..], &[b'\n'; FILE_BYTES_MAX + 1]] {
            assert_eq!(Settings::gather(&[], bytes), (Settings::default(), vec![SettingsError::NotText]));
        }
    }

    #[test]
    fn the_file_sets_rate_foveation_and_identity_too() {
        let id = "ab".repeat(32);
        let (settings, errors) =
            of_file(&format!("find\nrefresh = 90\nfoveation=high\nfingerprint = {id}\n"));
        let expected = Settings {
            server: Some("find".into()),
            is_of_intent: false,
            fingerprint: id.parse().ok(),
            refresh_hz: Some(90.0),
            foveation: Some(Foveation::High),
        };
        assert!(expected.fingerprint.is_some());
        assert_eq!((settings, errors), (expected, vec![]));
    }

    #[test]
    fn a_wrong_setting_is_named_and_the_others_count() {
        for (wrong, word) in [
            ("refresh = fast", "frames a second"),
            ("refresh = 0", "frames a second"),
            ("refresh = NaN", "frames a second"),
            ("foveation = much", "none, low, medium or high"),
            ("colour = red", "there is no setting 'colour'"),
            ("=", "there is no setting ''"),
        ] {
            let (settings, errors) = of_file(&format!("{wrong}\ndesktop:7400"));
            assert_eq!((settings.server(), errors.len()), ("desktop:7400", 1), "{errors:?}");
            let said = errors[0].to_string();
            assert!(said.starts_with("server.txt:1: ") && said.contains(word), "{said}");
        }
    }

    #[test]
    fn a_malformed_fingerprint_accepts_no_server() {
        let (settings, errors) = of_file("fingerprint = 12ab");
        assert_eq!((settings.fingerprint, errors.len()), (Some(NOBODY), 1));
        assert!(errors[0].to_string().contains("every server is refused"), "{}", errors[0]);
    }

    #[test]
    fn extras_of_the_intent_count_before_the_file() {
        let extra = |key, text: &str| (key, text.to_owned());
        let extras = [extra(Key::Server, "192.168.1.5:7400"), extra(Key::Refresh, "90.0")];
        let file = b"desktop:7400\nrefresh = 72\nfoveation = none";
        let (settings, errors) = Settings::gather(&extras, file);
        assert_eq!((settings.server(), settings.refresh_hz), ("192.168.1.5:7400", Some(90.0)));
        assert_eq!((settings.foveation, errors), (Some(Foveation::None), vec![]), "the file adds to them");
    }

    #[test]
    fn a_server_or_identity_of_the_intent_is_asked_about_and_those_of_the_file_are_not() {
        let id = "ab".repeat(32);
        let asks = |extras: &[(Key, &str)], file: &str| {
            let extras: Vec<_> = extras.iter().map(|(key, text)| (*key, (*text).to_owned())).collect();
            Settings::gather(&extras, file.as_bytes()).0.asks_first()
        };
        assert!(asks(&[(Key::Server, "192.168.1.5:7400")], "192.168.1.5:7400"));
        assert!(asks(&[(Key::Fingerprint, &id)], "192.168.1.5:7400"));
        assert!(!asks(&[], &format!("192.168.1.5:7400\nfingerprint = {id}")));
        assert!(!asks(&[(Key::Server, "find"), (Key::Refresh, "90")], "desktop:7400"));
    }

    #[test]
    fn a_wrong_extra_is_named() {
        let (_, errors) = Settings::gather(&[(Key::Server, "my-pc".to_owned())], b"");
        assert_eq!(
            errors[0].to_string(),
            "--es server: 'my-pc' is neither find nor HOST:PORT, such as 192.168.1.20:7400"
        );
    }

    #[test]
    fn the_app_whose_data_is_to_be_cleared_is_this_one() {
        let manifest = include_str!("../AndroidManifest.xml");
        let (_, package) = FORGETTING.rsplit_once(' ').expect("a command");
        assert!(manifest.contains(&format!("package=\"{package}\"")), "{package}");
    }
}
