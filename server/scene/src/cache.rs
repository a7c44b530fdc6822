//! Expensive results, kept on disk between starts.
//!
//! A [`Key`], the hash of all inputs of a result, finds its entry. Entries are never invalidated: a changed input changes the
//! key, and the old entry ages until it is removed for its space.
//!
//! Damaged or truncated files, and files of another version, count as absent. Their checksum excludes chance, not intent: any
//! writer of the folder can write a fitting checksum. So the folder belongs to its owner alone (a folder that others can write
//! to is not used), and every entry is validated before use. No failure in here stops a program: at worst it computes again.

use crate::check::Unsound;
use serde::Serialize;
use serde::de::DeserializeOwned;
use shadecast_system::{folders, owner};
use std::fs::OpenOptions;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Once};
use std::time::{Duration, SystemTime};

/// Largest sum of all entries, bytes; the least recently used go first.
pub const MAX_CACHE_BYTES: u64 = 2 << 30;

/// Of the sources of this crate: whoever changes an importer, the simplifier or the generated dragon need not think of
/// the cache.
const SOURCES: &str = env!("SHADECAST_SCENE_SOURCES");

const MAGIC: [u8; 8] = *b"SHDCACHE";
/// Of the layout of the file itself.
const FILE_VERSION: u32 = 1;
/// Reads as another number on a machine of the other byte order.
const BYTE_ORDER: u32 = 0x0102_0304;
const HASH_BYTES: usize = blake3::OUT_LEN;
/// Magic, file version, byte order, key, length of the payload, hash of the payload; the payload follows.
const HEADER_BYTES: usize = 8 + 4 + 4 + HASH_BYTES + 8 + HASH_BYTES;
const EXTENSION: &str = "entry";
/// A file that is still being written, or was when its writer died.
const TEMPORARY_EXTENSION: &str = "new";
const ABANDONED_AFTER: Duration = Duration::from_secs(3600);

/// Says which result is meant: its kind, and a hash of all that it depends on.
#[derive(Clone, Debug)]
pub struct Key {
    kind: &'static str,
    hasher: blake3::Hasher,
}

impl Key {
    /// The key of a result of a kind (a short word of letters, for file names) at a version, to be raised when what is
    /// computed or how it is stored changes outside this crate; changes inside it are noticed anyway.
    pub fn new(kind: &'static str, version: u32) -> Self {
        Self { kind, hasher: blake3::Hasher::new() }.bytes(SOURCES.as_bytes()).bytes(&version.to_le_bytes())
    }

    /// It depends on these bytes.
    #[must_use]
    pub fn bytes(mut self, bytes: &[u8]) -> Self {
        self.hasher.update(&(bytes.len() as u64).to_le_bytes());
        self.hasher.update(bytes);
        self
    }

    /// It depends on this value.
    #[must_use]
    pub fn value(mut self, value: &(impl Serialize + ?Sized)) -> Self {
        let mut writer = BufWriter::with_capacity(1 << 16, &mut self.hasher);
        postcard::to_io(value, &mut writer).expect("a hasher takes everything; our types serialise");
        writer.flush().expect("a hasher takes everything");
        drop(writer);
        self
    }

    fn hash(&self) -> [u8; HASH_BYTES] {
        *self.hasher.finalize().as_bytes()
    }

    fn file_name(&self) -> String {
        let hex = blake3::Hash::from_bytes(self.hash()).to_hex();
        format!("{}-{}.{EXTENSION}", self.kind, &hex[..40])
    }
}

/// A folder of results, or none at all. Clones share their counts.
#[derive(Clone, Debug)]
pub struct Cache {
    folder: Option<PathBuf>,
    limit_bytes: u64,
    counts: Arc<Counts>,
}

#[derive(Debug, Default)]
struct Counts {
    hits: AtomicU32,
    misses: AtomicU32,
    /// Whether it was said that nothing can be written.
    has_warned: AtomicBool,
}

impl Cache {
    /// In this folder, which is made when the first entry is written; keeps nothing where others could write to it.
    pub fn new(folder: impl Into<PathBuf>) -> Self {
        Self::with(Some(folder.into()), MAX_CACHE_BYTES)
    }

    /// Keeps nothing: everything is computed each time.
    pub fn disabled() -> Self {
        Self::with(None, 0)
    }

    /// In the user's own folder for such things; keeps nothing where there is none.
    pub fn of_user() -> Self {
        Self::with(folders::cache(|name| std::env::var_os(name)), MAX_CACHE_BYTES)
    }

