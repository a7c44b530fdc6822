//! Who a server is: an Ed25519 key kept in a file, and the client's list of the servers it has met.
//!
//! There is no certificate authority between a PC and a headset in one home. The server makes a key pair once; the
//! client pins the fingerprint of its public key at the first connection and refuses another one later.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};

use crate::files::PendingFile;
use crate::rng;

/// File of a server's private key inside its identity directory.
const KEY_FILE: &str = "server-key.pem";
/// File of the pinned servers inside a client's configuration directory.
const KNOWN_SERVERS_FILE: &str = "known_servers.toml";
/// What comes before the 32 bytes of an Ed25519 key in a PKCS #8 version 1 document (RFC 8410, section 7).
const ED25519_PKCS8_PREFIX: [u8; 16] =
    [0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20];

/// SHA-256 of a server's public key (its `SubjectPublicKeyInfo`); written as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Fingerprint(pub [u8; 32]);

impl Fingerprint {
    pub(crate) fn of_public_key(spki_der: &[u8]) -> Self {
        let digest = ring::digest::digest(&ring::digest::SHA256, spki_der);
        let mut bytes = [0; 32];
        bytes.copy_from_slice(digest.as_ref());
        Self(bytes)
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Fingerprint({self})")
    }
}

impl FromStr for Fingerprint {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.len() != 64 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(format!("\"{text}\" is not a fingerprint of 64 hexadecimal digits"));
        }
        let mut bytes = [0; 32];
        for (i, byte) in bytes.iter_mut().enumerate() {
            *byte = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).map_err(|e| e.to_string())?;
        }
        Ok(Self(bytes))
    }
}

/// Why an identity or the list of known servers could not be used.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// No directory was given and the environment names none.
    #[error(
        "there is no place for the configuration: neither XDG_CONFIG_HOME nor HOME is set; give --identity DIR"
    )]
    NoDirectory,
    /// A file or directory could not be read or written.
    #[error("{doing} {path}: {reason}")]
    File {
        /// What was being done.
        doing: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// What the system said; not called source, since who prints the chain of causes would print it twice.
        reason: io::Error,
    },
    /// There is something else in the place of a file.
    #[error("{path}: this is no file; delete it, or give another folder with --identity DIR")]
    NotAFile {
        /// Its place.
        path: PathBuf,
    },
    /// The private key can be read by other users.
    #[error("{path}: the private key can be read by others (mode {mode:04o}); run: chmod 600 {path}")]
    Permissions {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The private key file holds something else.
    #[error(
        "{path}: this is not an Ed25519 private key in PEM form ({wrong}); delete the file to get a new identity"
    )]
    Key {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        wrong: String,
    },
    /// The list of known servers cannot be understood.
    #[error("{path}: {wrong}; each line is \"host:port\" = \"fingerprint\": correct the line or delete it")]
    KnownServers {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        wrong: String,
    },
    /// Making the key or the certificate failed.
    #[error("making the server's identity: {0}")]
    Generate(String),
}

fn file_error(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> IdentityError {
    move |reason| IdentityError::File { doing, path: path.into(), reason }
}

/// Reading a pipe or a device may never end.
fn check_is_file(metadata: &fs::Metadata, path: &Path) -> Result<(), IdentityError> {
    if metadata.is_file() { Ok(()) } else { Err(IdentityError::NotAFile { path: path.into() }) }
}

/// `$XDG_CONFIG_HOME/shadecast`, or `~/.config/shadecast`.
pub fn default_directory() -> Result<PathBuf, IdentityError> {
    let from = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    from("XDG_CONFIG_HOME")
        .or_else(|| from("HOME").map(|home| home.join(".config")))
        .map(|base| base.join("shadecast"))
        .ok_or(IdentityError::NoDirectory)
}

/// A server's key pair and the self-signed certificate that carries it.
pub struct ServerIdentity {
    key: rcgen::KeyPair,
    certificate: CertificateDer<'static>,
    fingerprint: Fingerprint,
}

impl fmt::Debug for ServerIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ServerIdentity({})", self.fingerprint)
    }
}

