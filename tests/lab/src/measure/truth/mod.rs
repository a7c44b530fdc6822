//! The truth about a scene at a time: the place of every vertex, by the source curves, in double precision.
//!
//! A scene's source file and a time enter. Positions of vertices and instances leave. Nothing here knows clients, updates and
//! sampled clips.
//!
//! It shares the source file with the renderer (curves, hierarchy, inverse binds, weights, morph targets) and nothing else: no
//! sampled clip, no shader, no function that poses or skins. The forward renderer draws its pictures, with the atlas's shading.

mod curves;
pub mod moving_shadow;

use curves::{InClip, Local, Shown, path_transform, weight};
use glam::{Affine3A, DAffine3, DMat3, DVec3};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::{Model, Scene, Vertex};
use shadecast_server::scene::SceneGpu;
use shadecast_server::scene::numbering::SceneVertex;
use shadecast_server::truth::forward::{Posed, PosedFrame};
use std::collections::HashMap;
use std::sync::Arc;

/// Where a scene's vertices are.
pub struct SceneTruth {
    scene: Arc<SceneGpu>,
    /// What was posed last, with its time.
    posed: Option<(WorldTime, Posed)>,
}

/// What brings an instance's vertices into the world at a time.
pub struct InstancePose {
    world_from_mesh: Vec<DAffine3>,
    /// Positions, normals and tangents in mesh space, morphs added; empty where there are none.
    morphed: Vec<Morphed>,
}

#[derive(Clone, Copy)]
struct Morphed {
    position: DVec3,
    normal: DVec3,
    tangent: DVec3,
}

impl SceneTruth {
    /// Of a scene.
    pub fn new(scene: &Arc<SceneGpu>) -> Self {
        Self { scene: scene.clone(), posed: None }
    }

    /// All vertices at a time, as the forward renderer takes them.
    pub fn posed(&mut self, time: WorldTime) -> &Posed {
        let known = self.posed.take().filter(|(known, _)| *known == time);
        &self.posed.insert(known.unwrap_or_else(|| (time, pose_scene(&self.scene, time)))).1
    }
}

/// Static instances first, then those that move, as `InstancePlace` numbers them.
fn pose_scene(scene: &SceneGpu, time: WorldTime) -> Posed {
    let statics = scene.numbering.totals.static_vertices as usize;
    let all = statics + scene.numbering.totals.animated_vertices as usize;
    let mut posed = Posed { positions: vec![[0.0; 4]; all], frames: vec![PosedFrame::default(); all] };
    for (index, place) in scene.numbering.instances.iter().enumerate() {
        let instance = &scene.scene.instances[index];
        let model = &scene.scene.models[instance.model];
        let pose = InstancePose::at(&scene.scene, index, time.seconds());
        let first = place.saved_base as usize + if place.is_animated { statics } else { 0 };
        for number in 0..model.vertices.len() {
            let (position, frame) = pose.vertex_and_frame(model, number);
            posed.positions[first + number] = position.as_vec3().extend(1.0).to_array();
            posed.frames[first + number] = frame;
        }
    }
    posed
}

/// Where single vertices of a scene are at one time; an instance is posed when it is first asked for.
pub struct VertexTruth<'a> {
    scene: &'a SceneGpu,
    time: WorldTime,
    poses: HashMap<usize, InstancePose>,
}

/// Whose vertex it is, and where.
pub struct TrueVertex {
    /// Index into the scene's instances.
    pub instance: usize,
    /// Index into the vertices of its model.
    pub number: usize,
    /// Where it is in the world, metres.
    pub position: DVec3,
}

impl<'a> VertexTruth<'a> {
    /// Of a scene at a time.
    pub fn at(scene: &'a SceneGpu, time: WorldTime) -> Self {
        Self { scene, time, poses: HashMap::new() }
    }

    /// A vertex by its scene-wide number.
    pub fn vertex(&mut self, vertex: SceneVertex) -> TrueVertex {
        let SceneGpu { scene, numbering, .. } = self.scene;
        let instance = numbering.instance_of_vertex(vertex);
        let place = &numbering.instances[instance];
        let number = (vertex.0 - place.first_vertex.0) as usize;
        let pose = || InstancePose::at(scene, instance, self.time.seconds());
        let pose = self.poses.entry(instance).or_insert_with(pose);
        TrueVertex { instance, number, position: pose.vertex(&scene.models[place.model], number) }
    }
}

