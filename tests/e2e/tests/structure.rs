//! The rules of `ARCHITECTURE.md` on the sources: allowed names, imports between modules, lengths of functions.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The crates that are shipped.
const PRODUCT: [&str; 13] = [
    "shared/model/src",
    "shared/protocol/src",
    "shared/spirv/src",
    "shared/transport/src",
    "shared/desktop/src",
    "shared/gpu/src",
    "shared/trace/src",
    "shaders/src",
    "server/src",
    "server/cli/src",
    "server/scene/src",
    "server/dragon/src",
    "client-xr/src",
];
/// All crates, the lowest first, and the crates of the project that each depends on. Tests may use the crates of [`FOR_TESTS`] too.
const CRATES: [(&str, &[&str]); 20] = [
    ("shared/model", &[]),
    ("shared/spirv", &[]),
    ("shared/system", &[]),
    ("shared/protocol", &["model"]),
    ("shared/trace", &["protocol"]),
    ("shared/transport", &["protocol", "system"]),
    ("shared/gpu", &["protocol", "spirv", "system"]),
    ("shaders", &["protocol", "spirv"]),
    ("shared/desktop", &["gpu", "protocol", "shaders", "system", "transport"]),
    ("server/dragon", &[]),
    ("server/scene", &["dragon", "model", "system"]),
    ("server", &["desktop", "gpu", "protocol", "scene", "shaders", "system", "trace", "transport"]),
    (
        "server/cli",
        &["desktop", "dragon", "gpu", "protocol", "scene", "server", "shaders", "system", "transport"],
    ),
    ("client-xr", &["desktop", "gpu", "protocol", "shaders", "system", "trace", "transport"]),
    ("android", &["client", "transport"]),
    ("tests/mock-runtime", &["protocol", "system"]),
    ("tests/support", &["mock-runtime", "protocol"]),
    ("tests/fuzz", &["client", "protocol", "scene", "shaders", "transport"]),
    (
        "tests/lab",
        &[
            "client",
            "desktop",
            "dragon",
            "fuzz",
            "gpu",
            "mock-runtime",
            "protocol",
            "scene",
            "server",
            "server-cli",
            "shaders",
            "system",
            "trace",
            "transport",
        ],
    ),
    (
        "tests/e2e",
        &[
            "client",
            "gpu",
            "lab",
            "mock-runtime",
            "protocol",
            "scene",
            "server",
            "server-cli",
            "shaders",
            "system",
            "test-support",
            "transport",
        ],
    ),
];
const FOR_TESTS: [&str; 2] = ["mock-runtime", "test-support"];
/// The crates whose folders import downwards only.
const FOLDERED: [&str; 3] = ["server/src", "client-xr/src", "tests/lab/src"];
const MAX_FUNCTION_LINES: usize = 70;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Rust files below a folder, with their texts up to their tests.
fn sources(folder: &str) -> Vec<(String, String)> {
    let mut files = Vec::new();
    let mut folders = vec![root().join(folder)];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).expect("a folder of the project") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.strip_prefix(root()).expect("below the root").display().to_string();
                let text = std::fs::read_to_string(&path).expect("a text");
                let product = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default().to_owned();
                files.push((name, product));
            }
        }
    }
    let is_test = |name: &str| name.ends_with("tests.rs") || name.contains("/tests/");
    files.retain(|(name, _)| !is_test(name));
    assert!(!files.is_empty(), "{folder} holds sources");
    files
}

fn product() -> impl Iterator<Item = (String, String)> {
    PRODUCT.into_iter().flat_map(sources)
}

/// Lines that are no comments.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(|line| line.split("//").next().unwrap_or_default())
}

/// Product files that name any of `words` though they are not in `allowed`, which are beginnings of paths.
#[track_caller]
fn assert_only(words: &[&str], allowed: &[&str]) {
    let names_it = |text: &str| code(text).any(|line| words.iter().any(|word| line.contains(word)));
    let is_allowed = |name: &str| allowed.iter().any(|start| name.starts_with(start));
    let found: Vec<_> =
        product().filter(|(name, text)| !is_allowed(name) && names_it(text)).map(|(name, _)| name).collect();
    assert!(found.is_empty(), "{words:?} in {found:?}");
    let is_there = product().any(|(name, text)| is_allowed(&name) && names_it(&text));
    assert!(is_there || allowed.is_empty(), "{words:?} is named nowhere: this test holds nothing");
}

#[test]
fn only_the_client_names_openxr() {
    assert_only(&["openxr::"], &["client-xr/"]);
}