impl ServerIdentity {
    /// A new identity from the system's random numbers, kept nowhere.
    pub fn generate() -> Result<Self, IdentityError> {
        let key = rcgen::KeyPair::generate_for(&rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| IdentityError::Generate(e.to_string()))?)
    }

    /// The identity that belongs to `seed`: for tests and virtual time, never for a server that others reach.
    pub fn from_seed(seed: u64) -> Result<Self, IdentityError> {
        let mut der = ED25519_PKCS8_PREFIX.to_vec();
        der.extend(rng::bytes32(seed, 0x1d));
        Self::from_pkcs8(der).map_err(IdentityError::Generate)
    }

    /// Reads the identity in `directory`, or makes one there at the first start (key file of mode 0600).
    pub fn load_or_create(directory: &Path) -> Result<Self, IdentityError> {
        let path = directory.join(KEY_FILE);
        if !path.exists() {
            create_private_directory(directory)?;
            let fresh = Self::generate()?;
            write_new_key(&path, &fresh.key.serialize_pem())?;
        }
        Self::load(&path)
    }

    fn load(path: &Path) -> Result<Self, IdentityError> {
        let metadata = fs::metadata(path).map_err(file_error("reading", path))?;
        check_is_file(&metadata, path)?;
        let mode = metadata.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(IdentityError::Permissions { path: path.into(), mode });
        }
        let wrong = |wrong: String| IdentityError::Key { path: path.into(), wrong };
        let bytes = fs::read(path).map_err(file_error("reading", path))?;
        let pem = String::from_utf8(bytes).map_err(|e| wrong(e.to_string()))?;
        let key = rcgen::KeyPair::from_pkcs8_pem_and_sign_algo(&pem, &rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| wrong(e.to_string()))?)
    }

    fn from_pkcs8(der: Vec<u8>) -> Result<Self, String> {
        let der = PrivatePkcs8KeyDer::from(der);
        let key = rcgen::KeyPair::from_pkcs8_der_and_sign_algo(&der, &rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| e.to_string())?).map_err(|e| e.to_string())
    }

    fn from_key(key: rcgen::KeyPair) -> Result<Self, IdentityError> {
        let generate = |e: rcgen::Error| IdentityError::Generate(e.to_string());
        let mut params =
            rcgen::CertificateParams::new(vec![crate::tls::SERVER_NAME.to_owned()]).map_err(generate)?;
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(rcgen::DnType::CommonName, "Shadecast server");
        // A fixed serial number: one derived from the key would change the certificate's length from key to key.
        params.serial_number = Some(rcgen::SerialNumber::from_slice(&[1]));
        let certificate = params.self_signed(&key).map_err(generate)?.der().clone();
        let fingerprint = Fingerprint::of_public_key(&rcgen::PublicKeyData::subject_public_key_info(&key));
        Ok(Self { key, certificate, fingerprint })
    }

    /// SHA-256 of the public key: what clients pin.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    pub(crate) fn certificate(&self) -> CertificateDer<'static> {
        self.certificate.clone()
    }

    pub(crate) fn private_key(&self) -> PrivateKeyDer<'static> {
        PrivatePkcs8KeyDer::from(self.key.serialize_der()).into()
    }

    /// A key for `purpose` that only the owner of this identity can compute, the same after each restart.
    pub(crate) fn derived_key(&self, purpose: &str) -> [u8; 32] {
        let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, self.key.serialized_der());
        let mut out = [0; 32];
        out.copy_from_slice(ring::hmac::sign(&key, purpose.as_bytes()).as_ref());
        out
    }
}

fn create_private_directory(directory: &Path) -> Result<(), IdentityError> {
    use std::os::unix::fs::DirBuilderExt;
    let mut builder = fs::DirBuilder::new();
    builder.recursive(true).mode(0o700);
    builder.create(directory).map_err(file_error("creating the directory", directory))
}

