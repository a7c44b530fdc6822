//! Messages of motion to one client, at motion's own cadence: playback changes, chunks of clips (those needed first), poses and
//! samples. It waits for no update, and no update waits for it.

use super::allowance::Allowance;
use super::chunks::Chunks;
use super::posed::{self, PosedInstances};
use super::sampled::{SampleWindow, SharedCoder};
use super::schedules::Schedules;
use crate::animation::timeline::SharedTimeline;
use crate::pacing::share::{Budget, WayState};
use crate::scene::SceneGpu;
use crate::scene::numbering::SceneVertex;
use crate::skinning::posing::CpuPose;
use crate::support::lock::lock;
use glam::Vec3;
use shadecast_protocol::ids::{ClipId, UpdateId};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::clip::{ClipChunk, chunk_at, chunk_count};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::motion::poses::GridPose;
use shadecast_protocol::motion::skeleton::{ClipRef, PoseSource, SkinnedInstance};
use shadecast_protocol::session::{Out, motion_stream, sample_stream};
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex, ServerTime, WorldTime};
use shadecast_protocol::world_clock::WorldClock;
use std::collections::{BTreeSet, HashMap};
use std::sync::{Arc, Mutex};

/// What is shown from this long ago, nanoseconds: the way to the display, and a head that looks back.
const BEHIND_NS: i64 = 300_000_000;
/// What is shown until then is sent at once, nanoseconds, beside the time that news need: it goes before all updates, and over a
/// slow link these wait for it.
const AHEAD_NS: i64 = 300_000_000;
/// The time between is looked at in these steps, nanoseconds: at usual speeds no chunk lies between two of them.
const LOOK_NS: i64 = 100_000_000;
/// Bytes of what is shown later that a step of the time grid brings at most.
const LATER_BYTES: usize = 16_384;
/// How far ahead samples reach before anything is known of the way, nanoseconds.
const START_LEAD_NS: i64 = 400_000_000;
/// What a loss costs beside a round trip until it is noticed, nanoseconds: a probe's delay, and jitter.
const NOTICE_NS: i64 = 60_000_000;
/// Of the steps that a client keeps it needs so many beside those ahead of now: behind the time that it shows, and around it.
const STEPS_BEHIND: i64 = 6;
/// Steps of a slow link's budget that add up, of poses and samples.
const SAVED_STEPS: i64 = 8;

/// A change of how the world's time goes on waits no longer than this for the slowest viewer, nanoseconds.
const MOST_CLOCK_LEAD_NS: i64 = 500_000_000;

/// What the thread of motion and the client's pipeline both work with.
pub(crate) type SharedMotion = Arc<Mutex<MotionSender>>;

/// As far ahead of now as samples can reach for a client that keeps so many steps, nanoseconds.
pub(crate) fn longest_lead_ns(sample_ring: u32) -> i64 {
    (i64::from(sample_ring) - STEPS_BEHIND) * DEFAULT_GRID.spacing_ns
}

/// Bytes of motion so far, by cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct MotionBytes {
    /// Chunks of clips.
    pub chunk_bytes: u64,
    /// Chunks of clips, counted.
    pub chunks: u64,
    /// Changes of what is played, and of how the world's time goes on.
    pub schedule_bytes: u64,
    /// Poses.
    pub pose_bytes: u64,
    /// Poses, counted.
    pub poses: u64,
    /// Samples.
    pub sample_bytes: u64,
    /// Samples, counted.
    pub samples: u64,
}

impl MotionBytes {
    /// All bytes.
    pub fn total(&self) -> u64 {
        self.chunk_bytes + self.schedule_bytes + self.pose_bytes + self.sample_bytes
    }
}

impl std::ops::Add for MotionBytes {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            chunk_bytes: self.chunk_bytes + other.chunk_bytes,
            chunks: self.chunks + other.chunks,
            schedule_bytes: self.schedule_bytes + other.schedule_bytes,
            pose_bytes: self.pose_bytes + other.pose_bytes,
            poses: self.poses + other.poses,
            sample_bytes: self.sample_bytes + other.sample_bytes,
            samples: self.samples + other.samples,
        }
    }
}

/// Where a vertex is at a grid point.
fn position(
    scene: &SceneGpu,
    timeline: &SharedTimeline,
    poses: &mut HashMap<(usize, GridIndex), CpuPose>,
    grid: GridIndex,
    vertex: SceneVertex,
) -> Vec3 {
    let instance = scene.numbering.instance_of_vertex(vertex);
    let place = &scene.numbering.instances[instance];
    let pose = || {
        let time = DEFAULT_GRID.time_of(grid);
        let shown = timeline.lock().at(instance, time);
        CpuPose::at(scene, instance, &shown, time)
    };
    let pose = poses.entry((instance, grid)).or_insert_with(pose);
    pose.vertex(&scene.scene.models[place.model], (vertex.0 - place.first_vertex.0) as usize)
}

