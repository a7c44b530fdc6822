//! Atomic files: written beside their place, then moved to it.
//!
//! A stopped program leaves the previous file, and a reader never sees half a file.

use crate::owner;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};

/// Numbers the files of this process, so that two threads that write the same file do not meet.
static COUNTER: AtomicU32 = AtomicU32::new(0);

/// Files that are being written beside their places now.
static PENDING: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

fn with_pending<R>(body: impl FnOnce(&mut Vec<PathBuf>) -> R) -> R {
    body(&mut PENDING.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Removes what is being written beside its place: for a process that ends at once and drops nothing.
pub fn remove_pending_files() {
    with_pending(|pending| pending.drain(..).for_each(|beside| drop(fs::remove_file(beside))));
}

/// Puts `bytes` at `path`, whole or not at all.
///
/// # Errors
/// What the system says; the file at `path` is then as it was.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = PendingFile::create(path)?;
    file.write_all(bytes)?;
    file.commit()
}

/// A file that is being written beside its place. [`Self::commit`] moves it there; dropped without, it is removed.
///
/// What is no regular file (a pipe, a terminal, `/dev/stdout`) is written to directly, since it cannot be replaced.
#[derive(Debug)]
pub struct PendingFile {
    file: File,
    /// The file beside and the place; `None` once moved, or where the place is written to directly.
    moves: Option<(PathBuf, PathBuf)>,
}

impl PendingFile {
    /// Begins a file for `path`.
    ///
    /// # Errors
    /// What the system says.
    pub fn create(path: &Path) -> io::Result<Self> {
        // A link stays a link: what it leads to is replaced.
        let place = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        match fs::metadata(&place) {
            Ok(there) if !there.is_file() => {
                let file = OpenOptions::new().write(true).open(&place)?;
                Ok(Self { file, moves: None })
            }
            Ok(there) => {
                let pending = Self::beside(&place, false)?;
                pending.file.set_permissions(there.permissions())?;
                Ok(pending)
            }
            Err(_) => Self::beside(&place, false),
        }
    }

    /// Begins a file that only its owner can read.
    ///
    /// # Errors
    /// What the system says.
    pub fn create_private(path: &Path) -> io::Result<Self> {
        Self::beside(path, true)
    }

    fn beside(place: &Path, is_private: bool) -> io::Result<Self> {
        let name = place.file_name().ok_or_else(|| io::Error::from(io::ErrorKind::IsADirectory))?;
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}-{}.new", std::process::id(), COUNTER.fetch_add(1, Ordering::Relaxed)));
        let beside = place.with_file_name(hidden);
        // Left by a process of the same number that was killed.
        let _ = fs::remove_file(&beside);
        let mut options = OpenOptions::new();
        options.read(true).write(true).create_new(true);
        if is_private {
            owner::make_private(&mut options);
        }
        let file = options.open(&beside)?;
        with_pending(|pending| pending.push(beside.clone()));
        Ok(Self { file, moves: Some((beside, place.to_owned())) })
    }

    /// Moves the file to its place.
    ///
    /// # Errors
    /// What the system says; the file beside is then removed.
    pub fn commit(mut self) -> io::Result<()> {
        self.file.flush()?;
        if let Some((beside, place)) = &self.moves {
            fs::rename(beside, place)?;
            with_pending(|pending| pending.retain(|other| other != beside));
            self.moves = None;
        }
        Ok(())
    }

    /// Moves the file to its place if nothing is there yet; false where something is.
    ///
    /// # Errors
    /// What the system says.
    pub fn commit_new(self) -> io::Result<bool> {
        self.file.sync_all()?;
        let Some((beside, place)) = &self.moves else { return Ok(false) };
        is_new(fs::hard_link(beside, place), beside, place)
    }
}

/// Whether what lies beside is at its place now, by what linking it there has given. Android lets no app make links: there the file
/// is moved, and one program alone has the folder.
fn is_new(linked: io::Result<()>, beside: &Path, place: &Path) -> io::Result<bool> {
    match linked {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied && !place.try_exists()? => {
            fs::rename(beside, place).map_err(|_| error).map(|()| true)
        }
        Err(error) => Err(error),
    }
}

impl Drop for PendingFile {
    fn drop(&mut self) {
        if let Some((beside, _)) = &self.moves {
            let _ = fs::remove_file(beside);
            with_pending(|pending| pending.retain(|other| other != beside));
        }
    }
}

impl Write for PendingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for PendingFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.file.seek(to)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_no_links_may_be_made_a_new_file_is_moved_and_an_old_one_stays() {
        let dir = tempfile::tempdir().expect("a folder");
        let [beside, place] = ["beside", "place"].map(|name| dir.path().join(name));
        let denied = || Err(io::Error::from(io::ErrorKind::PermissionDenied));
        fs::write(&beside, "first").expect("written");
        assert!(is_new(denied(), &beside, &place).expect("moved"));
        fs::write(&beside, "second").expect("written");
        assert!(is_new(denied(), &beside, &place).is_err());
        assert_eq!(fs::read(&place).expect("it stays"), b"first");
    }

    fn names(directory: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(directory)
            .expect("a folder")
            .map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[cfg(unix)]
    #[test]
    fn a_file_is_replaced_whole_and_keeps_its_permissions() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("stats.json");
        write_atomically(&path, b"one").expect("written");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).expect("changed");
        write_atomically(&path, b"two").expect("written");
        assert_eq!(fs::read(&path).expect("read"), b"two");
        assert_eq!(fs::metadata(&path).expect("there").permissions().mode() & 0o777, 0o640);
        assert_eq!(names(dir.path()), ["stats.json"]);
    }

    #[test]
    fn what_is_not_finished_leaves_what_was_there() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("film.mp4");
        fs::write(&path, "before").expect("written");
        let mut pending = PendingFile::create(&path).expect("begun");
        pending.write_all(b"half").expect("written");
        assert_eq!(fs::read(&path).expect("read"), b"before", "nobody sees the half");
        drop(pending);
        assert_eq!(fs::read(&path).expect("read"), b"before");
        assert_eq!(names(dir.path()), ["film.mp4"], "nothing is left beside");
    }

    #[cfg(unix)]
    #[test]
    fn a_link_stays_a_link_and_a_device_is_written_to() {
        let dir = tempfile::tempdir().expect("a folder");
        let (real, link) = (dir.path().join("real"), dir.path().join("link"));
        fs::write(&real, "before").expect("written");
        std::os::unix::fs::symlink(&real, &link).expect("linked");
        write_atomically(&link, b"after").expect("written");
        assert!(fs::symlink_metadata(&link).expect("there").is_symlink());
        assert_eq!(fs::read(&real).expect("read"), b"after");
        write_atomically(Path::new("/dev/null"), b"gone").expect("written");
        assert!(!fs::metadata("/dev/null").expect("there").is_file(), "a device is not replaced");
    }

    #[test]
    fn a_folder_that_is_missing_is_an_error() {
        let dir = tempfile::tempdir().expect("a folder");
        let error = write_atomically(&dir.path().join("missing/stats.json"), b"x").expect_err("no folder");
        assert_eq!(error.kind(), io::ErrorKind::NotFound);
        assert!(write_atomically(dir.path(), b"x").is_err(), "a folder is no file");
    }
}