/// Puts a new key at `path`, whole or not at all. When two servers start at once, the first one's key stays.
fn write_new_key(path: &Path, pem: &str) -> Result<(), IdentityError> {
    let write = || {
        let mut file = PendingFile::create_private(path)?;
        file.write_all(pem.as_bytes())?;
        file.commit_new()
    };
    write().map(|_| ()).map_err(file_error("writing", path))
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
    path: PathBuf,
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

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().permissions().mode() & 0o777
    }

    #[test]
    fn an_identity_survives_a_restart() {
        let dir = tempfile::tempdir().unwrap();
        let directory = dir.path().join("new/shadecast");
        let first = ServerIdentity::load_or_create(&directory).unwrap();
        let second = ServerIdentity::load_or_create(&directory).unwrap();
        assert_eq!(first.fingerprint(), second.fingerprint());
        assert_eq!(first.certificate(), second.certificate());
        assert_eq!(fs::read_dir(&directory).unwrap().count(), 1, "only the key file is left");
    }

    #[test]
    fn a_pipe_in_the_place_of_a_file_is_refused_and_not_waited_for() {
        let dir = tempfile::tempdir().unwrap();
        for name in [KEY_FILE, KNOWN_SERVERS_FILE] {
            let made =
                std::process::Command::new("mkfifo").arg("-m").arg("600").arg(dir.path().join(name)).status();
            assert!(made.unwrap().success());
        }
        let key = ServerIdentity::load_or_create(dir.path()).unwrap_err();
        let known = KnownServers::load(dir.path()).unwrap_err();
        for error in [key, known] {
            assert!(matches!(error, IdentityError::NotAFile { .. }), "{error}");
            assert!(error.to_string().contains("this is no file"), "{error}");
        }
    }

    #[test]
    fn the_private_key_belongs_to_its_owner_alone() {
        let dir = tempfile::tempdir().unwrap();
        ServerIdentity::load_or_create(dir.path()).unwrap();
        let path = dir.path().join(KEY_FILE);
        assert_eq!(mode(&path), 0o600);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
        let message = ServerIdentity::load_or_create(dir.path()).unwrap_err().to_string();
        assert!(message.contains("mode 0640") && message.contains("chmod 600"), "{message}");
    }

    #[test]
    fn two_identities_differ_and_a_seed_repeats() {
        let of = |seed| ServerIdentity::from_seed(seed).unwrap();
        assert_ne!(of(1).fingerprint(), of(2).fingerprint());
        assert_eq!(of(1).certificate(), of(1).certificate());
        let fresh = || ServerIdentity::generate().unwrap().fingerprint();
        assert_ne!(fresh(), fresh());
    }

    #[test]
    fn certificates_of_all_keys_have_one_length() {
        let lengths: Vec<usize> =
            (0..300).map(|seed| ServerIdentity::from_seed(seed).unwrap().certificate().len()).collect();
        assert!(lengths.iter().all(|&length| length == lengths[0]), "{lengths:?}");
    }

    #[test]
    fn a_damaged_key_file_is_named_with_the_remedy() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(KEY_FILE);
        for content in [
            &b""[..],
            b"hello",
            b"\xff\xfe",
            b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n",
        ] {
            fs::write(&path, content).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
            let message = ServerIdentity::load_or_create(dir.path()).unwrap_err().to_string();
            assert!(message.contains(KEY_FILE) && message.contains("delete the file"), "{message}");
        }
    }

    fn at(address: &str) -> SocketAddr {
        address.parse().unwrap()
    }

    fn fingerprint(seed: u64) -> Fingerprint {
        ServerIdentity::from_seed(seed).unwrap().fingerprint()
    }

    #[track_caller]
    fn pinned(known: &KnownServers, name: &str, address: &str) -> (Fingerprint, String) {
        match known.expected(name, at(address)) {
            ExpectedIdentity::Pinned { fingerprint, remedy } => (fingerprint, remedy),
            ExpectedIdentity::TrustOnFirstUse => panic!("{name} at {address} is not pinned"),
        }
    }

    #[test]
    fn a_known_server_is_expected_the_next_time() {
        let dir = tempfile::tempdir().unwrap();
        let directory = dir.path().join("client");
        let mut known = KnownServers::load(&directory).unwrap();
        let (name, address) = ("pc.local:47800", "192.168.1.5:47800");
        assert_eq!(known.expected(name, at(address)), ExpectedIdentity::TrustOnFirstUse);
        assert_eq!(known.remember(name, at(address), fingerprint(3)).unwrap(), Meeting::First);
        assert_eq!(known.remember(name, at(address), fingerprint(3)).unwrap(), Meeting::Again);

        let known = KnownServers::load(&directory).unwrap();
        let (expected, remedy) = pinned(&known, name, address);
        assert_eq!(expected, fingerprint(3));
        for word in [name, address, KNOWN_SERVERS_FILE] {
            assert!(remedy.contains(word), "{remedy}");
        }
        assert_eq!(known.expected("other:1", at("10.0.0.1:1")), ExpectedIdentity::TrustOnFirstUse);
        assert_eq!(mode(&known.path), 0o600);
    }

    #[test]
    fn a_server_is_its_key_and_not_the_string_that_was_typed() {
        let dir = tempfile::tempdir().unwrap();
        let mut known = KnownServers::load(dir.path()).unwrap();
        let loopback = "127.0.0.1:7400";
        known.remember("localhost:7400", at(loopback), fingerprint(3)).unwrap();
        assert_eq!(pinned(&known, loopback, loopback).0, fingerprint(3), "its address is known too");
        assert_eq!(pinned(&known, "pc.local:7400", loopback).0, fingerprint(3), "whatever leads there");
        let elsewhere = at("[::1]:7400");
        assert_eq!(known.expected("[::1]:7400", elsewhere), ExpectedIdentity::TrustOnFirstUse);
        let meeting = known.remember("[::1]:7400", elsewhere, fingerprint(3)).unwrap();
        assert_eq!(meeting, Meeting::KnownAs(loopback.to_owned()), "the key is known under another name");
        assert_eq!(known.remember("[::1]:7400", elsewhere, fingerprint(3)).unwrap(), Meeting::Again);
    }

    #[test]
    fn an_address_that_went_to_another_machine_does_not_shut_out_the_one_that_is_meant() {
        let dir = tempfile::tempdir().unwrap();
        let mut known = KnownServers::load(dir.path()).unwrap();
        let address = "192.168.1.5:7400";
        known.remember("old.local:7400", at(address), fingerprint(1)).unwrap();
        known.remember("new.local:7400", at("192.168.1.6:7400"), fingerprint(2)).unwrap();
        let (expected, remedy) = pinned(&known, "new.local:7400", address);
        assert_eq!(expected, fingerprint(2), "the name counts");
        assert!(!remedy.contains(address), "the address's line is not to blame: {remedy}");
        assert_eq!(known.remember("new.local:7400", at(address), fingerprint(2)).unwrap(), Meeting::Again);
        assert_eq!(pinned(&known, address, address).0, fingerprint(2));
        assert_eq!(pinned(&known, "old.local:7400", address).0, fingerprint(1), "its name is still its own");
    }

    #[test]
    fn a_list_of_an_earlier_version_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let text = format!("# Servers this client has met.\n\"pc.local:7400\" = \"{}\"\n", fingerprint(3));
        fs::write(dir.path().join(KNOWN_SERVERS_FILE), text).unwrap();
        let mut known = KnownServers::load(dir.path()).unwrap();
        let address = "192.168.1.5:7400";
        assert_eq!(pinned(&known, "pc.local:7400", address).0, fingerprint(3));
        assert_eq!(known.remember("pc.local:7400", at(address), fingerprint(3)).unwrap(), Meeting::Again);
        assert_eq!(pinned(&known, address, address).0, fingerprint(3));
    }

    #[test]
    fn any_address_can_be_remembered() {
        let dir = tempfile::tempdir().unwrap();
        let odd = "a\"b\\c\td\u{1}é = ]:1";
        let address = at("[fe80::1%3]:7400");
        KnownServers::load(dir.path()).unwrap().remember(odd, address, Fingerprint([7; 32])).unwrap();
        let known = KnownServers::load(dir.path()).unwrap();
        assert!(matches!(known.expected(odd, at("10.0.0.1:1")), ExpectedIdentity::Pinned { .. }));
        assert!(matches!(known.expected("other:1", address), ExpectedIdentity::Pinned { .. }));
    }

    #[test]
    fn a_damaged_list_is_named_with_the_remedy() {
        let dir = tempfile::tempdir().unwrap();
        for content in ["\"a:1\" = \"12ab\"", "\"a:1\" = 3", "what is this"] {
            fs::write(dir.path().join(KNOWN_SERVERS_FILE), content).unwrap();
            let message = KnownServers::load(dir.path()).unwrap_err().to_string();
            assert!(message.contains(KNOWN_SERVERS_FILE) && message.contains("delete it"), "{message}");
        }
    }

    #[test]
    fn a_fingerprint_reads_back_as_it_is_written() {
        let fingerprint = Fingerprint(rng::bytes32(5, 5));
        assert_eq!(fingerprint.to_string().parse(), Ok(fingerprint));
        assert!("é".repeat(32).parse::<Fingerprint>().is_err());
    }
}
