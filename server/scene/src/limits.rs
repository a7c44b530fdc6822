//! Limits of every asset, whatever its format. They lie far above anything a headset could display, and low enough to refuse a
//! wrong or hostile file before memory is full.

use std::cell::RefCell;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// No file, buffer or image may be larger, bytes.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 30;

/// Most bytes of all buffers of a glTF together; a file that several name counts once.
pub(crate) const MAX_BUFFER_BYTES: u64 = 1 << 30;

/// Most bytes that all compressed views of a glTF may decode to. The codec can repeat a byte a thousand times for
/// nothing, so that the size of the file is no bound.
pub(crate) const MAX_DECODED_BYTES: usize = 1 << 28;

/// Most objects, and most values, of the JSON of a glTF: an empty object of three bytes becomes some hundreds in memory.
pub(crate) const MAX_JSON_OBJECTS: usize = 1 << 19;
pub(crate) const MAX_JSON_VALUES: usize = 1 << 23;

/// Most elements of one accessor of a glTF.
pub(crate) const MAX_ELEMENTS: usize = 1 << 22;

/// Most bytes that `ufbx` may hold for one FBX file, and as many again while it reads. A compressed array may claim to
/// be much larger than the file.
pub(crate) const MAX_FBX_MEMORY_BYTES: usize = 1 << 30;

/// Deeper hierarchies of an FBX file are damaged.
pub(crate) const MAX_FBX_DEPTH: u32 = 4096;

/// Largest side of an image, texels: 8192 x 8192 RGBA are 256 MiB, already more than a streamed view can use.
pub(crate) const MAX_IMAGE_SIDE: u32 = 8192;

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

/// Most events of a scene file.
pub(crate) const MAX_EVENTS: usize = 4096;

/// Longest fade from one clip to another, seconds.
pub(crate) const MAX_FADE_S: f32 = 60.0;

/// A file that was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Note {
    /// As it was named.
    pub(crate) path: PathBuf,
    /// So many bytes of it were wanted, or all that there were.
    pub(crate) most_bytes: u64,
    /// Of what it held; `None` where it could not be read.
    pub(crate) hash: Option<[u8; 32]>,
}

thread_local! {
    static NOTES: RefCell<Option<Vec<Note>>> = const { RefCell::new(None) };
}

/// Does the work and says which files it asked for through this module, in order.
pub(crate) fn noting_files<T>(work: impl FnOnce() -> T) -> (T, Vec<Note>) {
    let outer = NOTES.replace(Some(Vec::new()));
    let result = work();
    (result, NOTES.replace(outer).unwrap_or_default())
}

fn note(path: &Path, most_bytes: u64, bytes: Option<&[u8]>) {
    NOTES.with_borrow_mut(|notes| {
        if let Some(notes) = notes {
            let hash = bytes.map(|bytes| *blake3::hash(bytes).as_bytes());
            notes.push(Note { path: path.to_owned(), most_bytes, hash });
        }
    });
}

/// A file was asked for that is not there, or not to be had: it may be later.
pub(crate) fn note_missing(path: &Path) {
    note(path, MAX_FILE_BYTES, None);
}

/// Reads a regular file of at most [`MAX_FILE_BYTES`].
pub(crate) fn read_limited(path: &Path) -> std::io::Result<Vec<u8>> {
    read_named(path, path)
}

/// As [`read_limited`], of a file that is noted by another name.
pub(crate) fn read_named(named: &Path, real: &Path) -> std::io::Result<Vec<u8>> {
    let read = check_size(real).and_then(|()| read_at_most(real, MAX_FILE_BYTES));
    note(named, MAX_FILE_BYTES, read.as_deref().ok());
    read
}

/// As [`read_named`], only the first bytes, however long the file is.
pub(crate) fn read_start(named: &Path, real: &Path, bytes: u64) -> std::io::Result<Vec<u8>> {
    let read = read_at_most(real, bytes.min(MAX_FILE_BYTES));
    note(named, bytes, read.as_deref().ok());
    read
}

/// What [`Note::hash`] would be now; `None` too where there is no such file.
pub(crate) fn hash_start(path: &Path, most_bytes: u64) -> Option<[u8; 32]> {
    let file = open_regular(path).ok()?;
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(file.take(most_bytes.min(MAX_FILE_BYTES))).ok()?;
    Some(*hasher.finalize().as_bytes())
}

fn check_size(path: &Path) -> std::io::Result<()> {
    let length = std::fs::metadata(path)?.len();
    if length <= MAX_FILE_BYTES {
        return Ok(());
    }
    Err(std::io::Error::other(format!("larger than {} MiB", MAX_FILE_BYTES >> 20)))
}

fn read_at_most(path: &Path, bytes: u64) -> std::io::Result<Vec<u8>> {
    let mut read = Vec::new();
    open_regular(path)?.take(bytes).read_to_end(&mut read)?;
    Ok(read)
}

/// Opening a pipe would wait for whoever writes to it.
fn open_regular(path: &Path) -> std::io::Result<File> {
    match std::fs::metadata(path)?.is_file() {
        true => File::open(path),
        false => Err(std::io::Error::other("not a regular file")),
    }
}
