//! Twin of `client_pose.comp`: palettes and morph weights of an instance at a time, from the words of the client's arena.
//! Double precision shows the error of single precision.

use crate::constants::{CUBIC_TRACK, LINEAR_TRACK, POSE_FROM_GRID, POSE_HAS_PATH, POSE_READY, STEP_TRACK};
use crate::generated::{EntryGpu, PlacedPoseGpu, PoseGpu, TrackGpu};

/// An affine transform as rows.
pub type Rows = [[f64; 4]; 3];

/// The client's arena, as words and under its views.
#[derive(Clone, Copy, Debug)]
pub struct Arena<'a>(pub &'a [[u32; 4]]);

/// What an instance's vertices are skinned with.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// `world_from_mesh` by palette entry.
    pub palette: Vec<Rows>,
    /// By morph.
    pub morph_weights: Vec<f64>,
}

impl Arena<'_> {
    fn view<T: bytemuck::Pod>(&self, index: u32) -> T {
        let size = size_of::<T>();
        bytemuck::pod_read_unaligned(&bytemuck::cast_slice(self.0)[index as usize * size..][..size])
    }

    /// Bones of the pose's skeleton.
    pub fn bone_count(&self, pose: &PoseGpu) -> u32 {
        self.view(pose.level_base + pose.level_count)
    }

    fn key(&self, index: u32) -> [f64; 4] {
        self.view::<[f32; 4]>(index).map(f64::from)
    }

    fn time_s(&self, index: u32) -> f64 {
        f64::from(self.view::<f32>(index))
    }

    /// A track's value at a phase, held before the first and after the last key.
    fn sample(&self, track: u32, phase_s: f64) -> [f64; 4] {
        let track: TrackGpu = self.view(track);
        let time_s = |key: u32| self.time_s(track.first_time + key);
        let after = (0..track.key_count).take_while(|key| track.key_count > 1 && time_s(*key) <= phase_s);
        let before = (after.count() as u32).saturating_sub(1);
        let stride = if track.kind == CUBIC_TRACK && track.key_count > 1 { 2 } else { 1 };
        let value = |key: u32| self.key(track.first_key + stride * key);
        if before + 1 >= track.key_count || track.kind == STEP_TRACK {
            return value(before);
        }
        let span_s = time_s(before + 1) - time_s(before);
        let f = ((phase_s - time_s(before)) / span_s).max(0.0);
        let (from, to) = (value(before), value(before + 1));
        if track.kind == LINEAR_TRACK {
            return mix(from, to, f);
        }
        let tangent = |key: u32| self.key(track.first_key + stride * key + 1);
        let (leaving, arriving) = (tangent(before), tangent(before + 1));
        let (f2, f3) = (f * f, f * f * f);
        let [a, b] = [2.0 * f3 - 3.0 * f2 + 1.0, span_s * (f3 - 2.0 * f2 + f)];
        let [c, d] = [3.0 * f2 - 2.0 * f3, span_s * (f3 - f2)];
        std::array::from_fn(|i| a * from[i] + b * leaving[i] + c * to[i] + d * arriving[i])
    }

    /// The value of a pose's track, and what is faded out of it.
    fn faded(&self, pose: &PoseGpu, track: u32, is_rotation: bool) -> [f64; 4] {
        let value = self.sample(pose.track_base + track, phase_s(pose.phase_s, pose.phase_low_s));
        if pose.fading <= 0.0 {
            return value;
        }
        let fading_s = phase_s(pose.fading_phase_s, pose.fading_phase_low_s);
        let before = self.sample(pose.fading_track_base + track, fading_s);
        if !is_rotation {
            return mix(value, before, f64::from(pose.fading));
        }
        let value = unit(value);
        mix(value, near(unit(before), value), f64::from(pose.fading))
    }

    /// A word of a step on the grid, between the steps.
    fn on_grid(&self, placed: &PlacedPoseGpu, word: u32, is_rotation: bool) -> [f64; 4] {
        let key = |step: usize| self.key(placed.grid_words[step] + word);
        let mut sum = [0.0; 4];
        for (step, weight) in placed.grid_weights.into_iter().enumerate() {
            let value = if is_rotation { near(key(step), key(1)) } else { key(step) };
            sum = std::array::from_fn(|i| sum[i] + f64::from(weight) * value[i]);
        }
        sum
    }

    /// `parent_from_bone`.
    fn local(&self, placed: &PlacedPoseGpu, bone: u32) -> Rows {
        let value = |member: u32| match placed.flags & POSE_FROM_GRID {
            0 => self.faded(&placed.pose, 3 * bone + member, member == 1),
            _ => self.on_grid(placed, 3 * bone + member, member == 1),
        };
        transform(value(0), value(1), value(2))
    }

    fn world_from_model(&self, placed: &PlacedPoseGpu) -> Rows {
        let placement = placed.placement.map(|row| row.map(f64::from));
        if placed.flags & POSE_HAS_PATH == 0 {
            return placement;
        }
        let at_s = phase_s(placed.path_phase_s, placed.path_phase_low_s);
        let [t, q, s] = [0, 1, 2].map(|member| self.sample(placed.path_track_base + member, at_s));
        multiply(&transform(t, q, s), &placement)
    }

    fn morph_weight(&self, placed: &PlacedPoseGpu, bones: u32, morph: u32) -> f64 {
        match placed.flags & POSE_FROM_GRID {
            0 => self.faded(&placed.pose, 3 * bones + morph, false)[0],
            _ => self.on_grid(placed, 3 * bones + morph / 4, false)[morph as usize % 4],
        }
    }

    /// One workgroup of `client_pose.comp`.
    pub fn pose(&self, placed: &PlacedPoseGpu) -> Posed {
        let pose = &placed.pose;
        if placed.flags & POSE_READY == 0 {
            return Posed {
                palette: vec![[[0.0; 4]; 3]; pose.entry_count as usize],
                morph_weights: vec![0.0; placed.morph_count as usize],
            };
        }
        let bones = self.bone_count(pose);
        let world_from_model = self.world_from_model(placed);
        let mut globals: Vec<Rows> = Vec::new();
        for bone in 0..bones {
            let parent = self.view::<i32>(pose.bone_base + bone);
            let from = usize::try_from(parent).map_or(world_from_model, |parent| globals[parent]);
            globals.push(multiply(&from, &self.local(placed, bone)));
        }
        let entry = |entry: u32| {
            let entry: EntryGpu = self.view(pose.entry_base + entry);
            let bone_from_mesh = entry.bone_from_mesh.map(|row| row.map(f64::from));
            multiply(&globals[entry.bone[0] as usize], &bone_from_mesh)
        };
        Posed {
            palette: (0..pose.entry_count).map(entry).collect(),
            morph_weights: (0..placed.morph_count).map(|m| self.morph_weight(placed, bones, m)).collect(),
        }
    }
}

