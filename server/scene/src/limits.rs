//! What no asset may exceed, whatever its format: far above anything a headset could show, and small enough that a
//! wrong or hostile file is refused rather than read until memory is full.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

/// No file, buffer or image may be larger, bytes.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 30;

/// Most vertices and indices of a whole asset.
pub(crate) const MAX_VERTICES: usize = 4_000_000;

/// Most palette entries of a whole asset: vertices name them with 16 bits.
pub(crate) const MAX_PALETTE: usize = 1 << 16;

/// Most morph targets of a whole asset, every showing of a mesh counted.
pub(crate) const MAX_MORPHS: usize = 1 << 16;

/// Most deltas of all morph targets, 40 bytes each.
pub(crate) const MAX_DELTAS: usize = 1 << 23;

/// Most texels of all textures: 1 GiB of RGBA. A picture can be a thousand times larger than its file.
pub(crate) const MAX_TEXELS: usize = 1 << 28;

/// Longest clip, seconds. A day; longer ones are damaged files, and would be resampled to gigabytes.
pub(crate) const MAX_DURATION_S: f32 = 86_400.0;

/// A file that was asked for, with the hash of what it held; `None` where it could not be read.
pub(crate) type Note = (PathBuf, Option<[u8; 32]>);

thread_local! {
    static NOTES: RefCell<Option<Vec<Note>>> = const { RefCell::new(None) };
}

/// Does the work and says which files it asked for through this module, in order.
pub(crate) fn noting_files<T>(work: impl FnOnce() -> T) -> (T, Vec<Note>) {
    let outer = NOTES.replace(Some(Vec::new()));
    let result = work();
    (result, NOTES.replace(outer).unwrap_or_default())
}

fn note(path: &Path, bytes: Option<&[u8]>) {
    NOTES.with_borrow_mut(|notes| {
        if let Some(notes) = notes {
            notes.push((path.to_owned(), bytes.map(|bytes| *blake3::hash(bytes).as_bytes())));
        }
    });
}

/// Reads a regular file of at most [`MAX_FILE_BYTES`].
pub(crate) fn read_limited(path: &Path) -> std::io::Result<Vec<u8>> {
    let read = read_regular(path);
    note(path, read.as_deref().ok());
    read
}

/// Whether there is a regular file. One that is missing counts as asked for too: it may come later.
pub(crate) fn is_file(path: &Path) -> bool {
    let found = path.is_file();
    if !found {
        note(path, None);
    }
    found
}

fn read_regular(path: &Path) -> std::io::Result<Vec<u8>> {
    let meta = std::fs::metadata(path)?;
    if !meta.is_file() {
        return Err(std::io::Error::other("not a regular file"));
    }
    if meta.len() > MAX_FILE_BYTES {
        return Err(std::io::Error::other(format!("larger than {} MiB", MAX_FILE_BYTES >> 20)));
    }
    std::fs::read(path)
}
