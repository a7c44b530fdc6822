//! The JSON manifest by which the OpenXR loader finds this runtime (`XR_RUNTIME_JSON`), and the path of the library.

use std::io;
use std::path::{Path, PathBuf};

/// File name of the manifest.
pub const MANIFEST_NAME: &str = "shadecast-mock-runtime.json";

/// File name of the runtime library.
pub fn library_name() -> String {
    use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
    format!("{DLL_PREFIX}shadecast_mock_runtime{DLL_SUFFIX}")
}

/// Writes the runtime's manifest into `dir` (made where missing) and returns its path, for `XR_RUNTIME_JSON`.
/// Each run has a manifest of its own, so that several can live side by side.
pub fn write(dir: &Path, library: &Path) -> io::Result<PathBuf> {
    std::fs::create_dir_all(dir)?;
    std::fs::metadata(library).map_err(|error| {
        io::Error::new(error.kind(), format!("the mock runtime library {}: {error}", library.display()))
    })?;
    // Not the path without links, which loaders of Windows do not understand.
    let library = std::path::absolute(library)?;
    let manifest = serde_json::json!({
        "file_format_version": "1.0.0",
        "runtime": { "name": "Shadecast mock runtime", "library_path": library }
    });
    let path = std::path::absolute(dir)?.join(MANIFEST_NAME);
    std::fs::write(&path, format!("{manifest:#}\n"))?;
    Ok(path)
}

/// The runtime library beside the running program: in its folder's `deps/` (where cargo puts a library that is built
/// as a dependency, always fresh), in its folder, in the parent's `deps/`, in the parent.
pub fn find_library() -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    find_library_near(program.parent()?)
}

fn find_library_near(folder: &Path) -> Option<PathBuf> {
    let near = [Some(folder), folder.parent()];
    near.into_iter()
        .flatten()
        .flat_map(|folder| [folder.join("deps"), folder.to_owned()])
        .map(|folder| folder.join(library_name()))
        .find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_library_is_found_beside_programs_and_tests() {
        let target = tempfile::tempdir().expect("a temporary folder");
        let deps = target.path().join("deps");
        std::fs::create_dir(&deps).expect("make deps");
        assert_eq!(find_library_near(&deps), None);
        std::fs::write(target.path().join(library_name()), "").expect("stale library");
        assert_eq!(find_library_near(&deps), Some(target.path().join(library_name())));
        std::fs::write(deps.join(library_name()), "").expect("fresh library");
        assert_eq!(find_library_near(&deps), Some(deps.join(library_name())));
        assert_eq!(find_library_near(target.path()), Some(deps.join(library_name())));
    }

    #[test]
    fn the_manifest_names_the_library_absolutely() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let library = folder.path().join(library_name());
        std::fs::write(&library, "").expect("library");
        let path = write(&folder.path().join("run"), &library).expect("manifest");
        let text = std::fs::read_to_string(path).expect("read back");
        let manifest: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let named = manifest["runtime"]["library_path"].as_str().expect("a path");
        assert_eq!(Path::new(named), std::path::absolute(&library).expect("a path"));
    }

    #[test]
    fn a_missing_library_is_named() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let error = write(folder.path(), Path::new("/nowhere/lib.so")).expect_err("missing").to_string();
        assert!(error.contains("/nowhere/lib.so"), "{error}");
    }
}
