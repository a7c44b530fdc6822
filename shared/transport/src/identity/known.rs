//! The servers that a client has met, and which it is willing to talk to.

use super::{Fingerprint, IdentityError, check_is_file, create_private_directory, file_error};
use serde::Deserialize;
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
/// known by either afterwards. The line of the name that led to a connection last says at which address that was: whoever
/// deletes it has that forgotten, too.
#[derive(Debug)]
pub struct KnownServers {
    pub(super) path: PathBuf,
    servers: BTreeMap<String, Fingerprint>,
    last: Option<LastServer>,
    /// See [`Self::with_remedy`].
    remedy: Option<String>,
}

/// The server that a client was connected to last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LastServer {
    /// What led to it, as the user writes it or as it calls itself.
    pub name: String,
    /// Where it answered.
    pub address: SocketAddr,
    /// Its key's.
    pub fingerprint: Fingerprint,
}

/// What stands behind a name or an address.
#[derive(Deserialize)]
#[serde(untagged, expecting = "this is no fingerprint between quotation marks")]
enum Entry {
    Known(String),
    Last { fingerprint: String, last_address: SocketAddr },
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
        let entries: BTreeMap<String, Entry> = toml::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        let mut known = Self { path: path.clone(), servers: BTreeMap::new(), last: None, remedy: None };
        for (name, entry) in entries {
            let (text, last_address) = match entry {
                Entry::Known(text) => (text, None),
                Entry::Last { fingerprint, last_address } => (fingerprint, Some(last_address)),
            };
            let fingerprint = text.parse().map_err(|e| wrong(format!("\"{name}\": {e}")))?;
            if let Some(address) = last_address {
                known.last = Some(LastServer { name: name.clone(), address, fingerprint });
            }
            known.servers.insert(name, fingerprint);
        }
        Ok(known)
    }

    /// For users who cannot reach the file: `remedy` is what they do in place of deleting a line, as a part of a sentence.
    pub fn with_remedy(mut self, remedy: &str) -> Self {
        self.remedy = Some(remedy.to_owned());
        self
    }

    /// The server that was connected last, if there was any since the file has told.
    pub fn last(&self) -> Option<&LastServer> {
        self.last.as_ref()
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
        let remedy = match &self.remedy {
            Some(remedy) => remedy.clone(),
            None => self.deletion([name, &address], fingerprint),
        };
        let remedy = format!("if it was set up anew, {remedy}");
        ExpectedIdentity::Pinned { fingerprint, remedy }
    }

    /// What to delete so that the server of `fingerprint` is not expected by these names any more.
    fn deletion(&self, names: [&str; 2], fingerprint: Fingerprint) -> String {
        let mut lines: Vec<&str> = names.into();
        lines.dedup();
        lines.retain(|line| self.servers.get(*line) == Some(&fingerprint));
        let lines: Vec<String> = lines.iter().map(|line| format!("\"{line}\"")).collect();
        let line = if lines.len() > 1 { "lines" } else { "line" };
        format!("delete the {line} of {} from {} and start again", lines.join(" and "), self.path.display())
    }

    /// Pins the server that answered as `name` at `address`, as the one that was connected last, and writes the list where that
    /// is news.
    pub fn remember(
        &mut self,
        name: &str,
        address: SocketAddr,
        fingerprint: Fingerprint,
    ) -> Result<Meeting, IdentityError> {
        let last = LastServer { name: name.to_owned(), address, fingerprint };
        let address = address.to_string();
        let knows = |line: &str| self.servers.get(line) == Some(&fingerprint);
        let (by_name, by_address) = (knows(name), knows(&address));
        let other = self.servers.iter().find(|(_, known)| **known == fingerprint);
        let meeting = match other {
            _ if by_name => Meeting::Again,
            Some((line, _)) => Meeting::KnownAs(line.clone()),
            None => Meeting::First,
        };
        if by_name && by_address && self.last.as_ref() == Some(&last) {
            return Ok(meeting);
        }
        self.servers.insert(name.to_owned(), fingerprint);
        self.servers.insert(address, fingerprint);
        self.last = Some(last);
        self.write().map(|()| meeting)
    }

    fn write(&self) -> Result<(), IdentityError> {
        if let Some(directory) = self.path.parent() {
            create_private_directory(directory)?;
        }
        let mut text = String::from("# Servers this client has met, and the fingerprints of their keys.\n");
        for (name, fingerprint) in &self.servers {
            let entry = match self.last.as_ref().filter(|last| last.name == *name) {
                Some(last) => {
                    format!("{{ fingerprint = \"{fingerprint}\", last_address = \"{}\" }}", last.address)
                }
                None => format!("\"{fingerprint}\""),
            };
            text += &format!("{} = {entry}\n", toml_string(name));
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
pub(super) fn toml_string(text: &str) -> String {
    let escape = |c: char| match c {
        '"' | '\\' => format!("\\{c}"),
        c if c.is_control() => format!("\\u{:04x}", u32::from(c)),
        c => c.to_string(),
    };
    format!("\"{}\"", text.chars().map(escape).collect::<String>())
}
