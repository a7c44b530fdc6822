//! Levels of detail at run time, in virtual time: a weak client gets the whole scene at coarser LODs, wherever it goes, and
//! twice alike.

use shadecast_lab::experiments::detail::{DetailReport, measure};
use shadecast_lab::session::options::{Head, Renderer, RunOptions, USUAL_ROOM};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::room::Room;
use std::path::Path;

const ROOM: Room = Room { patches: 8000, vertices: 8000, triangles: 7000 };

/// Towards the dragons, and back.
fn there_and_back(folder: &Path) -> Head {
    let row = |t_s: f32, z: f32| format!("{t_s},0,1.6,{z},0,0,0,1\n");
    let path = folder.join("there-and-back.csv");
    let rows = [row(0.0, 9.0), row(0.2, 9.0), row(0.9, -0.5), row(1.6, 9.0), row(3.0, 9.0)];
    std::fs::write(&path, format!("t_s,x,y,z,qx,qy,qz,qw\n{}", rows.concat())).expect("a file");
    Head::File(path)
}

fn walk(folder: &Path, name: &str, detail_pixels: f32, room: Room) -> DetailReport {
    let options = RunOptions {
        renderer: Renderer::Local,
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 1.6,
        head: there_and_back(folder),
        validation: true,
        detail_pixels,
        room,
        ..RunOptions::new(SceneSource::Dragons(2), folder.join(name))
    };
    let report = measure(&options).expect("a run");
    println!("{name}: {report}");
    assert_eq!(report.validation_messages, Some(0), "{name}");
    report
}

#[test]
fn a_weak_client_gets_all_geometry_at_coarser_lod() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let full = walk(folder.path(), "full", 0.0, USUAL_ROOM);
    assert!(full.triangles.worst > 2.0 * f64::from(ROOM.triangles), "full detail would not fit: {full}");
    assert_eq!((full.switches.count, full.level.worst), (0, 0.0));
    let free = walk(folder.path(), "free", 0.5, USUAL_ROOM);
    assert!(free.triangles.mean < 0.8 * full.triangles.mean, "what is far is coarser: {free}");
    assert!(free.switches.count >= 4 && free.dropped_patches == 0, "levels change on the way: {free}");
    assert!(free.holes.mean <= full.holes.mean + 0.002, "{free}\nfull detail: {full}");
    let small = walk(folder.path(), "small", 0.5, ROOM);
    assert!(small.triangles.worst <= f64::from(ROOM.triangles), "{small}");
    assert!(small.patches.worst <= f64::from(ROOM.patches), "{small}");
    assert_eq!(small.dropped_patches, 0, "{small}");
    assert!(small.switches.count >= 2, "levels change on the way: {small}");
    assert_eq!(walk(folder.path(), "again", 0.5, ROOM), small);
}
