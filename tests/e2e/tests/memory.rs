//! Memory of a server, with the paper's largest scene and after hundreds of updates.

use shadecast_lab::experiments::churn;
use shadecast_lab::experiments::paper_size;
use shadecast_lab::experiments::table1::cell::Size;
use shadecast_lab::session::options::RunOptions;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server_cli::inspect;
use shadecast_test_support::headset::turn;

/// What `inspect memory` prints as JSON.
fn inspected(arguments: &[&str]) -> serde_json::Value {
    use clap::Parser;
    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        args: inspect::InspectArgs,
    }
    let command = Command::parse_from(["inspect", "memory", "--json"].iter().chain(arguments));
    serde_json::from_str(&inspect::run(&command.args).expect("it can be inspected")).expect("JSON")
}

#[test]
fn a_hundred_and_sixty_nine_dragons_take_less_than_600_mb() {
    let report = inspected(&["dragons:169", "--size", "64x64", "--atlas", "4096x2048"]);
    let bytes = |key: &str| report[key].as_u64().expect(key);
    let [device, to_device, from_device] =
        ["device_bytes", "to_device_bytes", "from_device_bytes"].map(bytes);
    let all = device + to_device + from_device;
    assert!((100_000_000..600_000_000).contains(&all), "{device} + {to_device} + {from_device}");
    let parts = report["parts"].as_array().expect("parts");
    let of = |key: &str| parts.iter().map(|part| part[key].as_u64().expect(key)).sum::<u64>();
    assert_eq!(
        [of("device_bytes"), of("to_device_bytes"), of("from_device_bytes")],
        [device, to_device, from_device]
    );
    let has = |name: &str| parts.iter().any(|part| part["part"] == name);
    assert!(
        has("saved vertices") && has("tangents") && has("shading atlas") && has("planes for the encoder")
    );
    // Nothing that moves is mirrored: what is mapped is lists, and what the encoder and the layout read.
    let mirrored = parts.iter().filter(|part| part["part"] == "saved vertices");
    assert!(mirrored.into_iter().all(|part| part["to_device_bytes"] == 0 && part["from_device_bytes"] == 0));
}

#[test]
fn hundreds_of_updates_leave_nothing_behind() {
    let folder = tempfile::tempdir().expect("a folder");
    let options = RunOptions {
        extent_pixels: [64, 64],
        validation: true,
        atlas_extent_texels: AtlasExtent::new(512, 512).expect("an atlas"),
        surround: DEFAULT_SURROUND,
        ..RunOptions::new(SceneSource::Dragons(3), folder.path().join("run"))
    };
    let report = churn::measure(&options, 200).expect("it runs");
    assert_eq!(report.validation_messages, Some(0));
    assert_eq!(report.device_bytes_before, report.device_bytes_after, "{report}");
    assert!(report.grown_mb < 48.0, "{report}");
}

#[test]
fn all_visible_dragons_have_room() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let found = paper_size::measure(4, Size::at(0.08).unwrap(), out.path()).unwrap();
    assert_eq!((found.dragons, found.dropped_patches, found.validation_messages), (4, 0, 0), "{found}");
    assert!(found.updates > 15 && found.patches > 1000 && found.vertices > 1000, "{found}");
    assert!(found.vertices <= found.room_vertices as usize && found.device_bytes < 200_000_000, "{found}");
}
