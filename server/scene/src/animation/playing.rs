//! Poses of the played clips: of one clip, or of two during a cross-fade. CPU twin of the fade in `pose.glsl`.

use super::clip;
use super::sampling::SampledClip;
use crate::timeline::ClipIndex;
use crate::{Model, Trs};
use glam::{Quat, Vec4};
use shadecast_model::playback::{At, Playing};

/// The local transforms of all bones by the source curves.
pub fn source_pose(model: &Model, playing: &Playing<ClipIndex>) -> Vec<Trs> {
    let of = |at: &At<ClipIndex>| clip::source_pose(model, at.clip, at.phase_s(model.duration_s(at.clip)));
    faded(playing, of, |now, before, share| *now = mix(*now, before, share))
}

/// The weights of all morph targets by the source curves.
pub fn source_morph_weights(model: &Model, playing: &Playing<ClipIndex>) -> Vec<f32> {
    let of = |at: &At<ClipIndex>| {
        clip::source_morph_weights(model, at.clip, at.phase_s(model.duration_s(at.clip)))
    };
    faded(playing, of, mix_weights)
}

/// The local transforms of all bones by sampled clips, which `sampled` gives.
pub fn sampled_pose<'a>(
    sampled: impl Fn(ClipIndex) -> &'a SampledClip,
    playing: &Playing<ClipIndex>,
) -> Vec<Trs> {
    let of = |at: &At<ClipIndex>| {
        let clip = sampled(at.clip);
        clip.local_pose(at.phase_s(clip.duration_s))
    };
    faded(playing, of, |now, before, share| *now = mix(*now, before, share))
}

/// The weights of all morph targets by sampled clips.
pub fn sampled_morph_weights<'a>(
    sampled: impl Fn(ClipIndex) -> &'a SampledClip,
    playing: &Playing<ClipIndex>,
) -> Vec<f32> {
    let of = |at: &At<ClipIndex>| {
        let clip = sampled(at.clip);
        clip.morph_weights(at.phase_s(clip.duration_s))
    };
    faded(playing, of, mix_weights)
}

/// What is played, with its share of what is faded out.
fn faded<T>(
    playing: &Playing<ClipIndex>,
    of: impl Fn(&At<ClipIndex>) -> Vec<T>,
    mix: impl Fn(&mut T, T, f32),
) -> Vec<T> {
    let mut now = of(&playing.now);
    if let Some((fading, share)) = &playing.fading {
        now.iter_mut().zip(of(fading)).for_each(|(now, before)| mix(now, before, *share as f32));
    }
    now
}

fn mix_weights(now: &mut f32, before: f32, share: f32) {
    *now += (before - *now) * share;
}

/// Of the way from `now` to `before` the share: translations and scales linearly, rotations (of unit length) linearly along
/// the shorter arc and then made unit length.
pub fn mix(now: Trs, before: Trs, share: f32) -> Trs {
    let (to, from) = (Vec4::from(now.rotation), Vec4::from(before.rotation));
    let from = if to.dot(from) < 0.0 { -from } else { from };
    Trs {
        translation: now.translation.lerp(before.translation, share),
        // Half a turn apart, halfway, there is no arc that is shorter: what is played wins.
        rotation: Quat::from_vec4(to.lerp(from, share).try_normalize().unwrap_or(to)),
        scale: now.scale.lerp(before.scale, share),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_mix_turns_along_the_shorter_arc() {
        let at = |x: f32, angle: f32| Trs {
            translation: Vec3::X * x,
            rotation: Quat::from_rotation_y(angle),
            scale: Vec3::splat(1.0 + x),
        };
        let (now, mut before) = (at(0.0, 0.2), at(2.0, 1.0));
        for sign in [1.0, -1.0] {
            before.rotation = Quat::from_rotation_y(1.0) * sign;
            let half = mix(now, before, 0.5);
            assert_eq!((half.translation, half.scale), (Vec3::X, Vec3::splat(2.0)));
            assert!(half.rotation.angle_between(Quat::from_rotation_y(0.6)) < 1e-3, "{half:?}");
            assert_eq!(mix(now, before, 0.0).translation, now.translation);
            assert!(mix(now, before, 1.0).rotation.angle_between(before.rotation * sign) < 1e-3);
        }
    }
}
