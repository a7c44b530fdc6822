//! Files that an asset refers to. Assets come from strangers. An asset may name files of its own folder and its subfolders, and
//! no other file of this machine, however it writes the name.
//!
//! Scene files belong to the user and name models anywhere; see [`mod@crate::file`].

use crate::limits;
use shadecast_model::text::printable;
use std::borrow::Cow;
use std::io;
use std::path::{Component, Path, PathBuf};

/// What to do about a name that is refused.
const REMEDY: &str = "put the file into the asset's folder, and let the asset name it from there";

/// An asset's folder: the only place where its references are looked up.
#[derive(Clone, Debug)]
pub(crate) struct Folder(PathBuf);

/// A regular file in the asset's folder.
#[derive(Clone, Debug)]
pub(crate) struct Found {
    /// As the asset names it, in its folder: what a cached import is known by.
    named: PathBuf,
    /// Without links. Two names of one file have the same.
    pub(crate) real: PathBuf,
    /// Bytes.
    pub(crate) length: u64,
}

impl Folder {
    /// Where an asset is.
    pub(crate) fn of(asset: &Path) -> Self {
        Self(asset.parent().unwrap_or(Path::new("")).to_owned())
    }

    /// The path itself.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    /// The file that a URI names, percent sequences decoded once.
    pub(crate) fn find_uri(&self, uri: &str) -> Result<Found, String> {
        if has_scheme(uri) || uri.starts_with("//") {
            return Err(format!("'{}' is no file beside the asset; {REMEDY}", printable(uri)));
        }
        let name = String::from_utf8(percent_decode(uri))
            .map_err(|_| format!("'{}' is no text once it is decoded; rename the file", printable(uri)))?;
        self.find_shown(&name, uri)
    }

    /// The file of a name that is no URI: taken as it stands.
    pub(crate) fn find(&self, name: &str) -> Result<Found, String> {
        self.find_shown(name, name)
    }

    /// `shown` is how the asset writes `name`, for messages.
    fn find_shown(&self, name: &str, shown: &str) -> Result<Found, String> {
        // Exporters on Windows write backslashes; nobody has them in file names.
        let name = name.replace('\\', "/");
        let refused = |why: &str| format!("'{}' {why}; {REMEDY}", printable(shown));
        check_relative(&name).map_err(refused)?;
        let named = self.0.join(&name);
        let located = self.locate(&named);
        if !matches!(&located, Ok(Some(_))) {
            // It may be there later.
            limits::note_missing(&named);
        }
        match located {
            Ok(Some((real, length))) => Ok(Found { named, real, length }),
            Ok(None) => Err(refused("leads out of the asset's folder by a link, or is no regular file")),
            Err(error) => Err(format!("file '{}': {error}; {REMEDY}", printable(shown))),
        }
    }

    /// The file without links, and its length; `None` where it is outside, or is a folder, a pipe or a device.
    fn locate(&self, named: &Path) -> io::Result<Option<(PathBuf, u64)>> {
        let own = if self.0.as_os_str().is_empty() { Path::new(".") } else { &self.0 };
        let (own, real) = (own.canonicalize()?, named.canonicalize()?);
        let meta = real.metadata()?;
        Ok((real.starts_with(own) && meta.is_file()).then_some((real, meta.len())))
    }
}

impl Found {
    /// The whole file, at most [`MAX_FILE_BYTES`](limits::MAX_FILE_BYTES).
    pub(crate) fn read(&self) -> Result<Vec<u8>, String> {
        self.explained(limits::read_named(&self.named, &self.real))
    }

    /// Its first bytes.
    pub(crate) fn read_start(&self, bytes: u64) -> Result<Vec<u8>, String> {
        self.explained(limits::read_start(&self.named, &self.real, bytes))
    }

    fn explained(&self, read: io::Result<Vec<u8>>) -> Result<Vec<u8>, String> {
        read.map_err(|error| format!("file '{}': {error}", self.shown()))
    }

    fn shown(&self) -> String {
        printable(&self.named.file_name().map_or(Cow::Borrowed(""), |name| name.to_string_lossy()))
    }
}

/// Whether a text starts as an absolute URI does (RFC 3986 section 3.1), or with the letter of a drive.
fn has_scheme(text: &str) -> bool {
    text.split_once(':').is_some_and(|(scheme, _)| {
        scheme.starts_with(|first: char| first.is_ascii_alphabetic())
            && scheme.chars().all(|letter| letter.is_ascii_alphanumeric() || "+-.".contains(letter))
    })
}

/// That a name leads nowhere but down: what is wrong with it else.
fn check_relative(name: &str) -> Result<(), &'static str> {
    if name.is_empty() || name.contains('\0') {
        return Err("is no name of a file");
    }
    let mut depth = 0u32;
    for part in Path::new(name).components() {
        depth = match part {
            Component::Normal(_) => depth + 1,
            Component::CurDir => depth,
            Component::ParentDir => depth.checked_sub(1).ok_or("leads out of the asset's folder")?,
            Component::RootDir | Component::Prefix(_) => return Err("is an absolute path"),
        };
    }
    // The letter of a drive, which other systems would take for a name.
    let has_drive = name.as_bytes().get(1) == Some(&b':') && name.as_bytes()[0].is_ascii_alphabetic();
    if has_drive { Err("is an absolute path") } else { Ok(()) }
}

