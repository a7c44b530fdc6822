//! CPU reference twins: the result of each GPU stage in plain Rust, one file per shader stem. They serve tests only; code that
//! the product needs too is elsewhere in this crate.
pub mod atlas_lookup;
pub mod footprint;
pub mod interpolate;
pub mod extents;
pub mod mark;
pub mod settle;
pub mod spread;
pub mod store_lookup;
pub mod pose;
pub mod skin;
pub mod ycbcr;

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    fn sources(folder: &Path) -> Vec<PathBuf> {
        let items = std::fs::read_dir(folder).expect("a folder of the workspace");
        let paths = items.map(|item| item.expect("can be listed").path());
        paths.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
    }

    #[test]
    fn the_product_uses_no_twin() {
        let workspace = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let product = ["server/src", "server/scene/src", "client-xr/src", "android/src", "shared/gpu/src"];
        let is_of_tests = |path: &PathBuf| path.to_string_lossy().ends_with("tests.rs");
        let sources: Vec<_> = product.iter().flat_map(|folder| sources(&workspace.join(folder))).collect();
        assert!(sources.len() > 50, "{sources:?}");
        for path in sources.iter().filter(|path| !is_of_tests(path)) {
            let text = std::fs::read_to_string(path).expect("a source file");
            assert!(!text.contains("shaders::twin"), "{}: a twin is for tests", path.display());
        }
    }
}
