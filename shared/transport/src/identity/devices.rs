//! The clients that a server serves, with what each may do.

use super::known::toml_string;
use super::{Fingerprint, IdentityError, check_is_file, create_private_directory, file_error};
use serde::Deserialize;
use shadecast_system::PendingFile;
use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// File of the paired devices inside a server's identity folder.
pub(super) const DEVICES_FILE: &str = "devices.toml";
/// Longest name of a device, bytes.
pub const MAX_NAME_BYTES: usize = 64;

/// What a device may do beside looking.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rights {
    /// Halt the world for all who look, and let it go on.
    pub halt: bool,
}

impl Rights {
    /// Looking alone.
    pub const LOOK: Self = Self { halt: false };
    /// Everything.
    pub const ALL: Self = Self { halt: true };

    /// Their names, for people and for the file.
    pub fn names(self) -> &'static [&'static str] {
        if self.halt { &["look", "halt"] } else { &["look"] }
    }
}

/// A paired device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownDevice {
    /// Its name for people; no two have the same.
    pub name: String,
    /// Of its key.
    pub fingerprint: Fingerprint,
    /// What it may do.
    pub rights: Rights,
}

/// What stands behind a name in the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    fingerprint: String,
    rights: Vec<String>,
}

/// Why the list is not changed as wanted.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// There is no such device.
    #[error("no device is called \"{name}\"; devices list names them: {}", listed(.known))]
    Unknown {
        /// What was asked for.
        name: String,
        /// What there is.
        known: Vec<String>,
    },
    /// Another one has the name.
    #[error("another device is called \"{0}\" already; choose another name, or rename that one first")]
    Taken(String),
    /// The name cannot be used.
    #[error("a name has 1 to {MAX_NAME_BYTES} bytes and no control characters")]
    Name,
    /// The file.
    #[error(transparent)]
    File(#[from] IdentityError),
}

fn listed(names: &[String]) -> String {
    if names.is_empty() { "there are none".to_owned() } else { names.join(", ") }
}

/// The paired devices of a server, in `devices.toml`: its owner's alone. Each change is written at once, and changes that others
/// have written are seen by [`Self::refresh`].
#[derive(Debug)]
pub struct KnownDevices {
    path: PathBuf,
    devices: Vec<KnownDevice>,
    /// When the file was changed last, and its size, as far as it was read.
    seen: Option<(SystemTime, u64)>,
}

impl KnownDevices {
    /// Reads the list in `directory`; without a file it is empty.
    ///
    /// # Errors
    /// The file cannot be read or understood.
    pub fn load(directory: &Path) -> Result<Self, IdentityError> {
        let mut known = Self { path: directory.join(DEVICES_FILE), devices: Vec::new(), seen: None };
        known.read()?;
        Ok(known)
    }

    /// Reads the file again where it was changed since.
    ///
    /// # Errors
    /// The file cannot be read or understood; the list stays as it was.
    pub fn refresh(&mut self) -> Result<(), IdentityError> {
        if self.stamp() == self.seen { Ok(()) } else { self.read() }
    }

    fn stamp(&self) -> Option<(SystemTime, u64)> {
        let metadata = fs::metadata(&self.path).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    }

    fn read(&mut self) -> Result<(), IdentityError> {
        if let Ok(metadata) = fs::metadata(&self.path) {
            check_is_file(&metadata, &self.path)?;
        }
        let seen = self.stamp();
        let text = match fs::read_to_string(&self.path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => String::new(),
            read => read.map_err(file_error("reading", &self.path))?,
        };
        let devices = devices_in(&text)
            .map_err(|wrong| IdentityError::KnownDevices { path: self.path.clone(), wrong })?;
        (self.devices, self.seen) = (devices, seen);
        Ok(())
    }

    /// All of them, by name.
    pub fn iter(&self) -> impl Iterator<Item = &KnownDevice> {
        self.devices.iter()
    }

    /// The device with this key.
    pub fn find(&self, fingerprint: Fingerprint) -> Option<&KnownDevice> {
        self.devices.iter().find(|device| device.fingerprint == fingerprint)
    }