/// See the module.
pub struct MotionSender {
    scene: Arc<SceneGpu>,
    timeline: SharedTimeline,
    chunks: Chunks,
    /// What instances play that the client has been told of.
    schedules: Schedules,
    posed: PosedInstances,
    /// Clips not all of whose chunks were sent, or did not all stay.
    open: BTreeSet<ClipId>,
    sequence: u32,
    bytes: MotionBytes,
    /// Streams that the client's gate has not been told of: their bytes, and whether they go before all updates or after them.
    untold: Vec<(usize, bool)>,
    /// What codes its samples.
    coder: Option<SharedCoder>,
    /// Poses of instances with samples, of the tick under way.
    poses: HashMap<(usize, GridIndex), CpuPose>,
    /// For poses and samples.
    steps: Allowance,
    /// For what is shown later; a chunk is sent whole and paid for later.
    later: Allowance,
    lead_ns: i64,
    /// Steps of the time grid that the client keeps.
    sample_ring: u32,
    /// What is played changes no earlier than this from now, nanoseconds: the client must know of it by then.
    change_lead_ns: i64,
    /// The world's time of the last tick.
    now: Option<WorldTime>,
    /// What the client knows of how the world's time goes on.
    clock: WorldClock,
    /// The way to the client carries nothing.
    is_away: bool,
}

impl MotionSender {
    /// For a client with so much memory.
    pub fn new(scene: &Arc<SceneGpu>, timeline: &SharedTimeline, memory: MotionMemory) -> Self {
        let first = scene.motion.first_chunk_word().min(memory.arena_words);
        let mut later = Allowance::new(1);
        later.set_step_bytes(LATER_BYTES);
        Self {
            scene: scene.clone(),
            timeline: timeline.clone(),
            chunks: Chunks::new(first..memory.arena_words),
            schedules: Schedules::default(),
            posed: PosedInstances::default(),
            open: BTreeSet::new(),
            sequence: 0,
            bytes: MotionBytes::default(),
            untold: Vec::new(),
            coder: None,
            poses: HashMap::new(),
            steps: Allowance::new(SAVED_STEPS),
            later,
            lead_ns: START_LEAD_NS.min(longest_lead_ns(memory.sample_ring)),
            sample_ring: memory.sample_ring,
            change_lead_ns: START_LEAD_NS,
            now: None,
            clock: WorldClock::default(),
            is_away: false,
        }
    }

    /// Whether the way to the client carries nothing: it is sent nothing then, and what it missed of what still matters after.
    pub(crate) fn set_away(&mut self, is_away: bool) {
        self.is_away = is_away;
    }

    /// Its samples are coded by this.
    pub(crate) fn code_with(&mut self, coder: &SharedCoder) {
        self.coder = Some(coder.clone());
    }

    /// What a step of the time grid may bring.
    pub(crate) fn set_budget(&mut self, budget: Budget) {
        self.steps.set_step_bytes(budget.sample_bytes);
        self.later.set_step_bytes(budget.later_bytes.min(LATER_BYTES));
    }

    /// How far ahead of now its poses and samples reach, nanoseconds.
    pub fn lead_ns(&self) -> i64 {
        self.lead_ns
    }

    /// The client is told of an instance with the next update, and of what it plays by now.
    pub fn announce(&mut self, told: &mut SkinnedInstance) {
        let (scene, instance) = (self.scene.clone(), told.instance.index());
        self.schedules.announce(&scene, &self.timeline.lock(), self.now, told);
        let clips: Vec<ClipRef> = match told.source {
            PoseSource::Grid { .. } => {
                self.posed.announce(&scene, instance);
                Vec::new()
            }
            PoseSource::Clips => told.schedule.entries().iter().map(|entry| entry.clip).collect(),
        };
        let path = told.path.iter().flat_map(|path| path.entries()).map(|entry| entry.clip);
        self.open.extend(path.chain(clips).map(|clip| clip.clip));
    }

    /// Bytes so far.
    pub fn bytes(&self) -> MotionBytes {
        self.bytes
    }

    /// Bytes of each stream since this was asked last, and whether it goes before all updates or after them.
    pub(crate) fn take_untold(&mut self) -> Vec<(usize, bool)> {
        std::mem::take(&mut self.untold)
    }

