use super::*;
use clap::Parser;
use serde_json::Value;
use shadecast_scene::load::load_scene;
use std::collections::BTreeSet;

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    args: InspectArgs,
}

fn printed(arguments: &[&str]) -> String {
    let arguments = std::iter::once("inspect").chain(arguments.iter().copied());
    run(&Cli::try_parse_from(arguments).expect("arguments").args).expect("a report")
}

fn json(arguments: &[&str]) -> Value {
    serde_json::from_str(&printed(arguments)).expect("JSON")
}

fn keys(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(map) => map.iter().for_each(|(key, value)| {
            found.insert(key.clone());
            keys(value, found);
        }),
        Value::Array(list) => list.iter().for_each(|value| keys(value, found)),
        _ => {}
    }
}

/// What stands in the first column of a section's table, in backticks.
fn documented(section: usize) -> BTreeSet<String> {
    let page = include_str!("../../../../docs/inspect.md");
    let section = page.split("\n## ").nth(section).expect("the page has this section");
    let rows = section.lines().filter(|line| line.starts_with("| `"));
    let names =
        rows.flat_map(|row| row.split('|').nth(1).expect("a first column").split('`').skip(1).step_by(2));
    names.map(str::to_owned).collect()
}

/// A coarse sampling: these tests are about the report.
const COARSE: &str = "--sampling=constant:200ms";

fn scene_with_everything() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("dragon.glb"), shadecast_dragon::dragon()).expect("written");
    let scene = "
        [[model]]
        name = \"dragon\"
        file = \"dragon.glb\"

        [[instance]]
        model = \"dragon\"
    ";
    std::fs::write(folder.path().join("scene.toml"), scene).expect("written");
    folder
}

#[test]
fn documented_keys_of_inspect_are_those_emitted() {
    let mut report = Report::new(
        &load_scene(&SceneSource::Dragons(1)).expect("built in"),
        Sampling::Constant { interval_s: 0.5 },
        vec!["a warning".into()],
    );
    report.models[0].lods.push(LodReport { triangles: 1, error_m: 0.1, patches: PatchesReport::default() });
    let mut found = BTreeSet::new();
    keys(&serde_json::to_value(&report).expect("JSON"), &mut found);
    assert_eq!(found, documented(1));
}

#[test]
fn documented_keys_of_inspect_error_are_those_emitted() {
    let mut found = BTreeSet::new();
    keys(&errors::tests::small_report(), &mut found);
    assert_eq!(found, documented(2));
}

#[test]
fn a_file_called_by_a_scene_is_inspected_with_its_memory() {
    let folder = scene_with_everything();
    let path = folder.path().join("scene.toml");
    let report = json(&[path.to_str().expect("a name"), "--json", COARSE]);
    let dragon = &report["models"][0];
    assert_eq!((&dragon["name"], &dragon["bones"]), (&"dragon".into(), &137.into()));
    let parts = report["memory"].as_array().expect("parts");
    let sum = |shared| -> u64 {
        let of = parts.iter().filter(|part| part["shared"] == shared);
        of.map(|part| part["bytes"].as_u64().expect("a number")).sum()
    };
    assert_eq!(report["memory_shared_bytes"], sum(true));
    assert_eq!(report["memory_instances_bytes"], sum(false));
}

#[test]
fn more_instances_add_only_what_is_theirs() {
    let [one, nine] = [1, 9].map(|count| {
        let scene = load_scene(&SceneSource::Dragons(count)).expect("built in");
        Report::new(&scene, Sampling::Constant { interval_s: 0.5 }, Vec::new())
    });
    let shared = |report: &Report, part: &str| {
        report.memory.iter().find(|m| m.part == part).map(|m| m.bytes).expect("listed")
    };
    for part in ["vertices", "indices", "patches", "skeletons and clips", "morph targets"] {
        let (one, nine) = (shared(&one, part), shared(&nine, part));
        // The ground grows with the group; the dragons do not.
        assert!(nine <= one + one / 4, "{part}: {one} and {nine} bytes");
    }
    assert!(nine.memory_instances_bytes > 7 * one.memory_instances_bytes);
}

#[test]
fn shares_of_patches_are_those_of_their_counts() {
    let scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
    let model = &scene.models[0];
    let report = PatchesReport::new(model, 0);
    let counts = [report.single, report.pairs, report.triples];
    let all = counts.iter().sum::<usize>() as f32;
    let shares = [report.single_share, report.pairs_share, report.triples_share];
    assert_eq!(shares, counts.map(|count| count as f32 / all));
    assert_eq!(report.triangles_per_patch, (model.indices.len() / 3) as f32 / all);
    assert!((0.0..1.0).contains(&report.wasted_share));
    assert!(1.0 < report.mean_stretch && report.mean_stretch < report.worst_stretch);
}

#[test]
fn text_has_the_same_figures() {
    let text = printed(&["dragon", COARSE]);
    for expected in [
        "dragon: 1 instances",
        "137 bones",
        "patches:",
        "triangles each",
        "of the area wasted, stretch",
        "source keys",
        "memory on the GPU",
    ] {
        assert!(text.contains(expected), "{expected} is missing in\n{text}");
    }
}

#[test]
fn missing_scene_is_refused() {
    assert!(Cli::try_parse_from(["inspect"]).is_err());
    let error =
        run(&Cli::try_parse_from(["inspect", "drgon"]).expect("arguments").args).expect_err("no such file");
    assert!(error.to_string().contains("dragon"), "{error}");
    let spacing = Cli::try_parse_from(["inspect", "error", "dragon", "--spacing-ms", "0"]);
    assert!(spacing.map(|_| ()).expect_err("no spacing").to_string().contains("--spacing-ms"));
}