fn phase_s(high_s: f32, low_s: f32) -> f64 {
    f64::from(high_s) + f64::from(low_s)
}

fn mix(from: [f64; 4], to: [f64; 4], f: f64) -> [f64; 4] {
    std::array::from_fn(|i| from[i] * (1.0 - f) + to[i] * f)
}

fn dot(a: [f64; 4], b: [f64; 4]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn unit(q: [f64; 4]) -> [f64; 4] {
    q.map(|c| c / dot(q, q).sqrt())
}

/// `q`, or the same rotation with the other sign, whichever is in the hemisphere of `of`.
fn near(q: [f64; 4], of: [f64; 4]) -> [f64; 4] {
    if dot(q, of) < 0.0 { q.map(|c| -c) } else { q }
}

/// `a * b`.
pub fn multiply(a: &Rows, b: &Rows) -> Rows {
    let row = |r: [f64; 4]| {
        std::array::from_fn(|c| {
            r[0] * b[0][c] + r[1] * b[1][c] + r[2] * b[2][c] + if c == 3 { r[3] } else { 0.0 }
        })
    };
    a.map(row)
}

/// translate * rotate * scale; `q` of any length but 0.
fn transform(t: [f64; 4], q: [f64; 4], s: [f64; 4]) -> Rows {
    let [x, y, z, w] = unit(q);
    let rotation = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    [0, 1, 2].map(|r| {
        let [a, b, c] = rotation[r];
        [a * s[0], b * s[1], c * s[2], t[r]]
    })
}
