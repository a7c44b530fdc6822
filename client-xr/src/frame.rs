//! One display frame, from the runtime's wish to its picture: the client's half of the design, step 11. The barriers between
//! stages are here and nowhere else.

use crate::client::Client;
use crate::display::{Activity, FrameTurn, Views};
use crate::renderer::LastDrawn;
use crate::report::{ClientError, FrameReport, Step};
use crate::scene::{SceneReport, Switched};
use crate::scenes::{server_clock, server_time};
use crate::stages::{ARRIVALS, VERTEX_MEMORY_USE, eyes_gpu};
use shadecast_gpu::{Access, Recorder};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;

/// What a frame draws, before the eyes are known.
#[derive(Clone, Copy, Default)]
struct Content {
    /// The server's time at which it is seen.
    time: Option<ServerTime>,
    /// How far that can be off.
    clock_error_bound_ns: Option<i64>,
    /// The bundle on display.
    update: Option<UpdateId>,
    switched: Option<Switched>,
    scene: SceneReport,
}

impl Client {
    /// One display frame, without anything arriving meanwhile.
    pub fn step(&mut self) -> Result<Step, ClientError> {
        self.step_with(|_| Ok(()))
    }

    /// One display frame. `poll_inbox` hands in what has arrived, after the wait for the frame's turn, so that the newest
    /// counts; it calls [`Client::advance`] last.
    pub fn step_with(
        &mut self,
        poll_inbox: impl FnOnce(&mut Self) -> Result<(), ClientError>,
    ) -> Result<Step, ClientError> {
        match self.renderer.display.poll_events()? {
            Activity::Running => {}
            Activity::Idle => {
                poll_inbox(self)?;
                self.link.watch(false, self.now);
                return self.take_in_arrivals().map(|()| Step::Idle);
            }
            Activity::Exit => return Ok(Step::Exit),
        }
        let turn = self.renderer.display.wait_frame()?;
        poll_inbox(self)?;
        self.link.watch(turn.should_render, self.now);
        if turn.should_render { self.render(turn) } else { self.skip(turn) }
    }

    /// A frame that nobody sees. The head goes on to be told.
    fn skip(&mut self, turn: FrameTurn) -> Result<Step, ClientError> {
        self.take_in_arrivals()?;
        let views = self.renderer.display.locate_views(&turn)?;
        let report = self.finish(&turn, &views, Content::default(), false);
        self.renderer.display.end_empty_frame(turn)?;
        Ok(report)
    }

    fn render(&mut self, turn: FrameTurn) -> Result<Step, ClientError> {
        let flight = self.renderer.stages.next_flight(&self.renderer.gpu)?;
        let mut recorder = self.renderer.gpu.record()?;
        let content = self.record_scene(&mut recorder, flight, &turn)?;

        let image = self.renderer.display.acquire_image()?;
        let world = self.scenes.shown().filter(|_| content.update.is_some());
        let (stages, words) = (&mut self.renderer.stages, &self.renderer.words);
        recorder.scope("draw", |r| {
            stages.targets.begin(r, image);
            if let Some(scene) = world {
                scene.record_draw(r, stages, flight, content.scene.index_count);
            }
            words.record_backdrop(r, stages, flight, world);
            words.record_notice(r, stages, flight, world);
            r.end_pass();
        });
        let space_from_stage = world.map_or(Pose::IDENTITY, |scene| scene.terms.world_from_stage);

        // All is recorded: now the eyes, as late as possible.
        let views = self.renderer.display.locate_views(&turn)?;
        let space_from_eye = views.stage_from_eye.map(|stage_from_eye| space_from_stage.then(stage_from_eye));
        let eyes = eyes_gpu(space_from_eye, space_from_eye, views.fov);
        self.renderer.stages.write_eyes(flight, &eyes);
        let ticket = recorder.submit()?;
        self.renderer.stages.used_by(flight, ticket);
        self.renderer.last_ticket = Some(ticket);
        if let Some(scene) = self.scenes.shown_mut() {
            scene.used_by(ticket);
        }
        self.renderer.display.release_image()?;
        let index_count = content.scene.index_count;
        self.renderer.last_drawn = content.update.map(|_| LastDrawn { eyes, index_count });
        let report = self.finish(&turn, &views, content, true);
        self.renderer.display.end_frame(turn)?;
        Ok(report)
    }

