//! Who servers and clients are: an Ed25519 key each, kept in a file, and the lists of those they have met.
//!
//! There is no certificate authority between a PC and a headset in one home. Each installation makes a key pair once. Both
//! sides of a connection prove that they have theirs; the client pins the fingerprint of the server's public key and refuses
//! another one later.

mod devices;
mod key;
mod known;
pub mod pairing;
pub(crate) mod tls;

pub use devices::{DeviceError, KnownDevice, KnownDevices, MAX_NAME_BYTES, Rights};
pub use key::{ClientIdentity, Fingerprint, ServerIdentity};
pub use known::{ExpectedIdentity, KnownServers, LastServer, Meeting};

use shadecast_system::folders::CONFIGURATION_VARIABLES;
use shadecast_system::{folders, owner};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Why an identity or the list of known servers could not be used.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// No directory was given and the environment names none.
    #[error("there is no configuration folder: set {} or give --identity DIR", CONFIGURATION_VARIABLES)]
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
    #[error("{path}: this is not a file; delete it, or give another folder with --identity DIR")]
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
    /// The list of paired devices cannot be understood.
    #[error(
        "{path}: {wrong}; each line is \"name\" = {{ fingerprint = \"...\", rights = [\"look\"] }}: correct the line or delete it"
    )]
    KnownDevices {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        wrong: String,
    },
    /// Making the key or the certificate failed.
    #[error("making an identity: {0}")]
    Generate(String),
}

fn file_error(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> IdentityError {
    move |reason| IdentityError::File { doing, path: path.into(), reason }
}

/// Reading a pipe or a device may never end.
fn check_is_file(metadata: &fs::Metadata, path: &Path) -> Result<(), IdentityError> {
    if metadata.is_file() { Ok(()) } else { Err(IdentityError::NotAFile { path: path.into() }) }
}

/// The user's folder for the configuration: [`folders::configuration`].
pub fn default_directory() -> Result<PathBuf, IdentityError> {
    folders::configuration(|name| std::env::var_os(name)).ok_or(IdentityError::NoDirectory)
}

fn create_private_directory(directory: &Path) -> Result<(), IdentityError> {
    owner::make_folder(directory).map_err(file_error("creating the directory", directory))
}

#[cfg(test)]
mod tests;