    /// What is to be sent at `now`. `way`: that to the client, as far as anything is known of it.
    pub fn tick(&mut self, now: ServerTime, way: Option<&WayState>) -> Vec<Out> {
        if self.is_away {
            return Vec::new();
        }
        self.note_way(way);
        self.steps.pass(now);
        self.later.pass(now);
        let mut out: Vec<Out> = self.clock(now).into_iter().collect();
        self.now = Some(self.clock.world_time(now));
        out.extend(self.changes(now));
        out.extend(self.chunks(now));
        out.extend(self.poses(now));
        out.extend(self.samples(now));
        out
    }

    /// Follows the way to the client in how far ahead of now it is told of what.
    fn note_way(&mut self, way: Option<&WayState>) {
        let Some(&WayState { smoothed_ns, .. }) = way.filter(|way| way.smoothed_ns > 0) else { return };
        // Half a round trip, and losses on the way: two, or one.
        let lead_ns = smoothed_ns / 2 + 2 * (smoothed_ns + NOTICE_NS) + smoothed_ns;
        self.lead_ns = lead_ns.min(longest_lead_ns(self.sample_ring));
        // Before a change is seen here, a step of the grid may pass.
        self.change_lead_ns = smoothed_ns / 2 + smoothed_ns + NOTICE_NS + DEFAULT_GRID.spacing_ns;
    }

    /// How the world's time goes on, where that is otherwise than the client was told.
    fn clock(&mut self, now: ServerTime) -> Option<Out> {
        let mut timeline = self.timeline.lock();
        timeline.clock_told(now.plus_ns(self.change_lead_ns.min(MOST_CLOCK_LEAD_NS)));
        let clock = *timeline.clock();
        drop(timeline);
        if clock == self.clock {
            return None;
        }
        self.clock = clock;
        let stream = self.stream(MotionNews::Clock(Box::new(clock)), true);
        self.bytes.schedule_bytes += stream.bytes() as u64;
        Some(stream)
    }

    /// What is played otherwise than the client was told.
    fn changes(&mut self, now: ServerTime) -> Vec<Out> {
        if !self.schedules.plays_any() {
            return Vec::new();
        }
        let mut timeline = self.timeline.lock();
        // What changes from now on does so after the client has heard of it.
        timeline.sampled(self.clock.world_time(now.plus_ns(self.change_lead_ns)));
        let changes = self.schedules.changes(&self.scene, &timeline, self.clock.world_time(now));
        drop(timeline);
        let mut out = Vec::new();
        for change in changes {
            self.open.extend(change.schedule.entries().iter().map(|entry| entry.clip.clip));
            let stream = self.stream(MotionNews::Schedule(change), true);
            self.bytes.schedule_bytes += stream.bytes() as u64;
            out.push(stream);
        }
        out
    }

    /// Which steps of the grid can be sent at `now`. What is shown until the last of them does not change any more.
    fn window(&self, now: ServerTime) -> SampleWindow {
        let horizon = DEFAULT_GRID.ceil(self.clock.world_time(now.plus_ns(self.lead_ns))).plus(2);
        self.timeline.lock().sampled(DEFAULT_GRID.time_of(horizon));
        SampleWindow {
            first: DEFAULT_GRID.floor(self.clock.world_time(now)).plus(-2),
            oldest: horizon.plus(1 - self.sample_ring as i32),
            horizon,
        }
    }

    /// New poses, as many as the link takes, in one message.
    fn poses(&mut self, now: ServerTime) -> Option<Out> {
        let step_bytes = self.posed.step_bytes();
        if step_bytes == 0 || !self.steps.affords(step_bytes) {
            return None;
        }
        let window = self.window(now);
        let due = self.posed.due(window, self.steps.left_bytes().max(step_bytes));
        let pose = |(grid, instance)| posed::pose(&self.scene, &self.timeline, grid, instance);
        let poses: Vec<GridPose> = due.into_iter().map(pose).collect();
        if poses.is_empty() {
            return None;
        }
        self.bytes.poses += poses.len() as u64;
        let stream = self.stream(MotionNews::Poses(poses), true);
        self.steps.take(stream.bytes());
        self.bytes.pose_bytes += stream.bytes() as u64;
        Some(stream)
    }

    /// The stream of the next message.
    fn stream(&mut self, news: MotionNews, is_urgent: bool) -> Out {
        let message = MotionMessage { sequence: self.sequence, news };
        self.sequence = self.sequence.wrapping_add(1);
        // After the first update, which needs no key to be seen, and before all others.
        let stream = motion_stream(&message, is_urgent.then_some(UpdateId(0)));
        self.untold.push((stream.bytes(), is_urgent));
        stream
    }

