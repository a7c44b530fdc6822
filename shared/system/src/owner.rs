//! Private files and folders.
//!
//! On Unix a file's mode makes it private. On Windows a folder that is made gets a list of access for its owner alone, which
//! what is made in it inherits; nothing of it is checked.

use std::fs::{DirBuilder, Metadata, OpenOptions};
use std::io;
use std::path::Path;

/// A file that is made with these options is its owner's alone.
pub fn make_private(options: &mut OpenOptions) -> &mut OpenOptions {
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(options, 0o600);
    options
}

/// Makes a folder where there is none, and those around it, for their owner alone. On Windows those around it are as the folder
/// that they are made in says. A folder that was there is left as it is.
///
/// # Errors
/// What the system says.
pub fn make_folder(folder: &Path) -> io::Result<()> {
    let mut builder = DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    #[cfg(windows)]
    if !folder.is_dir() {
        builder.create(folder)?;
        return windows::give_to_owner_alone(folder).inspect_err(|_| {
            // The next attempt shall not take it for one that was there.
            let _ = std::fs::remove_dir(folder);
        });
    }
    builder.create(folder)
}

#[cfg(windows)]
mod windows {
    use std::io;
    use std::os::windows::ffi::OsStrExt;
    use std::path::Path;
    use std::ptr;
    use windows_sys::Win32::Foundation::LocalFree;
    use windows_sys::Win32::Security::Authorization::{
        ConvertStringSecurityDescriptorToSecurityDescriptorW, SDDL_REVISION_1,
    };
    use windows_sys::Win32::Security::{
        DACL_SECURITY_INFORMATION, PROTECTED_DACL_SECURITY_INFORMATION, PSECURITY_DESCRIPTOR,
        SetFileSecurityW,
    };

    /// Full access (FA) for who owns a thing (OW), of the folder and of all that is made in it (OICI); nothing is inherited (P).
    const OWNER_ALONE: &str = "D:P(A;OICI;FA;;;OW)";

    /// Nobody but a folder's owner has access to it.
    pub(super) fn give_to_owner_alone(folder: &Path) -> io::Result<()> {
        let text: Vec<u16> = OWNER_ALONE.encode_utf16().chain([0]).collect();
        let path: Vec<u16> = folder.as_os_str().encode_wide().chain([0]).collect();
        let mut descriptor: PSECURITY_DESCRIPTOR = ptr::null_mut();
        // SAFETY: the text ends with 0; the place for the descriptor is valid, and its size is not asked for.
        let is_read = unsafe {
            ConvertStringSecurityDescriptorToSecurityDescriptorW(
                text.as_ptr(),
                SDDL_REVISION_1,
                &mut descriptor,
                ptr::null_mut(),
            )
        };
        if is_read == 0 {
            return Err(io::Error::last_os_error());
        }
        let parts = DACL_SECURITY_INFORMATION | PROTECTED_DACL_SECURITY_INFORMATION;
        // SAFETY: the path ends with 0, and the descriptor was made above.
        let is_set = unsafe { SetFileSecurityW(path.as_ptr(), parts, descriptor) };
        let outcome = if is_set == 0 { Err(io::Error::last_os_error()) } else { Ok(()) };
        // SAFETY: the system allocated the descriptor for us to free, and nobody uses it any more.
        unsafe { LocalFree(descriptor) };
        outcome
    }

    #[cfg(test)]
    mod tests {
        use super::super::make_folder;
        use super::*;
        use windows_sys::Win32::Security::{
            ACCESS_ALLOWED_ACE, ACL, GetAce, GetFileSecurityW, GetSecurityDescriptorDacl, IsWellKnownSid,
            WinCreatorOwnerRightsSid,
        };

        #[test]
        fn a_folder_that_is_made_lists_its_owner_alone() {
            let around = tempfile::tempdir().expect("a folder");
            let folder = around.path().join("one");
            make_folder(&folder).expect("made");
            std::fs::write(folder.join("key"), b"secret").expect("its owner may write");
            assert_eq!(std::fs::read(folder.join("key")).expect("and read"), b"secret");
            let path: Vec<u16> = folder.as_os_str().encode_wide().chain([0]).collect();
            let mut bytes = vec![0u64; 512];
            let (mut needed, mut is_there, mut is_default) = (0, 0, 0);
            let mut list: *mut ACL = ptr::null_mut();
            let descriptor: PSECURITY_DESCRIPTOR = bytes.as_mut_ptr().cast();
            // SAFETY: the path ends with 0, the descriptor has 4096 bytes, and the entry lives in it.
            unsafe {
                let parts = DACL_SECURITY_INFORMATION;
                assert_ne!(GetFileSecurityW(path.as_ptr(), parts, descriptor, 4096, &mut needed), 0);
                let read = GetSecurityDescriptorDacl(descriptor, &mut is_there, &mut list, &mut is_default);
                assert!(read != 0 && is_there != 0 && !list.is_null());
                assert_eq!((*list).AceCount, 1);
                let mut entry = ptr::null_mut();
                assert_ne!(GetAce(list, 0, &mut entry), 0);
                let sid = ptr::addr_of_mut!((*entry.cast::<ACCESS_ALLOWED_ACE>()).SidStart);
                assert_ne!(IsWellKnownSid(sid.cast(), WinCreatorOwnerRightsSid), 0);
            }
        }
    }
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
