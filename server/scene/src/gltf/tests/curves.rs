//! Real files evaluated twice: by this crate from its model, and here from the file's raw numbers, read by the `gltf`
//! crate's own iterators, in double precision and with interpolation code that shares nothing with the crate's.

use super::*;
use ::gltf::animation::Interpolation as Kind;
use ::gltf::animation::util::ReadOutputs;

/// Most moments of a clip that are compared; keys are taken evenly.
const MOMENTS: usize = 12;

type Values = Vec<Vec<f64>>;

struct Channel {
    node: usize,
    property: ::gltf::animation::Property,
    kind: Kind,
    times: Vec<f64>,
    /// One per key, three for splines.
    values: Values,
}

/// A file and its bytes.
struct Raw {
    document: ::gltf::Document,
    buffers: Vec<Vec<u8>>,
}

impl Raw {
    fn open(path: &Path) -> Self {
        let file = ::gltf::Gltf::open(path).expect("a good file");
        let blob = file.blob.clone();
        let bytes = |buffer: ::gltf::Buffer| match buffer.source() {
            ::gltf::buffer::Source::Bin => blob.clone().expect("a binary chunk"),
            ::gltf::buffer::Source::Uri(uri) => {
                buffer::read_uri(uri, &Surroundings::default()).expect("embedded")
            }
        };
        let buffers = file.buffers().map(bytes).collect();
        Self { document: file.document, buffers }
    }

    fn bytes(&self, buffer: &::gltf::Buffer) -> Option<&[u8]> {
        self.buffers.get(buffer.index()).map(Vec::as_slice)
    }

    fn channels(&self, animation: usize) -> Vec<Channel> {
        let animation = self.document.animations().nth(animation).expect("there");
        animation.channels().map(|channel| self.channel(&channel)).collect()
    }

    fn channel(&self, channel: &::gltf::animation::Channel) -> Channel {
        let reader = channel.reader(|buffer| self.bytes(&buffer));
        let times: Vec<f64> = reader.read_inputs().expect("keys").map(f64::from).collect();
        let wide = |values: &[f32]| values.iter().map(|value| f64::from(*value)).collect::<Vec<f64>>();
        let kind = channel.sampler().interpolation();
        let values: Values = match reader.read_outputs().expect("values") {
            ReadOutputs::Translations(list) | ReadOutputs::Scales(list) => list.map(|v| wide(&v)).collect(),
            ReadOutputs::Rotations(list) => list.into_f32().map(|v| wide(&v)).collect(),
            ReadOutputs::MorphTargetWeights(list) => {
                let all: Vec<f32> = list.into_f32().collect();
                let per_key = if kind == Kind::CubicSpline { 3 } else { 1 };
                all.chunks_exact(all.len() / (per_key * times.len())).map(wide).collect()
            }
        };
        Channel {
            node: channel.target().node().index(),
            property: channel.target().property(),
            kind,
            times,
            values,
        }
    }
}

impl Channel {
    fn at(&self, time: f64) -> Vec<f64> {
        let last = self.times.len() - 1;
        let next = self.times.iter().position(|key| *key > time).unwrap_or(last + 1);
        let is_spline = self.kind == Kind::CubicSpline;
        let value = |key: usize| &self.values[if is_spline { 3 * key + 1 } else { key }];
        if next == 0 || next > last || self.kind == Kind::Step {
            return value(next.saturating_sub(1)).clone();
        }
        let (from, span) = (next - 1, self.times[next] - self.times[next - 1]);
        let t = (time - self.times[from]) / span;
        let mixed = match (is_spline, self.property) {
            (true, _) => {
                let (out, arriving) = (&self.values[3 * from + 2], &self.values[3 * next]);
                (0..value(from).len())
                    .map(|i| {
                        // Appendix C of the specification, as it is printed there.
                        (2.0 * t.powi(3) - 3.0 * t.powi(2) + 1.0) * value(from)[i]
                            + span * (t.powi(3) - 2.0 * t.powi(2) + t) * out[i]
                            + (-2.0 * t.powi(3) + 3.0 * t.powi(2)) * value(next)[i]
                            + span * (t.powi(3) - t.powi(2)) * arriving[i]
                    })
                    .collect()
            }
            (false, ::gltf::animation::Property::Rotation) => slerp(value(from), value(next), t),
            _ => value(from).iter().zip(value(next)).map(|(a, b)| a + (b - a) * t).collect(),
        };
        if self.property == ::gltf::animation::Property::Rotation { unit(&mixed) } else { mixed }
    }
}