impl InstancePose {
    /// Of an instance of the scene.
    pub fn at(scene: &Scene, instance: usize, time_s: f64) -> Self {
        let shown = curves::shown(scene, instance, time_s);
        let instance = &scene.instances[instance];
        let model = &scene.models[instance.model];
        let mut locals = locals(model, shown.now);
        if let Some((before, left)) = shown.before {
            let faded = |(now, before): (&mut Local, Local)| *now = now.faded(before, left);
            locals.iter_mut().zip(self::locals(model, before)).for_each(faded);
        }
        let placement = double(instance.placement);
        let path = instance.path.as_ref().map_or(DAffine3::IDENTITY, |path| path_transform(path, time_s));
        let world_from_model = path * placement;
        let mut world_from_bone: Vec<DAffine3> = Vec::with_capacity(locals.len());
        for (bone, local) in model.bones.iter().zip(&locals) {
            let parent = bone.parent.map_or(world_from_model, |parent| world_from_bone[parent as usize]);
            world_from_bone.push(parent * local.affine());
        }
        let entries = model.palette.iter();
        let world_from_mesh =
            entries.map(|entry| world_from_bone[entry.bone as usize] * double(entry.bone_from_mesh));
        Self { world_from_mesh: world_from_mesh.collect(), morphed: morphed(model, &shown) }
    }

    /// Where a vertex of the model is in the world, metres.
    pub fn vertex(&self, model: &Model, number: usize) -> DVec3 {
        let vertex = &model.vertices[number];
        self.blend(vertex).transform_point3(self.mesh(vertex, number).position)
    }

    fn vertex_and_frame(&self, model: &Model, number: usize) -> (DVec3, PosedFrame) {
        let vertex = &model.vertices[number];
        let (matrix, mesh) = (self.blend(vertex), self.mesh(vertex, number));
        let normal = perpendicular(matrix.matrix3, mesh.normal);
        let tangent = (matrix.matrix3 * mesh.tangent).normalize_or_zero();
        let frame =
            PosedFrame { normal: normal.as_vec3(), tangent: tangent.as_vec3().extend(vertex.tangent[3]) };
        (matrix.transform_point3(mesh.position), frame)
    }

    fn mesh(&self, vertex: &Vertex, number: usize) -> Morphed {
        self.morphed.get(number).copied().unwrap_or_else(|| Morphed::of(vertex))
    }

    /// Linear blend skinning: the weighted mean of the matrices.
    fn blend(&self, vertex: &Vertex) -> DAffine3 {
        let mut sum = DAffine3 { matrix3: DMat3::ZERO, translation: DVec3::ZERO };
        for (joint, weight) in vertex.joints.into_iter().zip(vertex.weights) {
            let matrix = &self.world_from_mesh[usize::from(joint)];
            sum.matrix3 += matrix.matrix3 * f64::from(weight);
            sum.translation += matrix.translation * f64::from(weight);
        }
        sum
    }
}

impl Morphed {
    fn of(vertex: &Vertex) -> Self {
        let [x, y, z, _] = vertex.tangent.map(f64::from);
        let (position, normal) = (vertex.position.as_dvec3(), vertex.normal.as_dvec3());
        Self { position, normal, tangent: DVec3::new(x, y, z) }
    }
}

/// The normal of what the matrix makes of a surface: across two directions that lie in it.
fn perpendicular(matrix: DMat3, normal: DVec3) -> DVec3 {
    let along = normal.any_orthonormal_vector();
    let across = normal.cross(along);
    let turned = (matrix * along).cross(matrix * across).normalize_or_zero();
    if matrix.determinant() < 0.0 { -turned } else { turned }
}

/// The local transforms of all bones in a clip.
fn locals(model: &Model, at: InClip) -> Vec<Local> {
    let mut locals: Vec<Local> = model.bones.iter().map(|bone| bone.rest.into()).collect();
    for track in at.clip.iter().flat_map(|clip| &model.clips[*clip].tracks) {
        locals[track.bone as usize].apply(track, at.phase_s);
    }
    locals
}

/// The weights of all morph targets in a clip.
fn weights(model: &Model, at: InClip) -> Vec<f64> {
    let mut weights: Vec<f64> = model.morphs.iter().map(|morph| f64::from(morph.rest_weight)).collect();
    for track in at.clip.iter().flat_map(|clip| &model.clips[*clip].morph_tracks) {
        for morph in 0..track.morph_count as usize {
            weights[track.first_morph as usize + morph] = weight(track, morph, at.phase_s);
        }
    }
    weights
}

fn morphed(model: &Model, shown: &Shown) -> Vec<Morphed> {
    if model.morphs.is_empty() {
        return Vec::new();
    }
    let mut weights = weights(model, shown.now);
    if let Some((before, left)) = shown.before {
        let faded = |(now, before): (&mut f64, f64)| *now += (before - *now) * left;
        weights.iter_mut().zip(self::weights(model, before)).for_each(faded);
    }
    let mut found: Vec<Morphed> = model.vertices.iter().map(Morphed::of).collect();
    for (morph, weight) in model.morphs.iter().zip(weights) {
        for delta in &morph.deltas {
            let vertex = &mut found[delta.vertex as usize];
            vertex.position += delta.position.as_dvec3() * weight;
            vertex.normal += delta.normal.as_dvec3() * weight;
            vertex.tangent += delta.tangent.as_dvec3() * weight;
        }
    }
    for vertex in &mut found {
        vertex.normal = vertex.normal.normalize_or_zero();
    }
    found
}