/// `%20` and its like; what is not such a sequence stays as it is.
pub(crate) fn percent_decode(text: &str) -> Vec<u8> {
    let bytes = text.as_bytes();
    let (mut out, mut at) = (Vec::with_capacity(bytes.len()), 0);
    while at < bytes.len() {
        let hex = bytes.get(at + 1..at + 3).filter(|hex| hex.iter().all(u8::is_ascii_hexdigit));
        let code =
            hex.and_then(|hex| std::str::from_utf8(hex).ok()).and_then(|h| u8::from_str_radix(h, 16).ok());
        match code {
            Some(code) if bytes[at] == b'%' => {
                out.push(code);
                at += 3;
            }
            _ => {
                out.push(bytes[at]);
                at += 1;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    fn link_to(to: &str, link: &Path) {
        std::os::unix::fs::symlink(to, link).expect("linked");
    }

    /// Links take a privilege there: a copy stands for one that stays inside, and what leads outside is not there.
    #[cfg(windows)]
    fn link_to(to: &str, link: &Path) {
        if !to.starts_with("..") {
            std::fs::copy(link.with_file_name(to), link).expect("copied");
        }
    }

    /// `top/secret.bin` and `top/asset/{a.bin, sub/b.bin, in -> sub/b.bin, out -> ../secret.bin, outside -> ..}`.
    fn folders() -> (tempfile::TempDir, Folder) {
        let top = tempfile::tempdir().expect("a folder");
        let asset = top.path().join("asset");
        std::fs::create_dir_all(asset.join("sub")).expect("made");
        for (name, text) in [("secret.bin", "secret"), ("asset/a.bin", "a"), ("asset/sub/b.bin", "bb")] {
            std::fs::write(top.path().join(name), text).expect("written");
        }
        for (to, link) in [("sub/b.bin", "in"), ("../secret.bin", "out"), ("..", "outside")] {
            link_to(to, &asset.join(link));
        }
        (top, Folder::of(&asset.join("x.gltf")))
    }

    #[test]
    fn percent_sequences_are_decoded_and_others_kept() {
        for (text, decoded) in
            [("a%20b%2Fc", "a b/c"), ("100%", "100%"), ("%zz%4", "%zz%4"), ("%252e", "%2e")]
        {
            assert_eq!(percent_decode(text), decoded.as_bytes());
        }
    }

    #[test]
    fn files_in_the_folder_are_found_by_any_inside_name() {
        let (_top, folder) = folders();
        for (uri, bytes) in [
            ("a.bin", "a"),
            ("./a.bin", "a"),
            ("%61.bin", "a"),
            ("sub/b.bin", "bb"),
            ("sub%2fb.bin", "bb"),
            ("sub\\b.bin", "bb"),
            ("sub/../a.bin", "a"),
            ("in", "bb"),
        ] {
            let found = folder.find_uri(uri).unwrap_or_else(|problem| panic!("{uri}: {problem}"));
            assert_eq!(found.read().expect("read"), bytes.as_bytes(), "{uri}");
        }
        let real = |uri: &str| folder.find_uri(uri).expect("there").real;
        assert_eq!(real("in"), real("sub/b.bin"));
    }

    #[test]
    fn paths_out_of_the_folder_are_refused() {
        let (top, folder) = folders();
        let absolute = top.path().join("secret.bin").to_string_lossy().into_owned();
        for uri in [
            &absolute,
            &absolute.replace('/', "%2f"),
            &format!("file://{absolute}"),
            "/etc/hostname",
            "//server/share",
            "../secret.bin",
            "sub/../../secret.bin",
            "%2e%2e/secret.bin",
            "%2e%2e%2fsecret.bin",
            "..%2Fsecret.bin",
            "..\\secret.bin",
            "%2e%2e%5csecret.bin",
            "out",
            "outside/secret.bin",
            "https://example.com/a.bin",
            "C:\\secret.bin",
            "C%3A/secret.bin",
            "%43:/secret.bin",
            "",
            "a.bin%00",
            "sub",
        ] {
            let problem = folder.find_uri(uri).expect_err(uri);
            assert!(problem.contains(REMEDY) && problem.contains(&*printable(uri)), "{uri}: {problem}");
        }
    }

    #[test]
    fn a_name_is_decoded_once_and_only_where_it_is_a_uri() {
        let (_top, folder) = folders();
        for problem in [folder.find_uri("%252e%252e%252fsecret.bin"), folder.find("%61.bin")] {
            assert!(problem.expect_err("no such file").starts_with("file '%"), "it is looked for inside");
        }
        std::fs::write(folder.path().join("%61.bin"), "percent").expect("written");
        assert_eq!(folder.find("%61.bin").expect("there").read().expect("read"), b"percent");
    }

    #[test]
    fn a_pipe_is_refused_instead_of_waited_for() {
        let (_top, folder) = folders();
        let made = std::process::Command::new("mkfifo").arg(folder.path().join("pipe")).status();
        assert!(made.is_ok_and(|status| status.success()), "mkfifo is there");
        assert!(folder.find_uri("pipe").expect_err("a pipe").contains("regular file"));
    }

    #[test]
    fn names_are_shown_so_that_no_terminal_obeys_them() {
        let (_top, folder) = folders();
        let problem = folder.find_uri("../\u{1b}]0;x\u{7}\u{202e}").expect_err("outside");
        assert!(!problem.chars().any(|c| c.is_control() || c == '\u{202e}'), "{problem:?}");
    }
}
