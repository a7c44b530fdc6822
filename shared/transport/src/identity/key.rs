//! The keys of servers and clients, the certificates that they sign for themselves, and their fingerprints.

use super::{IdentityError, check_is_file, create_private_directory, file_error, tls};
use crate::rng;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use shadecast_system::{PendingFile, owner};
use std::fmt;
use std::fs;
use std::io::Write;
use std::marker::PhantomData;
use std::path::Path;
use std::str::FromStr;

/// File of a server's private key inside its identity directory.
pub(super) const KEY_FILE: &str = "server-key.pem";
/// The same of a client's.
pub(super) const CLIENT_KEY_FILE: &str = "client-key.pem";
/// What comes before the 32 bytes of an Ed25519 key in a PKCS #8 version 1 document (RFC 8410, section 7).
const ED25519_PKCS8_PREFIX: [u8; 16] =
    [0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20];

/// SHA-256 of a public key (its `SubjectPublicKeyInfo`); written as 64 hexadecimal digits.
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

/// Two sides of one machine have a key each: whoever holds the one cannot pass for the other.
pub trait Side: sealed::Sealed {
    /// File of the private key inside the identity folder.
    const KEY_FILE: &str;
    /// For people who read the certificate; nothing depends on it.
    const COMMON_NAME: &str;
    /// Keeps the keys of equal seeds apart.
    const PURPOSE: u64;
}

mod sealed {
    pub trait Sealed {}
    impl Sealed for super::Server {}
    impl Sealed for super::Client {}
}

/// The side that serves.
#[derive(Debug)]
pub struct Server;

/// The side that connects.
#[derive(Debug)]
pub struct Client;

impl Side for Server {
    const KEY_FILE: &str = KEY_FILE;
    const COMMON_NAME: &str = "Shadecast server";
    const PURPOSE: u64 = 0x1d;
}

impl Side for Client {
    const KEY_FILE: &str = CLIENT_KEY_FILE;
    const COMMON_NAME: &str = "Shadecast client";
    const PURPOSE: u64 = 0x1e;
}

/// The key pair of a side and the self-signed certificate that carries it.
pub struct Identity<S> {
    key: rcgen::KeyPair,
    certificate: CertificateDer<'static>,
    fingerprint: Fingerprint,
    side: PhantomData<S>,
}

/// A server's.
pub type ServerIdentity = Identity<Server>;

/// A client's.
pub type ClientIdentity = Identity<Client>;

impl<S: Side> fmt::Debug for Identity<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Identity({}, {})", S::COMMON_NAME, self.fingerprint)
    }
}

impl<S: Side> Identity<S> {
    /// A new identity from the system's random numbers, kept nowhere: a stranger everywhere.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn generate() -> Result<Self, IdentityError> {
        let key = rcgen::KeyPair::generate_for(&rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| IdentityError::Generate(e.to_string()))?)
    }

    /// The identity that belongs to `seed`: for tests and virtual time, never for a server that others reach.
    ///
    /// # Errors
    /// No certificate can be made of it.
    pub fn from_seed(seed: u64) -> Result<Self, IdentityError> {
        let mut der = ED25519_PKCS8_PREFIX.to_vec();
        der.extend(rng::bytes32(seed, S::PURPOSE));
        let der = PrivatePkcs8KeyDer::from(der);
        let key = rcgen::KeyPair::from_pkcs8_der_and_sign_algo(&der, &rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| IdentityError::Generate(e.to_string()))?)
    }

    /// Reads the identity in `directory`, or makes one there at the first start (a key file that is its owner's alone).
    ///
    /// # Errors
    /// The file cannot be read or written, is open to others, or is no key.
    pub fn load_or_create(directory: &Path) -> Result<Self, IdentityError> {
        let path = directory.join(S::KEY_FILE);
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
        if let Some(mode) = owner::open_to_others(&metadata) {
            return Err(IdentityError::Permissions { path: path.into(), mode });
        }
        let wrong = |wrong: String| IdentityError::Key { path: path.into(), wrong };
        let bytes = fs::read(path).map_err(file_error("reading", path))?;
        let pem = String::from_utf8(bytes).map_err(|e| wrong(e.to_string()))?;
        let key = rcgen::KeyPair::from_pkcs8_pem_and_sign_algo(&pem, &rcgen::PKCS_ED25519);
        Self::from_key(key.map_err(|e| wrong(e.to_string()))?)
    }

    fn from_key(key: rcgen::KeyPair) -> Result<Self, IdentityError> {
        let generate = |e: rcgen::Error| IdentityError::Generate(e.to_string());
        let mut params =
            rcgen::CertificateParams::new(vec![tls::SERVER_NAME.to_owned()]).map_err(generate)?;
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(rcgen::DnType::CommonName, S::COMMON_NAME);
        // A fixed serial number: one derived from the key would change the certificate's length from key to key.
        params.serial_number = Some(rcgen::SerialNumber::from_slice(&[1]));
        let certificate = params.self_signed(&key).map_err(generate)?.der().clone();
        let fingerprint = Fingerprint::of_public_key(&rcgen::PublicKeyData::subject_public_key_info(&key));
        Ok(Self { key, certificate, fingerprint, side: PhantomData })
    }

    /// SHA-256 of the public key: what the other side pins.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    pub(crate) fn certificate(&self) -> CertificateDer<'static> {
        self.certificate.clone()
    }

    pub(crate) fn private_key(&self) -> PrivateKeyDer<'static> {
        PrivatePkcs8KeyDer::from(self.key.serialize_der()).into()
    }
}

impl ServerIdentity {
    /// A key for `purpose` that only the owner of this identity can compute, the same after each restart.
    pub(crate) fn derived_key(&self, purpose: &str) -> [u8; 32] {
        let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, self.key.serialized_der());
        let mut out = [0; 32];
        out.copy_from_slice(ring::hmac::sign(&key, purpose.as_bytes()).as_ref());
        out
    }
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
