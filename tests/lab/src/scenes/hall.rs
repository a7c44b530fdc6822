//! A hall of machines: many instances of one stiff model, each at another moment of its work.

use super::robot::robot;
use std::path::{Path, PathBuf};

/// Machines side by side, and behind each other.
const MACHINES: [u32; 2] = [8, 6];
/// From one to the next, metres.
const APART_M: f32 = 1.5;
/// From the head to the middle of all, metres.
const MIDDLE_M: f32 = 6.0;
/// From one machine's moment to the next one's, seconds.
const LATER_S: f32 = 0.37;

/// Writes the machines and a scene before which one stands; gives the scene's path.
///
/// # Errors
/// The folder cannot be written.
pub fn write_hall(folder: &Path) -> std::io::Result<PathBuf> {
    std::fs::write(folder.join("robot.glb"), robot())?;
    let [across, behind] = MACHINES;
    let machines = format!(
        "[[grid]]\nmodel = \"robot\"\ncount = [{across}, 1, {behind}]\nspacing = [{APART_M}, 1, -{APART_M}]\n\
         center = [0, 0, -{MIDDLE_M}]\ntime_shift_step_s = {LATER_S}\n"
    );
    let scene = folder.join("hall.toml");
    std::fs::write(&scene, format!("[[model]]\nname = \"robot\"\nfile = \"robot.glb\"\n{machines}"))?;
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};

    #[test]
    fn a_hall_has_all_its_machines() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene =
            load_scene(&SceneSource::File(write_hall(folder.path()).expect("written"))).expect("valid");
        // The ground is an instance, too.
        assert_eq!(scene.instances.len() as u32, MACHINES[0] * MACHINES[1] + 1);
    }
}