#[test]
fn only_shutdown_waits_for_the_device_and_no_draw_is_indirect() {
    assert_only(&["device_wait_idle"], &["shared/gpu/src/context.rs"]);
    assert_only(&["draw_indirect", "draw_indexed_indirect"], &[]);
}

#[test]
fn clocks_and_sockets_are_the_drivers() {
    let drivers = [
        "server/src/serve/stream/",
        "server/src/truth/",
        "server/cli/src/",
        "client-xr/src/net",
        "client-xr/src/display/window/mod.rs",
        // For a runtime that does not convert its times.
        "client-xr/src/display/xr/mod.rs",
        "client-xr/src/platform",
        "client-xr/src/main.rs",
        "shared/transport/src/mio.rs",
        "shared/transport/src/discovery/search.rs",
        "shared/system/src/clock.rs",
        "shared/system/src/lib.rs",
        // The instant from which its callers' nanoseconds count, for a library that wants instants.
        "shared/transport/src/endpoint.rs",
        // When a cached scene was used last is the file system's to know.
        "server/scene/src/cache.rs",
    ];
    assert_only(&["Instant::now", "SystemTime::now", "monotonic_now"], &drivers);
    assert_only(&["UdpSocket"], &["shared/transport/src/mio.rs", "shared/transport/src/discovery/search.rs"]);
}

#[test]
fn the_scheduler_alone_decides_whose_update_is_next() {
    let deciders = ["server/src/serve/scheduler/", "server/src/pacing/overlap.rs"];
    assert_only(&["Turns::", "Overlap::", "StepTimes {"], &deciders);
    assert_only(&["would_wait", "next_to_begin"], &["server/src/serve/scheduler/"]);
    for (name, text) in sources("tests/lab/src/session") {
        let decides = |word: &str| code(&text).any(|line| line.contains(word));
        assert!(!["Overlap", "Turns", "due_ns"].into_iter().any(decides), "{name} schedules");
    }
    let (_, pipeline) = sources("server/src/serve/stream")
        .into_iter()
        .find(|(name, _)| name.ends_with("/pipeline.rs"))
        .expect("the pipeline's driver");
    assert!(
        !["Instant::now", "monotonic_now"].iter().any(|clock| pipeline.contains(clock)),
        "a clock of its own"
    );
}

#[test]
fn session_events_are_understood_in_one_place_of_the_server() {
    assert_only(
        &["ServerEvent::"],
        &["shared/protocol/src/session.rs", "server/src/serve/sessions/", "server/src/serve/viewer.rs"],
    );
    for (name, text) in sources("tests/lab/src/session") {
        assert!(!text.contains("ServerSession") && !text.contains("ServerEvent"), "{name} has session logic");
    }
}

/// Unit tests are inline, up to so many lines; longer ones are in `tests.rs` of the module.
const MOST_INLINE_TEST_LINES: usize = 150;

#[test]
fn long_unit_tests_have_a_file_of_their_own() {
    for folder in PRODUCT.into_iter().chain(["tests/lab"]) {
        for (name, _) in sources(folder) {
            let text = std::fs::read_to_string(root().join(&name)).expect("a text");
            let lines = text.split_once("\nmod tests {\n").map_or(0, |(_, tests)| tests.lines().count());
            assert!(
                lines <= MOST_INLINE_TEST_LINES,
                "{name} has {lines} lines of tests: move them to tests.rs"
            );
        }
    }
}

#[test]
fn the_server_and_the_client_do_not_name_each_other() {
    for (folder, other) in [("server", "shadecast_client"), ("client-xr", "shadecast_server")] {
        for (name, text) in sources(folder) {
            assert!(!code(&text).any(|line| line.contains(other)), "{name} names {other}");
        }
    }
}

/// The `Cargo.toml` of a folder.
fn manifest(folder: &str) -> toml::Table {
    let text = std::fs::read_to_string(root().join(folder).join("Cargo.toml")).expect("a manifest");
    text.parse().expect("TOML")
}

/// A crate's short name in the project.
fn short(package: &str) -> Option<&str> {
    package.strip_prefix("shadecast-")
}

/// Crates of the project that a manifest names in sections of these kinds, for any target.
fn dependencies(manifest: &toml::Table, kinds: &[&str]) -> BTreeSet<String> {
    let targets =
        manifest.get("target").and_then(toml::Value::as_table).into_iter().flat_map(toml::Table::values);
    let tables = targets.filter_map(toml::Value::as_table).chain([manifest]);
    let sections = tables.flat_map(|table| kinds.iter().filter_map(|kind| table.get(*kind)?.as_table()));
    sections.flat_map(toml::Table::keys).filter_map(|name| short(name)).map(str::to_owned).collect()
}

