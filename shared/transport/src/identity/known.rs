//! The servers that a client has met, and which it is willing to talk to.

use super::{Fingerprint, IdentityError, check_is_file, create_private_directory, file_error};
use shadecast_system::PendingFile;
use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// File of the pinned servers inside a client's configuration directory.
pub(super) const KNOWN_SERVERS_FILE: &str = "known_servers.toml";
/// Which server a client is willing to talk to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ExpectedIdentity {
    /// Any: it is the first meeting. The fingerprint comes with the `Connected` event and is then to be kept.
    TrustOnFirstUse,
    /// The one with this fingerprint.
    Pinned {
        /// The fingerprint of its public key.
        fingerprint: Fingerprint,
        /// What a user does to accept another server, as the end of a sentence.
        remedy: String,
    },
}

/// The servers a client has met, in `known_servers.toml`: a line for each name and address, with the fingerprint of the
/// server there.
///
/// A server is its key. What the user typed and the address that answered are two lines of one server, so that it is
/// known by either afterwards.
#[derive(Debug)]
pub struct KnownServers {
    pub(super) path: PathBuf,
    servers: BTreeMap<String, Fingerprint>,
}

/// How a client knows the server that it has reached.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Meeting {
    /// Under this name or address.
    Again,
    /// Under another one: this.
    KnownAs(String),
    /// Not at all; from now on it does.
    First,
}

impl KnownServers {
    /// Reads the list in `directory`; without a file it is empty.
    pub fn load(directory: &Path) -> Result<Self, IdentityError> {
        let path = directory.join(KNOWN_SERVERS_FILE);
        if let Ok(metadata) = fs::metadata(&path) {
            check_is_file(&metadata, &path)?;
        }
        let text = match fs::read_to_string(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => String::new(),
            read => read.map_err(file_error("reading", &path))?,
        };
        let wrong = |wrong: String| IdentityError::KnownServers { path: path.clone(), wrong };
        let lines: BTreeMap<String, String> = toml::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        let parse = |(address, text): (String, String)| match text.parse() {
            Ok(fingerprint) => Ok((address, fingerprint)),
            Err(e) => Err(wrong(format!("\"{address}\": {e}"))),
        };
        let servers = lines.into_iter().map(parse).collect::<Result<_, _>>()?;
        Ok(Self { path, servers })
    }

    /// Whether the server with this key was met before, wherever.
    pub fn knows(&self, fingerprint: Fingerprint) -> bool {
        self.servers.values().any(|known| *known == fingerprint)
    }

    /// Whom to expect at `address`, to which `name` (`host:port`, as the user writes it) leads. The name's line counts
    /// before the address's: addresses go from one machine to another.
    pub fn expected(&self, name: &str, address: SocketAddr) -> ExpectedIdentity {
        let address = address.to_string();
        let Some(&fingerprint) = self.servers.get(name).or_else(|| self.servers.get(&address)) else {
            return ExpectedIdentity::TrustOnFirstUse;
        };
        let mut lines = vec![name];
        if address != name {
            lines.push(&address);
        }
        lines.retain(|line| self.servers.get(*line) == Some(&fingerprint));
        let lines: Vec<String> = lines.iter().map(|line| format!("\"{line}\"")).collect();
        let (line, begins) = if lines.len() > 1 { ("lines", "begin") } else { ("line", "begins") };
        let remedy = format!(
            "if the server was set up anew, delete the {line} that {begins} with {} from {} and connect again",
            lines.join(" and "),
            self.path.display()
        );
        ExpectedIdentity::Pinned { fingerprint, remedy }
    }

    /// Pins the server that answered as `name` at `address`, and writes the list where that is news.
    pub fn remember(
        &mut self,
        name: &str,
        address: SocketAddr,
        fingerprint: Fingerprint,
    ) -> Result<Meeting, IdentityError> {
        let address = address.to_string();
        let knows = |line: &str| self.servers.get(line) == Some(&fingerprint);
        let (by_name, by_address) = (knows(name), knows(&address));
        if by_name && by_address {
            return Ok(Meeting::Again);
        }
        let other = self.servers.iter().find(|(_, known)| **known == fingerprint);
        let meeting = match other {
            _ if by_name => Meeting::Again,
            Some((line, _)) => Meeting::KnownAs(line.clone()),
            None => Meeting::First,
        };
        self.servers.insert(name.to_owned(), fingerprint);
        self.servers.insert(address, fingerprint);
        self.write().map(|()| meeting)
    }

    fn write(&self) -> Result<(), IdentityError> {
        if let Some(directory) = self.path.parent() {
            create_private_directory(directory)?;
        }
        let mut text = String::from("# Servers this client has met, and the fingerprints of their keys.\n");
        for (line, fingerprint) in &self.servers {
            text += &format!("{} = \"{fingerprint}\"\n", toml_string(line));
        }
        let write = || {
            let mut file = PendingFile::create_private(&self.path)?;
            file.write_all(text.as_bytes())?;
            file.commit()
        };
        write().map_err(file_error("writing", &self.path))
    }
}

/// `text` as a basic string of TOML.
fn toml_string(text: &str) -> String {
    let escape = |c: char| match c {
        '"' | '\\' => format!("\\{c}"),
        c if c.is_control() => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    format!("\"{}\"", text.chars().map(escape).collect::<String>())
}
