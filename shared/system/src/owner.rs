//! Private files and folders.
//!
//! On Unix a file's mode makes it private. On Windows files below a user's profile inherit access for that user and the
//! administrators only; nothing more is set or checked.

use std::fs::{DirBuilder, Metadata, OpenOptions};
use std::io;
use std::path::Path;

/// A file that is made with these options is its owner's alone.
pub fn make_private(options: &mut OpenOptions) -> &mut OpenOptions {
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(options, 0o600);
    options
}

/// Makes a folder where there is none, and those around it, for their owner alone.
///
/// # Errors
/// What the system says.
pub fn make_folder(folder: &Path) -> io::Result<()> {
    let mut builder = DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(folder)
}

/// The permission bits of what others can read or write; `None` where they cannot, as far as the system says.
#[cfg(unix)]
pub fn open_to_others(metadata: &Metadata) -> Option<u32> {
    let mode = std::os::unix::fs::PermissionsExt::mode(&metadata.permissions()) & 0o777;
    (mode & 0o077 != 0).then_some(mode)
}

/// The same.
#[cfg(windows)]
pub fn open_to_others(_: &Metadata) -> Option<u32> {
    None
}

/// Whether nobody but this process's user and the administrator can write to it, as far as the system says.
#[cfg(unix)]
pub fn is_written_by_owner_alone(metadata: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    // SAFETY: asks for the number of this process's user; it cannot fail, and takes nothing.
    let own = unsafe { libc::geteuid() };
    [own, 0].contains(&metadata.uid()) && metadata.mode() & 0o022 == 0
}

/// The same.
#[cfg(windows)]
pub fn is_written_by_owner_alone(_: &Metadata) -> bool {
    true
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::fs::{self, Permissions};
    use std::os::unix::fs::PermissionsExt;

    fn metadata(path: &Path) -> Metadata {
        fs::metadata(path).expect("it is there")
    }

    #[test]
    fn what_is_made_is_its_owners_alone() {
        let around = tempfile::tempdir().expect("a folder");
        let folder = around.path().join("one/two");
        make_folder(&folder).expect("made");
        make_folder(&folder).expect("there already");
        let file = folder.join("key");
        make_private(OpenOptions::new().write(true).create_new(true)).open(&file).expect("made");
        for path in [folder.parent().expect("one"), &folder, &file] {
            assert_eq!(open_to_others(&metadata(path)), None, "{}", path.display());
            assert!(is_written_by_owner_alone(&metadata(path)));
        }
    }

    #[test]
    fn what_others_can_read_or_write_is_told() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        for (mode, open, is_written) in
            [(0o640, Some(0o640), true), (0o602, Some(0o602), false), (0o400, None, true)]
        {
            fs::set_permissions(file.path(), Permissions::from_mode(mode)).expect("changed");
            assert_eq!(open_to_others(&metadata(file.path())), open);
            assert_eq!(is_written_by_owner_alone(&metadata(file.path())), is_written, "{mode:o}");
        }
    }
}
