//! The one-time data of a client that skins by itself: skeletons, meshes, instances and vertices before skinning.

use super::sender::{MotionSender, SharedMotion};
use crate::animation::timeline::SharedTimeline;
use crate::scene::SceneGpu;
use crate::support::lock::lock;
use shadecast_protocol::geometry::{GeometryDelta, Motion};
use shadecast_protocol::ids::{RestId, SkeletonId};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::skeleton::SkinnedInstance;
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

/// What a vertex takes that enters, about, bytes: its place, and what it is before skinning.
const VERTEX_BYTES: usize = 1;
const REST_BYTES: usize = 12;

/// See the module.
pub(crate) struct Skinning {
    scene: Arc<SceneGpu>,
    /// By instance; `None` where it is not skinned by this client.
    instances: Vec<Option<SkinnedInstance>>,
    told_instances: Vec<bool>,
    told_skeletons: BTreeSet<SkeletonId>,
    told_meshes: BTreeSet<RestId>,
    told_rests: Vec<bool>,
    /// Instances by model.
    sharing: Vec<usize>,
    sender: SharedMotion,
}

impl std::fmt::Debug for Skinning {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Skinning").field("told_instances", &self.told_instances).finish_non_exhaustive()
    }
}

impl Skinning {
    /// For a client with so much memory, of which nothing is used yet.
    pub(crate) fn new(scene: &Arc<SceneGpu>, timeline: &SharedTimeline, memory: MotionMemory) -> Self {
        let instances = scene.motion.skinned(memory);
        let mut sharing = vec![0; scene.scene.models.len()];
        scene.scene.instances.iter().for_each(|instance| sharing[instance.model] += 1);
        Self {
            told_instances: vec![false; instances.len()],
            instances,
            told_skeletons: BTreeSet::new(),
            told_meshes: BTreeSet::new(),
            told_rests: vec![false; memory.rest_vertices as usize],
            sharing,
            sender: Arc::new(Mutex::new(MotionSender::new(scene, timeline, memory))),
            scene: scene.clone(),
        }
    }

    /// What sends the rest as time goes by.
    pub(crate) fn sender(&self) -> &SharedMotion {
        &self.sender
    }

    /// Whether an instance is skinned by the client.
    pub(crate) fn is_skinned(&self, instance: u16) -> bool {
        self.instances.get(usize::from(instance)).is_some_and(Option::is_some)
    }

    /// Whether updates predict what it does not skin.
    pub(crate) fn predicts_others(&self) -> bool {
        self.scene.motion.is_predicted()
    }

    /// About how many bytes a vertex of a skinned instance takes that enters.
    pub(crate) fn entry_bytes(&self, instance: u16, number: u32) -> usize {
        let is_told = self.told_rests[self.rest(instance, number).0 as usize];
        VERTEX_BYTES + if is_told { 0 } else { REST_BYTES }
    }

    /// The same where nothing is known to the client: instances of one model share what vertices are before skinning.
    pub(crate) fn new_vertex_bytes(&self, instance: u16) -> usize {
        VERTEX_BYTES + REST_BYTES.div_ceil(self.sharing[self.model(instance)])
    }

    /// A vertex enters, of a skinned instance: adds to the delta what the client must be told first.
    pub(crate) fn enter(&mut self, instance: u16, number: u32, delta: &mut GeometryDelta) -> Motion {
        if !std::mem::replace(&mut self.told_instances[usize::from(instance)], true) {
            self.report(instance, delta);
        }
        let rest = self.rest(instance, number);
        if !std::mem::replace(&mut self.told_rests[rest.0 as usize], true) {
            let library = &self.scene.motion;
            delta.new_rests.push(library.rest(&self.scene.scene, self.model(instance), number));
        }
        Motion::Skinned { rest }
    }

    fn report(&mut self, instance: u16, delta: &mut GeometryDelta) {
        let Some(mut told) = self.instances[usize::from(instance)].clone() else { return };
        let (library, mesh) = (&self.scene.motion, self.scene.motion.mesh(self.model(instance)));
        if self.told_skeletons.insert(told.skeleton) {
            delta.skinned.skeletons.push(library.skeleton(told.skeleton).clone());
        }
        if self.told_meshes.insert(mesh.first_rest) {
            delta.skinned.meshes.push(mesh);
        }
        lock(&self.sender).announce(&mut told);
        delta.skinned.instances.push(told);
    }

    fn model(&self, instance: u16) -> usize {
        self.scene.scene.instances[usize::from(instance)].model
    }

    fn rest(&self, instance: u16, number: u32) -> RestId {
        RestId(self.scene.motion.mesh(self.model(instance)).first_rest.0 + number)
    }
}