fn unit(q: &[f64]) -> Vec<f64> {
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    q.iter().map(|c| c / length).collect()
}

fn slerp(a: &[f64], b: &[f64], t: f64) -> Vec<f64> {
    let (a, b) = (unit(a), unit(b));
    let dot: f64 = a.iter().zip(&b).map(|(a, b)| a * b).sum();
    let angle = dot.abs().min(1.0).acos();
    let (from, to) = match angle < 1e-9 {
        true => (1.0 - t, t),
        false => (((1.0 - t) * angle).sin() / angle.sin(), (t * angle).sin() / angle.sin()),
    };
    a.iter().zip(&b).map(|(a, b)| from * a + to * dot.signum() * b).collect()
}

/// `model_from_node` of every node.
fn globals(raw: &Raw, channels: &[Channel], time: f64) -> Vec<Matrix> {
    let local = |node: &::gltf::Node| -> Matrix {
        let moved = channels.iter().filter(|channel| channel.node == node.index());
        let (t, r, s) = node.transform().decomposed();
        let (mut t, mut r, mut s) = (t.map(f64::from), r.map(f64::from), s.map(f64::from));
        for channel in moved {
            match (channel.property, &channel.at(time)[..]) {
                (::gltf::animation::Property::Translation, [x, y, z]) => t = [*x, *y, *z],
                (::gltf::animation::Property::Scale, [x, y, z]) => s = [*x, *y, *z],
                (::gltf::animation::Property::Rotation, [x, y, z, w]) => r = [*x, *y, *z, *w],
                _ => {}
            }
        }
        textbook(t, r, s)
    };
    fn walk(
        node: &::gltf::Node,
        above: &Matrix,
        local: &dyn Fn(&::gltf::Node) -> Matrix,
        out: &mut [Matrix],
    ) {
        out[node.index()] = times(above, &local(node));
        let own = out[node.index()];
        node.children().for_each(|child| walk(&child, &own, local, out));
    }
    let identity = textbook([0.0; 3], [0.0, 0.0, 0.0, 1.0], [1.0; 3]);
    let mut out = vec![identity; raw.document.nodes().len()];
    for node in raw.document.default_scene().expect("a scene").nodes() {
        walk(&node, &identity, &local, &mut out);
    }
    out
}

/// Rest position and position at `time` of every vertex that the scene shows.
fn evaluate(raw: &Raw, animation: usize, time: f64) -> Vec<([f32; 3], [f64; 3])> {
    let channels = raw.channels(animation);
    let globals = globals(raw, &channels, time);
    let mut all = Vec::new();
    for node in raw.document.nodes() {
        let Some(mesh) = node.mesh() else { continue };
        let weights = channels
            .iter()
            .find(|c| c.node == node.index() && c.property == ::gltf::animation::Property::MorphTargetWeights)
            .map_or_else(
                || mesh.weights().unwrap_or_default().iter().map(|weight| f64::from(*weight)).collect(),
                |channel| channel.at(time),
            );
        let palette = node.skin().map(|skin| {
            let reader = skin.reader(|buffer| raw.bytes(&buffer));
            let bind = reader.read_inverse_bind_matrices().expect("bind matrices");
            let rows = |m: [[f32; 4]; 4]| -> Matrix {
                std::array::from_fn(|i| std::array::from_fn(|j| f64::from(m[j][i])))
            };
            skin.joints()
                .zip(bind)
                .map(|(joint, m)| times(&globals[joint.index()], &rows(m)))
                .collect::<Vec<_>>()
        });
        for primitive in mesh.primitives() {
            let reader = primitive.reader(|buffer| raw.bytes(&buffer));
            let rest: Vec<[f32; 3]> = reader.read_positions().expect("positions").collect();
            let targets: Vec<Vec<[f32; 3]>> = reader
                .read_morph_targets()
                .map(|(positions, ..)| positions.expect("deltas").collect())
                .collect();
            let joints: Vec<[u16; 4]> =
                reader.read_joints(0).map(|list| list.into_u16().collect()).unwrap_or_default();
            let shares: Vec<[f32; 4]> =
                reader.read_weights(0).map(|list| list.into_f32().collect()).unwrap_or_default();
            for (index, position) in rest.iter().enumerate() {
                let morphed: [f64; 3] = std::array::from_fn(|axis| {
                    let added =
                        targets.iter().zip(&weights).map(|(target, w)| w * f64::from(target[index][axis]));
                    f64::from(position[axis]) + added.sum::<f64>()
                });
                let apply =
                    |m: &Matrix, i: usize| m[i][3] + (0..3).map(|j| m[i][j] * morphed[j]).sum::<f64>();
                let placed = match &palette {
                    Some(palette) => std::array::from_fn(|i| {
                        let sum: f64 = shares[index].iter().map(|w| f64::from(*w)).sum();
                        let parts = joints[index].iter().zip(shares[index]);
                        parts.map(|(j, w)| f64::from(w) / sum * apply(&palette[usize::from(*j)], i)).sum()
                    }),
                    None => std::array::from_fn(|i| apply(&globals[node.index()], i)),
                };
                all.push((*position, placed));
            }
        }
    }
    all
}