    fn with(folder: Option<PathBuf>, limit_bytes: u64) -> Self {
        let folder = folder.filter(|folder| is_safe(folder));
        Self { folder, limit_bytes, counts: Arc::default() }
    }

    /// Where the entries are.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// Results so far that were found, and those that had to be computed.
    pub fn hits_and_misses(&self) -> (u32, u32) {
        (self.counts.hits.load(Ordering::Relaxed), self.counts.misses.load(Ordering::Relaxed))
    }

    /// The result of this key: from the folder if it passes `check`, else computed and then kept. Large arrays in it
    /// should be marked with [`bulk`](crate::bulk). An error is handed on and not kept.
    ///
    /// # Errors
    /// Those of `compute`; the cache itself has none.
    pub(crate) fn try_get_or_compute<T: Serialize + DeserializeOwned, E>(
        &self,
        key: &Key,
        check: impl FnOnce(&T) -> Result<(), Unsound>,
        compute: impl FnOnce() -> Result<T, E>,
    ) -> Result<T, E> {
        if let Some(value) = self.find(key, check) {
            self.count_hit();
            return Ok(value);
        }
        let value = compute()?;
        self.count_miss();
        self.keep(key, &value);
        Ok(value)
    }

    pub(crate) fn count_hit(&self) {
        self.counts.hits.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn count_miss(&self) {
        self.counts.misses.fetch_add(1, Ordering::Relaxed);
    }

    /// The entry of this key, if it is whole and passes `check`.
    pub(crate) fn find<T: DeserializeOwned>(
        &self,
        key: &Key,
        check: impl FnOnce(&T) -> Result<(), Unsound>,
    ) -> Option<T> {
        let path = self.folder.as_ref()?.join(key.file_name());
        let bytes = match read_entry(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!("{}: cannot be read ({error}); it is rebuilt", path.display());
                return None;
            }
        };
        let found = payload(&bytes, &key.hash()).and_then(|payload| {
            postcard::from_bytes(payload).map_err(|_| "does not hold the entry of its name")
        });
        match found {
            Ok(value) => match check(&value) {
                Ok(()) => {
                    mark_used(&path);
                    Some(value)
                }
                Err(problem) => {
                    tracing::debug!("{}: {problem}; it is rebuilt", path.display());
                    None
                }
            },
            Err(problem) => {
                tracing::warn!("{}: {problem}; it is rebuilt", path.display());
                None
            }
        }
    }

    /// Keeps an entry; where that fails, says so once.
    pub(crate) fn keep(&self, key: &Key, value: &impl Serialize) {
        let Some(folder) = &self.folder else { return };
        let written = write_entry(folder, key, value).and_then(|path| self.make_room(folder, &path));
        if let Err(error) = written
            && !self.counts.has_warned.swap(true, Ordering::Relaxed)
        {
            let folder = folder.display();
            tracing::warn!("cache {folder}: {error}; the next start processes the assets again");
        }
    }

    /// Removes the least recently used entries until the rest fits, and what dead writers left.
    fn make_room(&self, folder: &Path, newest: &Path) -> std::io::Result<()> {
        let now = std::fs::metadata(newest)?.modified()?;
        let mut entries = Vec::new();
        for item in std::fs::read_dir(folder)?.flatten() {
            // Another process may have removed it meanwhile.
            let Ok(meta) = item.metadata() else { continue };
            let (path, modified) = (item.path(), meta.modified()?);
            match path.extension().and_then(|extension| extension.to_str()) {
                Some(EXTENSION) if meta.is_file() => entries.push((modified, meta.len(), path)),
                Some(TEMPORARY_EXTENSION) if modified + ABANDONED_AFTER < now => {
                    let _ = std::fs::remove_file(path);
                }
                _ => {}
            }
        }
        entries.sort();
        let mut total: u64 = entries.iter().map(|(_, bytes, _)| bytes).sum();
        for (_, bytes, path) in entries {
            if total <= self.limit_bytes {
                break;
            }
            // Where that fails, another process was faster, or the folder is not ours to clean.
            let _ = std::fs::remove_file(path);
            total -= bytes;
        }
        Ok(())
    }
}