    fn chunks(&mut self, now: ServerTime) -> Vec<Out> {
        let mut out = Vec::new();
        if self.open.is_empty() {
            return out;
        }
        let mut missing = self.soon(now);
        // All that is needed is known before anything makes room for itself.
        missing.retain(|(clip, index)| !self.chunks.need((clip.clip, *index), now));
        for (clip, index) in missing {
            let words = |chunks: &mut Chunks, words| chunks.place((clip.clip, index), words, now);
            out.extend(self.chunk(clip, index, words, true));
        }
        self.open.extend(self.chunks.take_evicted().into_iter().map(|(clip, _)| clip));
        self.send_later(now, &mut out);
        out
    }

    /// New samples, as many as the link takes.
    fn samples(&mut self, now: ServerTime) -> Vec<Out> {
        let Some(coder) = self.coder.clone() else { return Vec::new() };
        let mut coder = lock(&coder);
        if coder.vertex_count() == 0 || !self.steps.affords(coder.step_bytes()) {
            return Vec::new();
        }
        // What was sent is never contradicted.
        let window = self.window(now);
        let (scene, timeline, poses) = (&self.scene, &self.timeline, &mut self.poses);
        poses.clear();
        let coded = coder.samples(window, self.steps.left_bytes(), |grid, vertex| {
            position(scene, timeline, poses, grid, vertex)
        });
        let streams: Vec<Out> = coded.iter().map(sample_stream).collect();
        for (stream, coded) in streams.iter().zip(&coded) {
            self.untold.push((stream.bytes(), true));
            self.steps.take(stream.bytes());
            self.bytes.sample_bytes += stream.bytes() as u64;
            self.bytes.samples += coded.sizes.samples as u64;
        }
        streams
    }

    /// What is shown soon, the first first.
    fn soon(&self, now: ServerTime) -> Vec<(ClipRef, u32)> {
        let (mut soon, mut known) = (Vec::new(), BTreeSet::new());
        let look = |from_ns: i64, until_ns: i64| (from_ns..=until_ns).step_by(LOOK_NS as usize);
        for ahead_ns in look(0, self.change_lead_ns + AHEAD_NS).chain(look(-BEHIND_NS, 0)) {
            // A halted world may go on at any time.
            let at = self.clock.world_time(now).plus_ns(ahead_ns);
            for playing in self.schedules.playing(at) {
                for shown in
                    [Some(playing.now), playing.fading.map(|(fading, _)| fading)].into_iter().flatten()
                {
                    let index = chunk_at(shown.phase_s(shown.clip.duration_s), shown.clip.duration_s);
                    if known.insert((shown.clip.clip, index)) {
                        soon.push((shown.clip, index));
                    }
                }
            }
        }
        soon
    }

    /// What is shown later, a little at a time, as long as there is room.
    fn send_later(&mut self, now: ServerTime, out: &mut Vec<Out>) {
        for clip in self.open.clone() {
            let clip = self.scene.motion.clip(clip);
            for index in 0..chunk_count(clip.duration_s) {
                if self.chunks.has((clip.clip, index)) {
                    continue;
                }
                if !self.later.affords(1) {
                    return;
                }
                let words = |chunks: &mut Chunks, words| chunks.place_beside((clip.clip, index), words, now);
                // Where there is no room the clip stays open: what is needed soon drives out what is not.
                let Some(stream) = self.chunk(clip, index, words, false) else { return };
                self.later.take(stream.bytes());
                out.push(stream);
            }
            if self.chunks_all_there(clip) {
                self.open.remove(&clip.clip);
            }
        }
    }

    fn chunks_all_there(&self, clip: ClipRef) -> bool {
        (0..chunk_count(clip.duration_s)).all(|index| self.chunks.has((clip.clip, index)))
    }

    fn chunk(
        &mut self,
        clip: ClipRef,
        index: u32,
        place: impl FnOnce(&mut Chunks, u32) -> Option<u32>,
        is_urgent: bool,
    ) -> Option<Out> {
        // Where there is no room it is not cut: that would be in vain, and again with the next tick.
        let words = self.scene.motion.chunk_words(clip.clip, index);
        let Some(first_word) = place(&mut self.chunks, words) else {
            if is_urgent {
                tracing::debug!("clip {} has no room in the client's arena", clip.clip.0);
            }
            return None;
        };
        let tracks = self.scene.motion.chunk(clip.clip, index);
        let chunk = ClipChunk { clip: clip.clip, index, first_word, tracks };
        let stream = self.stream(MotionNews::Chunk(chunk), is_urgent);
        self.bytes.chunk_bytes += stream.bytes() as u64;
        self.bytes.chunks += 1;
        Some(stream)
    }
}