/// Largest distance, relative to the model's size, of a vertex from the nearest of the file's vertices that rest where
/// it does.
fn largest_error(model: &Model, raw: &Raw, animation: usize, time: f64) -> f64 {
    let expected = evaluate(raw, animation, time);
    let mut by_rest: HashMap<[u32; 3], Vec<[f64; 3]>> = HashMap::new();
    for (rest, placed) in &expected {
        by_rest.entry(rest.map(|c| (c + 0.0).to_bits())).or_default().push(*placed);
    }
    let size = expected.iter().flat_map(|(_, p)| p).fold(0.0f64, |size, c| size.max(c.abs()));
    let found = pose::source_skin(model, Some(animation), time, Affine3A::IDENTITY);
    let error = |(vertex, found): (&crate::Vertex, &pose::SkinnedVertex)| {
        let rest = (vertex.position + Vec3::ZERO).to_array().map(f32::to_bits);
        let distance = |p: &[f64; 3]| {
            let square = |axis: usize| (p[axis] - f64::from(found.position[axis])).powi(2);
            (0..3).map(square).sum::<f64>().sqrt()
        };
        by_rest.get(&rest).into_iter().flatten().map(distance).fold(f64::INFINITY, f64::min) / size
    };
    model.vertices.iter().zip(&found).map(error).fold(0.0, f64::max)
}

#[test]
fn poses_of_real_files_equal_an_independent_evaluation() {
    let Some(folder) = assets() else { return };
    for name in ["Fox.glb", "CesiumMan.glb", "RiggedSimple.glb", "MorphStressTest.gltf"] {
        let path = folder.join(name);
        let (model, raw) = (load(&path).expect("loads"), Raw::open(&path));
        let mut largest = [0.0f64; 2];
        for (animation, clip) in model.clips.iter().enumerate() {
            let mut keys: Vec<f64> = raw.channels(animation).iter().flat_map(|c| c.times.clone()).collect();
            keys.sort_by(f64::total_cmp);
            keys.dedup();
            let step = keys.len().div_ceil(MOMENTS);
            let at_keys = keys.iter().step_by(step).copied();
            let between = keys.windows(2).step_by(step).map(|pair| 0.3 * pair[0] + 0.7 * pair[1]);
            for (kind, times) in [at_keys.collect::<Vec<_>>(), between.collect()].into_iter().enumerate() {
                for time in times {
                    let error = largest_error(&model, &raw, animation, time);
                    assert!(error < 1e-5, "{name}, clip '{}' at {time} s: {error} of the size", clip.name);
                    largest[kind] = largest[kind].max(error);
                }
            }
        }
        eprintln!(
            "{name}: off by {:.1e} of the model's size at keys, {:.1e} between",
            largest[0], largest[1]
        );
    }
}