fn double(matrix: Affine3A) -> DAffine3 {
    DAffine3::from_mat3_translation(matrix.matrix3.as_dmat3(), matrix.translation.as_dvec3())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use shadecast_scene::Repetition;
    use shadecast_scene::animation::{playing, pose};
    use shadecast_scene::load::{SceneSource, load_scene};
    use shadecast_scene::timeline::{Change, Event};

    /// The scene crate's own evaluation is in single precision: equal up to that, or one of both is wrong.
    #[track_caller]
    fn assert_agrees(scene: &Scene, instance: usize, time_s: f64) {
        let placed = &scene.instances[instance];
        let model = &scene.models[placed.model];
        let playing = scene.schedules()[instance].at(WorldTime((time_s * 1e9).round() as i64));
        let vertices = pose::morphed(model, &playing::source_morph_weights(model, &playing));
        let palette = pose::palette(model, &pose::global_pose(model, &playing::source_pose(model, &playing)));
        let expected = pose::skin(&vertices, &palette, placed.world_from_model(time_s));
        let found = InstancePose::at(scene, instance, time_s);
        for (number, expected) in expected.iter().enumerate() {
            let (position, frame) = found.vertex_and_frame(model, number);
            let off_m = position.as_vec3().distance(expected.position);
            assert!(off_m < 2e-5, "{}, {time_s} s, vertex {number}: {off_m} m", placed.name);
            let turned = frame.normal.distance(expected.normal);
            assert!(turned < 2e-3, "{}, {time_s} s, vertex {number}: normal {turned} off", placed.name);
            let tangent = frame.tangent.truncate();
            let turned = tangent.distance(Vec3::from_slice(&expected.tangent[..3]));
            assert!(turned < 2e-3, "{}, {time_s} s, vertex {number}: tangent {turned} off", placed.name);
        }
    }

    #[test]
    fn two_evaluations_of_the_source_agree() {
        let mut scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        let stretched = Affine3A::from_scale_rotation_translation(
            Vec3::new(0.5, 1.5, 1.0),
            Quat::from_rotation_y(0.4),
            Vec3::new(1.0, 0.0, -2.0),
        );
        scene.instances[0].placement = stretched;
        scene.instances[0].speed = -1.3;
        for time_s in [0.0, 0.7137, 3.99] {
            assert_agrees(&scene, 0, time_s);
        }
    }

    /// Every kind of change, two of them with a fade, to and from a clip that is given.
    fn eventful(scene: &mut Scene, clip: usize) {
        let event = |at_ms: i64, change| Event { at: WorldTime(at_ms * 1_000_000), instance: 0, change };
        let fade_ns = 600_000_000;
        scene.events = vec![
            event(2500, Change { speed: Some(0.0), ..Change::default() }),
            event(500, Change { clip: Some(Some(clip)), fade_ns, ..Change::default() }),
            event(
                3000,
                Change { speed: Some(-1.5), repetition: Some(Repetition::PingPong), ..Change::default() },
            ),
            event(1500, Change { clip: Some(None), local_s: Some(0.2), fade_ns, ..Change::default() }),
            event(2200, Change { clip: Some(Some(0)), local_s: Some(0.4), ..Change::default() }),
        ];
    }

    #[test]
    fn two_evaluations_of_events_and_fades_agree() {
        let mut scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        (scene.instances[0].time_shift_s, scene.instances[0].speed) = (0.7, 0.9);
        eventful(&mut scene, 0);
        for time_s in [0.3, 0.5, 0.613, 1.4, 1.6, 1.999, 2.15, 2.3, 2.7, 2.9, 3.3, 9.1] {
            assert_agrees(&scene, 0, time_s);
        }
        let at = |time_s| InstancePose::at(&scene, 0, time_s).vertex(&scene.models[0], 17);
        assert_eq!(at(2.6), at(2.9), "it stands while it is paused");
        assert!(at(0.6).distance(at(0.7)) > 1e-6, "and moves while it is not");
    }

    #[test]
    fn two_evaluations_of_a_fade_of_a_strangers_file_agree() {
        for (name, clip) in [("Fox.glb", 2), ("MorphStressTest.gltf", 1)] {
            let Some(path) = crate::scenes::assets::asset(name) else {
                eprintln!("SKIPPED: {name} is not there; the project ships no models of others");
                continue;
            };
            let mut scene = load_scene(&SceneSource::File(path)).expect(name);
            eventful(&mut scene, clip);
            for time_s in [0.61, 0.99, 1.77] {
                assert_agrees(&scene, 0, time_s);
            }
        }
    }

    #[test]
    fn two_evaluations_of_a_strangers_file_agree() {
        for name in ["Fox.glb", "CesiumMan.glb", "MorphStressTest.gltf"] {
            let Some(path) = crate::scenes::assets::asset(name) else {
                eprintln!("SKIPPED: {name} is not there; the project ships no models of others");
                continue;
            };
            let scene = load_scene(&SceneSource::File(path)).expect(name);
            assert_agrees(&scene, 0, 0.613);
        }
    }
}