    /// Keeps a device that was paired, under a name that no other has: `device 1` and so on. One that is known stays as it is.
    ///
    /// # Errors
    /// The file cannot be written; the list stays as it was.
    pub fn pair(&mut self, fingerprint: Fingerprint, rights: Rights) -> Result<KnownDevice, IdentityError> {
        self.refresh()?;
        if let Some(device) = self.find(fingerprint) {
            return Ok(device.clone());
        }
        let is_free = |name: &String| self.devices.iter().all(|device| device.name != *name);
        let name = (1..).map(|number| format!("device {number}")).find(is_free).unwrap_or_default();
        let device = KnownDevice { name, fingerprint, rights };
        let mut devices = self.devices.clone();
        devices.push(device.clone());
        self.put(devices).map(|()| device)
    }

    /// Calls a device something else.
    ///
    /// # Errors
    /// There is no such device, the name is taken or none, or the file cannot be written.
    pub fn rename(&mut self, name: &str, new: &str) -> Result<(), DeviceError> {
        if new.trim().is_empty() || new.len() > MAX_NAME_BYTES || new.chars().any(char::is_control) {
            return Err(DeviceError::Name);
        }
        if name != new && self.devices.iter().any(|device| device.name == new) {
            return Err(DeviceError::Taken(new.to_owned()));
        }
        self.change(name, |device| device.name = new.to_owned())
    }

    /// Changes what a device may do.
    ///
    /// # Errors
    /// There is no such device, or the file cannot be written.
    pub fn allow(&mut self, name: &str, rights: Rights) -> Result<(), DeviceError> {
        self.change(name, |device| device.rights = rights)
    }

    fn change(&mut self, name: &str, change: impl FnOnce(&mut KnownDevice)) -> Result<(), DeviceError> {
        let place = self.place(name)?;
        let mut devices = self.devices.clone();
        change(&mut devices[place]);
        Ok(self.put(devices)?)
    }

    /// Forgets a device: it must be paired anew. Gives its key.
    ///
    /// # Errors
    /// There is no such device, or the file cannot be written.
    pub fn forget(&mut self, name: &str) -> Result<Fingerprint, DeviceError> {
        let place = self.place(name)?;
        let mut devices = self.devices.clone();
        let forgotten = devices.remove(place);
        self.put(devices)?;
        Ok(forgotten.fingerprint)
    }

    /// Where the device of this name, or of a fingerprint that begins so, is in the list.
    fn place(&self, name: &str) -> Result<usize, DeviceError> {
        let by_name = self.devices.iter().position(|device| device.name == name);
        let by_key = || {
            let begins = |device: &KnownDevice| device.fingerprint.to_string().starts_with(name);
            let mut found = (0..self.devices.len()).filter(|&place| begins(&self.devices[place]));
            found.next().filter(|_| name.len() >= 8 && found.next().is_none())
        };
        by_name.or_else(by_key).ok_or_else(|| DeviceError::Unknown {
            name: name.to_owned(),
            known: self.devices.iter().map(|device| format!("\"{}\"", device.name)).collect(),
        })
    }

    fn put(&mut self, mut devices: Vec<KnownDevice>) -> Result<(), IdentityError> {
        devices.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some(directory) = self.path.parent() {
            create_private_directory(directory)?;
        }
        let mut text = String::from(
            "# Devices that were paired with this server, the fingerprints of their keys, and what they may do.\n",
        );
        for KnownDevice { name, fingerprint, rights } in &devices {
            let rights: Vec<String> = rights.names().iter().map(|right| format!("\"{right}\"")).collect();
            let (name, rights) = (toml_string(name), rights.join(", "));
            text += &format!("{name} = {{ fingerprint = \"{fingerprint}\", rights = [{rights}] }}\n");
        }
        let write = || {
            let mut file = PendingFile::create_private(&self.path)?;
            file.write_all(text.as_bytes())?;
            file.commit()
        };
        write().map_err(file_error("writing", &self.path))?;
        self.devices = devices;
        self.seen = self.stamp();
        Ok(())
    }
}