#[test]
fn every_crate_is_in_the_table() {
    let workspace = manifest("");
    let members = workspace["workspace"]["members"].as_array().expect("a list of folders");
    let members: BTreeSet<_> = members.iter().filter_map(toml::Value::as_str).collect();
    assert_eq!(members, CRATES.iter().map(|(folder, _)| *folder).collect());
}

#[test]
fn crates_depend_on_lower_ones_and_on_those_of_the_table_alone() {
    let mut lower = BTreeSet::new();
    for (folder, allowed) in CRATES {
        let manifest = manifest(folder);
        let found = dependencies(&manifest, &["dependencies", "build-dependencies"]);
        let allowed: BTreeSet<_> = allowed.iter().map(|name| (*name).to_owned()).collect();
        assert_eq!(found, allowed, "{folder}");
        assert!(found.is_subset(&lower), "{folder}: {found:?} are not all above it in the table");
        let in_tests = dependencies(&manifest, &["dev-dependencies"]);
        let more: Vec<_> =
            in_tests.difference(&allowed).filter(|name| !FOR_TESTS.contains(&name.as_str())).collect();
        assert!(more.is_empty(), "{folder}: its tests depend on {more:?}");
        let name = manifest["package"]["name"].as_str().and_then(short).expect("a package of the project");
        lower.insert(name.to_owned());
    }
}

/// A module's path within its crate.
fn module(folder: &str, name: &str) -> Vec<String> {
    let inner = name.strip_prefix(folder).and_then(|inner| inner.strip_suffix(".rs")).expect("a source");
    let mut path: Vec<String> = inner.split('/').filter(|part| !part.is_empty()).map(str::to_owned).collect();
    if path.last().is_some_and(|last| ["mod", "lib", "main"].contains(&last.as_str())) {
        path.pop();
    }
    path
}

/// The modules that a text imports from, of those that there are.
fn imports(path: &[String], text: &str, modules: &BTreeSet<Vec<String>>) -> BTreeSet<Vec<String>> {
    let uses = text.split("\nuse ").skip(1).filter_map(|rest| rest.split(';').next());
    let mut found = BTreeSet::new();
    for import in uses {
        let (start, rest) = import.split_once("::").unwrap_or((import, ""));
        let base = match start.trim() {
            "crate" => Vec::new(),
            "super" => path[..path.len().saturating_sub(1)].to_vec(),
            _ => continue,
        };
        // `a::{b, c}` names a::b and a::c.
        let (stem, group) = rest.split_once('{').unwrap_or((rest, ""));
        let leaves = group.split([',', '{', '}']).chain([""]);
        for leaf in leaves {
            let parts = stem.split("::").chain(leaf.trim().split("::")).map(str::trim);
            let mut full = base.clone();
            full.extend(parts.filter(|part| !part.is_empty()).map(str::to_owned));
            while !full.is_empty() && !modules.contains(&full) {
                full.pop();
            }
            let is_kin = full.starts_with(path) || path.starts_with(&full);
            if !full.is_empty() && !is_kin {
                found.insert(full);
            }
        }
    }
    found
}

/// The modules that can be reached from one by imports.
fn reachable(from: &[String], edges: &BTreeMap<Vec<String>, BTreeSet<Vec<String>>>) -> BTreeSet<Vec<String>> {
    let mut seen = BTreeSet::new();
    let mut next = vec![from.to_vec()];
    while let Some(at) = next.pop() {
        for to in edges.get(&at).into_iter().flatten() {
            if seen.insert(to.clone()) {
                next.push(to.clone());
            }
        }
    }
    seen
}

#[test]
fn no_modules_import_from_each_other_in_a_circle() {
    for folder in PRODUCT {
        let texts: BTreeMap<_, _> = sources(folder)
            .into_iter()
            .filter(|(name, _)| !name.ends_with("/main.rs"))
            .map(|(name, text)| (module(folder, &name), text))
            .collect();
        let modules: BTreeSet<_> = texts.keys().cloned().collect();
        let edges = texts.iter().map(|(path, text)| (path.clone(), imports(path, text, &modules))).collect();
        let circles: Vec<_> = modules
            .iter()
            .filter(|path| reachable(path, &edges).contains(*path))
            .map(|path| path.join("::"))
            .collect();
        assert!(circles.is_empty(), "{folder}: a circle through {circles:?}");
    }
}