    /// What arrives while nothing is drawn is written all the same: memory must not grow with the time that nobody looks.
    fn take_in_arrivals(&mut self) -> Result<(), ClientError> {
        if !self.scenes.have_arrivals() {
            return Ok(());
        }
        let flight = self.renderer.stages.next_flight(&self.renderer.gpu)?;
        let mut recorder = self.renderer.gpu.record()?;
        self.record_arrivals(&mut recorder, flight);
        let ticket = recorder.submit()?;
        self.renderer.stages.used_by(flight, ticket);
        Ok(())
    }

    fn record_arrivals(&mut self, recorder: &mut Recorder, flight: usize) {
        recorder.barrier(VERTEX_MEMORY_USE, ARRIVALS); // the frame before reads and writes what arrivals write
        self.scenes.record_arrivals(recorder, &self.renderer.stages, flight);
        recorder.barrier(ARRIVALS, ARRIVALS); // for what moves vertices, and for the arrivals after these
    }

    /// What has arrived, the switch to the newest complete bundle, and motion up to the frame's display time.
    fn record_scene(
        &mut self,
        recorder: &mut Recorder,
        flight: usize,
        turn: &FrameTurn,
    ) -> Result<Content, ClientError> {
        self.record_arrivals(recorder, flight);
        let Self { scenes, renderer, link, .. } = self;
        let at = turn.display_time;
        let switched = recorder.scope("switch", |r| scenes.record_switch(&renderer.gpu, r, link, at))?;
        if let Some(scene) = scenes.shown() {
            link.note_shown(scene.serial, at);
        }
        let clock = scenes.shown().and_then(|scene| server_clock(scene, link));
        let clock_error_bound_ns = clock.and_then(|clock| clock.error_bound_ns(at));
        let time = scenes.shown().and_then(|scene| server_time(scene, link, at));
        let Some((scene, now)) = scenes.shown_mut().zip(time) else { return Ok(Content::default()) };
        let interpolation = self.options.interpolation;
        let stages = &renderer.stages;
        let report = recorder.scope("motion", |r| {
            let skinned = scene.record_poses(r, stages, flight, now);
            let report = scene.record_motion(r, stages, now, interpolation);
            r.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ); // palettes, for skinning
            scene.record_skin(r, stages);
            SceneReport { skinned, ..report }
        });
        recorder.barrier(Access::COMPUTE_WRITE, Access::VERTEX_READ); // positions, for the one draw
        let update = scene.bundler.current();
        Ok(Content { time, clock_error_bound_ns, update, switched, scene: report })
    }

    fn finish(&mut self, turn: &FrameTurn, views: &Views, content: Content, is_rendered: bool) -> Step {
        let report = FrameReport {
            display_time: turn.display_time,
            server_time: content.time,
            clock_error_bound_ns: content.clock_error_bound_ns,
            motion_time: content.scene.motion_time,
            is_rendered,
            update: content.update,
            is_new: content.switched.is_some(),
            held_vertices: content.scene.motionless.held + content.scene.skinned.held_vertices,
            frozen_vertices: content.scene.motionless.frozen + content.scene.skinned.frozen_vertices,
            withheld_vertices: content.scene.skinned.withheld_vertices,
            withheld_patches: content.scene.withheld_patches,
            arena_waiting_bytes: content.scene.arena_waiting_bytes,
        };
        let picture_arrived = content.switched.map(|switched| switched.picture_arrived);
        self.note_frame(&report, picture_arrived, views, turn.period_ns);
        Step::Frame(report)
    }
}