fn devices_in(text: &str) -> Result<Vec<KnownDevice>, String> {
    let entries: BTreeMap<String, Entry> = toml::from_str(text).map_err(|e| e.to_string())?;
    let device = |(name, entry): (String, Entry)| {
        let fingerprint = entry.fingerprint.parse().map_err(|e| format!("\"{name}\": {e}"))?;
        let mut rights = Rights::LOOK;
        for right in &entry.rights {
            match right.as_str() {
                "look" => {}
                "halt" => rights.halt = true,
                other => return Err(format!("\"{name}\": \"{other}\" is no right; look and halt are")),
            }
        }
        Ok(KnownDevice { name, fingerprint, rights })
    };
    entries.into_iter().map(device).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_system::owner;

    fn key(byte: u8) -> Fingerprint {
        Fingerprint([byte; 32])
    }

    fn names(known: &KnownDevices) -> Vec<&str> {
        known.iter().map(|device| device.name.as_str()).collect()
    }

    #[test]
    fn paired_devices_are_known_after_a_restart_and_to_their_owner_alone() {
        let folder = tempfile::tempdir().unwrap();
        let directory = folder.path().join("server");
        let mut known = KnownDevices::load(&directory).unwrap();
        assert_eq!(known.find(key(1)), None);
        known.pair(key(1), Rights::ALL).unwrap();
        known.pair(key(2), Rights::LOOK).unwrap();
        let again = known.pair(key(1), Rights::LOOK).unwrap();
        assert_eq!((again.name.as_str(), again.rights), ("device 1", Rights::ALL), "it stays as it was");
        let known = KnownDevices::load(&directory).unwrap();
        assert_eq!(known.find(key(1)), Some(&again));
        assert_eq!(known.find(key(2)).map(|device| device.rights), Some(Rights::LOOK));
        let metadata = fs::metadata(directory.join(DEVICES_FILE)).unwrap();
        assert_eq!(owner::open_to_others(&metadata), None);
    }

    #[test]
    fn devices_are_renamed_and_forgotten_by_name_or_key() {
        let folder = tempfile::tempdir().unwrap();
        let mut known = KnownDevices::load(folder.path()).unwrap();
        (1..=3).for_each(|byte| drop(known.pair(key(byte), Rights::ALL).unwrap()));
        known.rename("device 2", "Anna's \"Quest\"").unwrap();
        assert_eq!(names(&known), ["Anna's \"Quest\"", "device 1", "device 3"]);
        assert_eq!(known.forget(&key(3).to_string()[..8]).unwrap(), key(3));
        known.allow("device 1", Rights::LOOK).unwrap();
        let mut known = KnownDevices::load(folder.path()).unwrap();
        assert_eq!(names(&known), ["Anna's \"Quest\"", "device 1"]);
        assert_eq!(known.find(key(1)).map(|device| device.rights), Some(Rights::LOOK));
        assert_eq!(known.pair(key(9), Rights::ALL).unwrap().name, "device 2", "the name is free");
        let unknown = known.forget("device 7").unwrap_err().to_string();
        assert!(unknown.contains("device 7") && unknown.contains("\"device 1\""), "{unknown}");
        assert!(matches!(known.forget("01"), Err(DeviceError::Unknown { .. })), "too short to mean one");
        assert!(matches!(known.rename("device 1", "device 2"), Err(DeviceError::Taken(_))));
        for name in ["", "  ", "a\nb", &"x".repeat(65)] {
            assert!(matches!(known.rename("device 1", name), Err(DeviceError::Name)), "{name}");
        }
    }

    #[test]
    fn what_another_program_has_changed_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let mut of_server = KnownDevices::load(folder.path()).unwrap();
        of_server.pair(key(1), Rights::ALL).unwrap();
        KnownDevices::load(folder.path()).unwrap().forget("device 1").unwrap();
        of_server.refresh().unwrap();
        assert_eq!(of_server.find(key(1)), None);
        KnownDevices::load(folder.path()).unwrap().pair(key(5), Rights::ALL).unwrap();
        assert_eq!(of_server.pair(key(6), Rights::ALL).unwrap().name, "device 2", "nothing is overwritten");
    }

    #[test]
    fn a_damaged_list_is_named_with_the_remedy_and_lets_nobody_in() {
        let folder = tempfile::tempdir().unwrap();
        let mut known = KnownDevices::load(folder.path()).unwrap();
        let key = key(1);
        for text in [
            "nonsense".to_owned(),
            "\"a\" = \"12ab\"".to_owned(),
            format!("a = {{ fingerprint = \"{key}\", rights = [\"rule\"] }}"),
            format!("a = {{ fingerprint = \"{key}\" }}"),
        ] {
            fs::write(folder.path().join(DEVICES_FILE), text).unwrap();
            let message = KnownDevices::load(folder.path()).unwrap_err().to_string();
            assert!(message.contains(DEVICES_FILE) && message.contains("delete it"), "{message}");
            assert!(known.refresh().is_err() && known.find(key).is_none());
        }
    }
}
