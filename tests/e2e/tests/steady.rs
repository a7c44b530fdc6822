//! An atlas at rest, in virtual time, with the shipped LODs, surround, quality and density.

use shadecast_client::options::USUAL_STORE_PAGES;
use shadecast_lab::experiments::steadiness::{Steadiness, measure};
use shadecast_lab::scenes::room::write_room;
use shadecast_lab::session::options::{Head, RunOptions};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;

/// The room, and three small ones in it: ahead, behind and aside.
const SCENE: &str = r#"
[[model]]
name = "room"
file = "room.glb"
[[instance]]
model = "room"
[[instance]]
model = "room"
name = "ahead"
translation = [0.4, 0.8, -2.5]
scale = 0.1
[[instance]]
model = "room"
name = "behind"
translation = [0.5, 0.6, 1.5]
scale = 0.1
[[instance]]
model = "room"
name = "aside"
translation = [1.8, 0.9, -0.4]
scale = 0.08
[ground]
enabled = false
"#;

#[test]
fn at_rest_atlases_are_identical_and_deltas_empty() {
    let folder = tempfile::tempdir().expect("a folder");
    write_room(folder.path(), [2, 1]).expect("a room");
    let scene = folder.path().join("rest.toml");
    std::fs::write(&scene, SCENE).expect("a scene");
    for store_pages in [0, USUAL_STORE_PAGES] {
        let options = RunOptions {
            extent_pixels: [64, 64],
            atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
            head: Head::Named("still".into()),
            seconds: 8.0,
            surround: DEFAULT_SURROUND,
            store_pages,
            ..RunOptions::new(SceneSource::File(scene.clone()), folder.path().join("run"))
        };
        // This file has one test, and no thread has been started yet: the environment is its own.
        let report = measure(&options).expect("a run");
        println!("{report}");
        let last = report.updates.last().expect("updates");
        assert!(last.texels_per_pixel > 1.0, "there is room for more texels: {last:?}");
        let settled = report.from_which_on(Steadiness::is_at_rest).expect("it comes to rest");
        assert!(settled < 170, "it comes to rest at update {settled} of {}", last.update);
        if store_pages > 0 {
            assert_eq!(last.stayed, 0, "what is at rest is shown from the store");
            continue;
        }
        // The first updates show coarser LODs, and so fewer blocks: what changes is counted as a part of the blocks at rest.
        let resized = report.updates.iter().skip(1).map(|update| update.resized).max().unwrap_or(0);
        let part = resized as f64 / last.stayed as f64;
        assert!(part <= 0.05, "{part} of the blocks changed their size in one update");
    }
}