/// Whether nobody but us (and the system's administrator) can write to a folder, or there is none yet. Said once where
/// others can.
fn is_safe(folder: &Path) -> bool {
    static SAID: Once = Once::new();
    let Ok(meta) = std::fs::metadata(folder) else { return true };
    let is_ours = owner::is_written_by_owner_alone(&meta);
    if !is_ours {
        let folder = folder.display();
        SAID.call_once(|| {
            tracing::warn!(
                "cache {folder}: not used, because other users can write to it; run chmod go-w {folder}, \
                 or choose your own folder with --cache-dir"
            );
        });
    }
    is_ours
}

/// Makes the folder where there is none, readable for its owner alone.
fn make_folder(folder: &Path) -> std::io::Result<()> {
    owner::make_folder(folder)?;
    // Somebody else may have been faster.
    if is_safe(folder) { Ok(()) } else { Err(std::io::Error::other("others can write to it")) }
}

/// The bytes of an entry. Neither a pipe nor a file without end is waited for.
fn read_entry(path: &Path) -> std::io::Result<Vec<u8>> {
    let meta = std::fs::metadata(path)?;
    if !meta.is_file() || meta.len() > MAX_CACHE_BYTES {
        return Err(std::io::Error::other("not a regular file, or too large"));
    }
    std::fs::read(path)
}

/// The payload of a file that is whole and belongs to the key.
fn payload<'a>(file: &'a [u8], key: &[u8; HASH_BYTES]) -> Result<&'a [u8], &'static str> {
    let (head, payload) = file.split_at_checked(HEADER_BYTES).ok_or("is cut off")?;
    let expected = header(key, payload);
    let (kind, rest) = head.split_at(16);
    if kind != &expected[..16] {
        return Err("is not an entry of this version");
    }
    if rest[..HASH_BYTES] != *key {
        return Err("belongs to another input");
    }
    if *head == expected { Ok(payload) } else { Err("is damaged") }
}

fn header(key: &[u8; HASH_BYTES], payload: &[u8]) -> [u8; HEADER_BYTES] {
    let mut head = [0; HEADER_BYTES];
    let mut rest = &mut head[..];
    let (length, hash) = ((payload.len() as u64).to_le_bytes(), blake3::hash(payload));
    let parts: [&[u8]; 6] =
        [&MAGIC, &FILE_VERSION.to_le_bytes(), &BYTE_ORDER.to_ne_bytes(), key, &length, hash.as_bytes()];
    for part in parts {
        rest.write_all(part).expect("the header has room for its parts");
    }
    head
}

/// Writes beside the entry and then renames, so that nobody ever sees half of it.
fn write_entry(folder: &Path, key: &Key, value: &impl Serialize) -> std::io::Result<PathBuf> {
    static COUNTER: AtomicU32 = AtomicU32::new(0);
    let payload = postcard::to_stdvec(value).map_err(std::io::Error::other)?;
    make_folder(folder)?;
    let path = folder.join(key.file_name());
    let number = COUNTER.fetch_add(1, Ordering::Relaxed);
    let temporary = path.with_extension(format!("{}-{number}.{TEMPORARY_EXTENSION}", std::process::id()));
    // Left by a process of the same number that was killed.
    let _ = std::fs::remove_file(&temporary);
    let mut fresh = OpenOptions::new();
    owner::make_private(fresh.write(true).create_new(true));
    let written = fresh.open(&temporary).and_then(|mut file| {
        file.write_all(&header(&key.hash(), &payload))?;
        file.write_all(&payload)
    });
    let renamed = written.and_then(|()| std::fs::rename(&temporary, &path));
    if renamed.is_err() {
        let _ = std::fs::remove_file(&temporary);
    }
    renamed.map(|()| path)
}

/// The time decides nothing but which entry goes first when space runs out. Fails harmlessly in a folder that can
/// only be read.
fn mark_used(path: &Path) {
    let file = std::fs::File::options().append(true).open(path);
    let _ = file.and_then(|file| file.set_modified(SystemTime::now()));
}

/// Changes what a kept entry holds, and gives it the checksum that belongs to the change.
#[cfg(test)]
pub(crate) fn reseal(path: &Path, edit: impl FnOnce(&mut Vec<u8>)) {
    let whole = std::fs::read(path).expect("an entry");
    let (head, payload) = whole.split_at(HEADER_BYTES);
    let key: [u8; HASH_BYTES] = head[16..16 + HASH_BYTES].try_into().expect("a key");
    let mut payload = payload.to_vec();
    edit(&mut payload);
    std::fs::write(path, [&header(&key, &payload)[..], &payload].concat()).expect("written");
}

#[cfg(test)]
mod tests;
