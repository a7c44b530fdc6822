//! One display frame, from the runtime's wish to its picture: the client's half of the design, step 11. The barriers between
//! stages are here and nowhere else.

use crate::client::{Client, ClientError, FrameReport, LastDrawn, Step};
use crate::scene::{Scene, SceneReport, Switched};
use crate::stages::background::Backdrop;
use crate::stages::{VERTEX_MEMORY_USE, eyes_gpu};
use crate::xr::{Activity, FrameTurn, Views};
use shadecast_gpu::{Access, Recorder};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;

/// What a frame draws, before the eyes are known.
#[derive(Clone, Copy, Default)]
struct Content {
    /// The server's time at which it is seen.
    time: Option<ServerTime>,
    /// The bundle on display.
    frame: Option<UpdateId>,
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
        match self.xr.headset.poll_events()? {
            Activity::Running => {}
            Activity::Idle => {
                poll_inbox(self)?;
                self.watch(false);
                return self.take_in_arrivals().map(|()| Step::Idle);
            }
            Activity::Exit => return Ok(Step::Exit),
        }
        let turn = self.xr.headset.wait_frame()?;
        poll_inbox(self)?;
        self.watch(turn.should_render);
        if turn.should_render { self.render(turn) } else { self.skip(turn) }
    }

    /// A frame that nobody sees. The head goes on to be told.
    fn skip(&mut self, turn: FrameTurn) -> Result<Step, ClientError> {
        self.take_in_arrivals()?;
        let views = self.xr.headset.locate_views(&turn)?;
        let report = self.finish(&turn, &views, Content::default(), false);
        self.xr.headset.end_empty_frame(turn)?;
        Ok(report)
    }

    fn render(&mut self, turn: FrameTurn) -> Result<Step, ClientError> {
        let slot = self.stages.next_slot(&self.gpu)?;
        let mut recorder = self.gpu.record()?;
        let content = self.record_scene(&mut recorder, slot, &turn)?;

        let image = self.xr.swapchain.acquire()?;
        self.stages.targets.begin(&mut recorder, image.index());
        if let Some(scene) = self.shown.as_ref().filter(|_| content.frame.is_some()) {
            scene.record_draw(&mut recorder, &self.stages, slot, content.scene.index_count);
        }
        let (backdrop, space_from_stage) = match self.shown.as_ref().filter(|_| content.frame.is_some()) {
            Some(scene) => (Backdrop::Environment(&scene.terms.environment), scene.terms.world_from_stage),
            None => {
                let stage_from_panel = self.panel.unwrap_or(Pose::IDENTITY);
                (Backdrop::WaitingRoom { stage_from_panel, text: &self.status }, Pose::IDENTITY)
            }
        };
        self.stages.background.record(&mut recorder, slot, backdrop);
        let world = self.shown.as_ref().filter(|_| content.frame.is_some());
        if let Some((scene, stage_from_panel)) = world.zip(self.stillness.panel()) {
            let world_from_panel = scene.terms.world_from_stage.then(stage_from_panel);
            let text = if self.connection.is_some() { &self.waiting } else { &self.status };
            self.stages.notice.record(&mut recorder, slot, world_from_panel, text);
        }
        recorder.end_pass();

        // All is recorded: now the eyes, as late as possible.
        let views = self.xr.headset.locate_views(&turn)?;
        let space_from_eye = views.stage_from_eye.map(|stage_from_eye| space_from_stage.then(stage_from_eye));
        let eyes = eyes_gpu(space_from_eye, space_from_eye, views.fov);
        self.stages.write_eyes(slot, &eyes);
        let ticket = recorder.submit()?;
        self.stages.used_by(slot, ticket);
        if let Some(scene) = &mut self.shown {
            scene.used_by(ticket);
        }
        image.release()?;
        let index_count = content.scene.index_count;
        self.last_drawn = content.frame.map(|_| LastDrawn { eyes, index_count });
        let report = self.finish(&turn, &views, content, true);
        self.xr.headset.end_frame(turn, &views, &self.xr.swapchain)?;
        Ok(report)
    }

    /// What arrives while nothing is drawn is written all the same: memory must not grow with the time that nobody looks.
    fn take_in_arrivals(&mut self) -> Result<(), ClientError> {
        let has_arrivals = |scene: &Option<Scene>| scene.as_ref().is_some_and(Scene::has_arrivals);
        if !has_arrivals(&self.shown) && !has_arrivals(&self.next) {
            return Ok(());
        }
        let slot = self.stages.next_slot(&self.gpu)?;
        let mut recorder = self.gpu.record()?;
        self.record_arrivals(&mut recorder, slot);
        let ticket = recorder.submit()?;
        self.stages.used_by(slot, ticket);
        Ok(())
    }

    fn record_arrivals(&mut self, recorder: &mut Recorder, slot: usize) {
        recorder.barrier(VERTEX_MEMORY_USE, Access::COMPUTE); // the frame before reads and writes what arrivals write
        if let Some(scene) = &mut self.shown {
            recorder.scope("arrivals", |r| scene.record_arrivals(r, &self.stages, slot));
        }
        if let Some(scene) = &mut self.next {
            scene.record_arrivals(recorder, &self.stages, slot);
        }
    }

    /// What has arrived, the switch to the newest complete bundle, and motion up to the frame's display time.
    fn record_scene(
        &mut self,
        recorder: &mut Recorder,
        slot: usize,
        turn: &FrameTurn,
    ) -> Result<Content, ClientError> {
        self.record_arrivals(recorder, slot);
        let switched = recorder.scope("switch", |r| self.switch(r, turn))?;
        let time = self.shown.as_ref().and_then(|scene| self.server_time(scene, turn.display_time));
        let Some((scene, now)) = self.shown.as_mut().zip(time) else { return Ok(Content::default()) };
        let interpolation = self.options.interpolation;
        let report = recorder.scope("motion", |r| scene.record_motion(r, &self.stages, now, interpolation));
        recorder.barrier(Access::COMPUTE_WRITE, Access::VERTEX_READ); // positions, for the one draw
        Ok(Content { time, frame: scene.bundler.current(), switched, scene: report })
    }

    /// Puts the newest complete bundle on display. That of a new connection takes the whole scene with it.
    fn switch(&mut self, recorder: &mut Recorder, turn: &FrameTurn) -> Result<Option<Switched>, ClientError> {
        let is_next = self.next.is_some();
        let scene = if is_next { &self.next } else { &self.shown };
        let time = scene.as_ref().and_then(|scene| self.server_time(scene, turn.display_time));
        let scene = if is_next { &mut self.next } else { &mut self.shown };
        let Some((scene, time)) = scene.as_mut().zip(time) else { return Ok(None) };
        let connection = &mut self.connection;
        let recycle = |picture| {
            if let Some(connection) = connection {
                connection.recycle(picture);
            }
        };
        let switched = scene.record_switch(&self.gpu, recorder, time, recycle)?;
        if is_next && switched.is_some() {
            self.shown = self.next.take();
        }
        Ok(switched)
    }

    fn finish(&mut self, turn: &FrameTurn, views: &Views, content: Content, is_rendered: bool) -> Step {
        let report = FrameReport {
            display_time: turn.display_time,
            server_time: content.time,
            motion_time: content.scene.motion_time,
            is_rendered,
            frame: content.frame,
            is_new: content.switched.is_some(),
            held_vertices: content.scene.motionless.held,
            frozen_vertices: content.scene.motionless.frozen,
            withheld_patches: content.scene.withheld_patches,
        };
        self.stillness.note(&report, views.stage_from_head);
        self.tell_head(turn.display_time, turn.period_ns, views);
        self.report_frame(&report, content.switched.map(|switched| switched.picture_arrived));
        Step::Frame(report)
    }
}
