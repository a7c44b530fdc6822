//! The device limits that a scene must fit into.

use crate::scene::SceneGpu;
use crate::scene::numbering::Totals;
use crate::skinning::gpu::{Animation, check_room as check_saved};
use crate::skinning::passes::palette::BONE_BYTES;
use crate::support::upload::check_room;
use shadecast_gpu::{Gpu, GpuError};

/// That the device can hold what updates of this scene need.
///
/// # Errors
/// It cannot; the text names what is too large, what the device binds, and what to do.
pub fn check_device(gpu: &Gpu, scene: &SceneGpu) -> Result<(), GpuError> {
    check_saved(scene)?;
    let needs = needs(scene.numbering.totals, Animation::places_for(scene));
    needs.into_iter().try_for_each(|(what, bytes)| check_room(gpu, what, bytes))
}

/// What the stages bind at once, in bytes, as far as it grows with the scene.
fn needs(totals: Totals, times: u32) -> [(&'static str, u64); 3] {
    let of_all_times = |count: u32| u64::from(times) * u64::from(count) * BONE_BYTES;
    [
        ("bones of all instances and sample times", of_all_times(totals.bones)),
        ("palettes of all instances and sample times", of_all_times(totals.palette)),
        ("patches of all instances", u64::from(totals.in_lod_set) * size_of::<u32>() as u64),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_scene_needs_of_the_device_is_known_before_a_client_comes() {
        let dragons = |count: u32| Totals { bones: count * 60, palette: count * 60, ..Totals::default() };
        let most = |count| needs(dragons(count), 4).into_iter().map(|(_, bytes)| bytes).max();
        assert!(most(169) < Some(128 << 20), "the paper's largest scene fits what every device binds");
        assert!(most(20_000) > Some(128 << 20));
    }
}