/// The names that a path begins with: `a` of `a::b`, `a` and `c` of `{a::b, c::{d, e}}`.
fn first_names(path: &str) -> Vec<String> {
    let word = |text: &str| text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let Some(group) = path.strip_prefix('{') else {
        return vec![word(path)];
    };
    let mut depth = 1;
    let is_own = |c: &char| {
        depth += i32::from(*c == '{') - i32::from(*c == '}');
        depth > 0
    };
    let inside: String = group.chars().take_while(is_own).collect();
    let mut depth = 0;
    inside
        .split(|c| {
            depth += i32::from(c == '{') - i32::from(c == '}');
            c == ',' && depth == 0
        })
        .map(|leaf| word(leaf.trim()))
        .filter(|name| !name.is_empty())
        .collect()
}

/// The top-level folders, and lone files, of its crate that a text names by `crate::` and `super::`, in imports and elsewhere.
fn named_folders(path: &[String], text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let code = code(text).collect::<Vec<_>>().join("\n");
    let to_root = "super::".repeat(path.len());
    for root in ["crate::", to_root.as_str()] {
        for (at, _) in code.match_indices(root) {
            let is_longer = code[..at].ends_with(|c: char| c.is_alphanumeric() || "_:$".contains(c));
            if is_longer {
                continue;
            }
            found.extend(first_names(&code[at + root.len()..]));
        }
    }
    found
}

#[test]
fn folders_are_found_by_the_paths_that_name_them() {
    let path = |text: &str| text.split("::").map(str::to_owned).collect::<Vec<_>>();
    let named = |at: &str, text: &str| named_folders(&path(at), text).into_iter().collect::<Vec<_>>();
    assert_eq!(named("a::b", "use crate::c::D;\nuse super::e::F;\nuse super::super::g::H;"), ["c", "g"]);
    assert_eq!(named("a", "use super::e::{F, G};\nfn f(x: &crate::h::I) {} // crate::j::K"), ["e", "h"]);
    assert_eq!(named("a", "use crate::{c::{D, E}, f, g::H};\nuse other_crate::i;\n{ j }"), ["c", "f", "g"]);
    assert_eq!(named("a", "fn f() { let b = crate::c::D { e: 1 }; g(2, h::I) }"), ["c"]);
}

#[test]
fn folders_import_downwards_only() {
    for crate_folder in FOLDERED {
        let mut edges: BTreeMap<Vec<String>, BTreeSet<Vec<String>>> = BTreeMap::new();
        let texts: Vec<_> = sources(crate_folder)
            .into_iter()
            .map(|(name, text)| (module(crate_folder, &name), text))
            .filter(|(path, _)| !path.is_empty())
            .collect();
        let folders: BTreeSet<String> = texts.iter().map(|(path, _)| path[0].clone()).collect();
        for (path, text) in &texts {
            let others = named_folders(path, text).into_iter().filter(|to| *to != path[0]);
            let to = others.filter(|to| folders.contains(to)).map(|to| vec![to]);
            edges.entry(vec![path[0].clone()]).or_default().extend(to);
        }
        let count: usize = edges.values().map(BTreeSet::len).sum();
        assert!(count > folders.len(), "{crate_folder}: {count} imports, this test sees none");
        let circles: Vec<_> =
            edges.keys().filter(|folder| reachable(folder, &edges).contains(*folder)).flatten().collect();
        assert!(circles.is_empty(), "{crate_folder}: a circle through {circles:?}");
    }
}

#[test]
fn no_function_is_longer_than_a_page() {
    let mut longest = 0;
    for (name, text) in product() {
        let lines: Vec<&str> = text.lines().collect();
        for (at, line) in lines.iter().enumerate() {
            let indent = line.len() - line.trim_start().len();
            let is_function =
                ["fn ", "pub fn ", "pub(crate) fn ", "pub(super) fn ", "const fn ", "unsafe fn "]
                    .iter()
                    .any(|start| line.trim_start().starts_with(start));
            // A trait's function without a body ends with a semicolon, however many lines it has.
            let head_end = lines[at..]
                .iter()
                .find_map(|line| line.trim_end().chars().last().filter(|c| ";{}".contains(*c)));
            if !is_function || head_end != Some('{') {
                continue;
            }
            let end = format!("{}}}", " ".repeat(indent));
            let count = lines[at..].iter().position(|line| *line == end).map_or(0, |end| end + 1);
            assert!(count <= MAX_FUNCTION_LINES, "{name}:{} has {count} lines", at + 1);
            longest = longest.max(count);
        }
    }
    assert!(longest > 20, "{longest}: this test sees no functions");
}
