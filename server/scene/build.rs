//! Hashes the sources of this crate, and of the built-in models, into `SHADECAST_SCENE_SOURCES`, so that cached results of other sources are not taken.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;

const SOURCES: [&str; 2] = ["src", "../dragon/src"];

fn main() {
    let mut hasher = DefaultHasher::new();
    for folder in SOURCES {
        add(Path::new(folder), &mut hasher);
        println!("cargo::rerun-if-changed={folder}");
    }
    println!("cargo::rustc-env=SHADECAST_SCENE_SOURCES={:016x}", hasher.finish());
    println!("cargo::rerun-if-changed=build.rs");
}

fn add(folder: &Path, hasher: &mut DefaultHasher) {
    let items = std::fs::read_dir(folder).expect("the sources can be listed");
    let mut paths: Vec<_> = items.map(|item| item.expect("the sources can be listed").path()).collect();
    paths.sort();
    for path in paths {
        path.hash(hasher);
        if path.is_dir() {
            add(&path, hasher);
        } else {
            std::fs::read(&path).expect("the sources can be read").hash(hasher);
        }
    }
}
