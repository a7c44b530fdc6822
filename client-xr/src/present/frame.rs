//! One display frame, from the runtime's request to the picture: step 11 of the design. All barriers between stages are here.

use super::presenter::Presenter;
use super::renderer::{LastDrawn, Renderer};
use super::scene::SceneReport;
use crate::display::{Activity, FrameTurn, Views};
use crate::draw::stages::{ARRIVALS, VERTEX_MEMORY_USE, eyes_gpu};
use crate::report::{ClientError, FrameReport, Step};
use crate::stream::intake::Intake;
use shadecast_gpu::{Access, GpuError, Recorder};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::{ClientTime, ServerTime, WorldTime};

/// What a frame draws, before the eyes are known.
#[derive(Clone, Copy, Default)]
struct Content {
    /// The server's time at which it is seen, and the world's.
    time: Option<ServerTime>,
    world_time: Option<WorldTime>,
    /// How far that can be off.
    clock_error_bound_ns: Option<i64>,
    /// The bundle on display.
    update: Option<UpdateId>,
    /// When the last byte of its picture came, if it is on display for the first time.
    picture_arrived: Option<ClientTime>,
    scene: SceneReport,
}

/// When the picture was drawn that a frame shows.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Drawn {
    /// It shows none.
    Nothing,
    /// For an earlier frame.
    Before,
    /// For this one.
    Now,
}

/// What the display wants next.
pub enum Turn {
    /// A frame.
    Frame(FrameTurn),
    /// Nothing, for now.
    Idle,
    /// Nothing any more.
    Exit,
}

impl Presenter {
    /// Waits for the display's next turn. What arrives until [`Self::present`] counts for it.
    pub fn wait_turn(&mut self) -> Result<Turn, ClientError> {
        Ok(match self.renderer.display.poll_events()? {
            Activity::Running => Turn::Frame(self.renderer.display.wait_frame()?),
            Activity::Idle => Turn::Idle,
            Activity::Exit => Turn::Exit,
        })
    }

    /// Makes what the display wants, of what was prepared: by now, where `intake` is on the same thread, else by whenever that was.
    pub fn present(&mut self, turn: Turn, intake: Option<&mut Intake>) -> Result<Step, ClientError> {
        if let Turn::Exit = turn {
            return Ok(Step::Exit);
        }
        let flight = self.next_flight(intake.is_some())?;
        self.give_back()?;
        self.count_held_turn(flight.is_some());
        self.take_prepared(intake.is_none())?;
        if let Some(intake) = intake {
            self.let_prepare(intake)?;
            self.take_prepared(false)?;
        }
        match (turn, flight) {
            (Turn::Frame(turn), Some(flight)) if turn.should_render => self.render(turn, flight),
            (Turn::Frame(turn), None) if turn.should_render => self.repeat(turn),
            (Turn::Frame(turn), flight) => self.skip(turn, flight),
            (Turn::Idle | Turn::Exit, flight) => {
                self.take_in_arrivals(flight)?;
                self.note_turn(false);
                Ok(Step::Idle)
            }
        }
    }

    /// Where a frame's memory is; `None` while the device is not done with what it was used for last. Nobody waits for that, but where
    /// the clock does too.
    fn next_flight(&mut self, waits: bool) -> Result<Option<usize>, GpuError> {
        let Renderer { stages, gpu, .. } = &mut self.renderer;
        if waits { stages.wait_for_flight(gpu).map(Some) } else { stages.free_flight(gpu) }
    }

    /// What is ready comes with this turn, however slow the device is.
    fn let_prepare(&mut self, intake: &mut Intake) -> Result<(), ClientError> {
        intake.take_presented();
        if intake.wants_bundle() {
            self.wait_for_bundle()?;
            intake.take_presented();
        }
        intake.prepare();
        // Pictures of which blocks settle come one by one; the newest counts.
        while intake.is_behind() && intake.prepare() {}
        Ok(())
    }

    /// A frame that nobody sees. The head goes on to be told.
    fn skip(&mut self, turn: FrameTurn, flight: Option<usize>) -> Result<Step, ClientError> {
        self.take_in_arrivals(flight)?;
        let views = self.renderer.display.locate_views(&turn)?;
        let report = self.finish(&turn, &views, Content::default(), Drawn::Nothing);
        self.renderer.display.end_empty_frame(turn)?;
        Ok(report)
    }

    /// A frame of a device that is behind: what was shown last is shown again, and the head goes on to be told.
    fn repeat(&mut self, turn: FrameTurn) -> Result<Step, ClientError> {
        let content = self.content_at(turn.display_time);
        let views = self.renderer.display.locate_views(&turn)?;
        let report = self.finish(&turn, &views, content, Drawn::Before);
        self.renderer.display.end_same_frame(turn)?;
        Ok(report)
    }

    fn render(&mut self, turn: FrameTurn, flight: usize) -> Result<Step, ClientError> {
        let mut recorder = self.renderer.gpu.record()?;
        let content = self.record_scene(&mut recorder, flight, &turn)?;

        let image = self.renderer.display.acquire_image()?;
        let part = self.renderer.display.part();
        let world = self.scenes.shown().filter(|_| content.update.is_some());
        let (stages, words) = (&mut self.renderer.stages, &self.renderer.words);
        recorder.scope("draw", |r| {
            stages.targets.begin_part(r, image, part);
            if let Some(scene) = world {
                scene.record_draw(r, stages, flight, content.scene.drawn);
            }
            stages.hands.record(r, flight);
            words.record_backdrop(r, stages, flight, world);
            words.record_notice(r, stages, flight, world);
            words.record_figures(r, stages, flight, world);
            r.end_pass();
        });
        let space_from_stage = world.map_or(Pose::IDENTITY, |scene| scene.terms.world_from_stage);

        // All is recorded: now the eyes, as late as possible.
        let views = self.renderer.display.locate_views(&turn)?;
        let space_from_eye = views.stage_from_eye.map(|stage_from_eye| space_from_stage.then(stage_from_eye));
        let mut eyes = eyes_gpu(space_from_eye, space_from_eye, views.fov);
        let newest_part = world.zip(content.world_time).map_or(1.0, |(scene, time)| scene.newest_part(time));
        eyes.blend[0] = newest_part;
        self.renderer.stages.write_eyes(flight, &eyes);
        let space_from_hand = views.stage_from_hand.map(|hand| hand.map(|hand| space_from_stage.then(hand)));
        self.renderer.stages.hands.write(flight, space_from_hand);
        let ticket = recorder.submit()?;
        self.renderer.stages.used_by(flight, ticket);
        self.renderer.last_ticket = Some(ticket);
        self.used_by(ticket);
        self.renderer.display.release_image()?;
        let drawn = content.scene.drawn;
        let seen_from = [0, 1].map(|eye| (space_from_eye[eye], views.fov[eye]));
        self.renderer.last_drawn = content.update.map(|_| LastDrawn { eyes: seen_from, drawn });
        let report = self.finish(&turn, &views, content, Drawn::Now);
        self.renderer.display.end_frame(turn)?;
        Ok(report)
    }

    /// What arrives while nothing is drawn is written all the same: memory must not grow with the time that nobody looks.
    fn take_in_arrivals(&mut self, flight: Option<usize>) -> Result<(), ClientError> {
        let Some(flight) = flight.filter(|_| self.scenes.have_arrivals()) else { return Ok(()) };
        let mut recorder = self.renderer.gpu.record()?;
        self.record_arrivals(&mut recorder)?;
        let ticket = recorder.submit()?;
        self.renderer.stages.used_by(flight, ticket);
        self.used_by(ticket);
        Ok(())
    }

    fn record_arrivals(&mut self, recorder: &mut Recorder) -> Result<(), GpuError> {
        recorder.barrier(VERTEX_MEMORY_USE, ARRIVALS); // the frame before reads and writes what arrivals write
        self.scenes.record_arrivals(recorder, &self.renderer.stages)?;
        recorder.barrier(ARRIVALS, ARRIVALS); // for what moves vertices, and for the arrivals after these
        Ok(())
    }

    /// What has arrived, the switch to the newest complete bundle, and motion up to the frame's display time.
    fn record_scene(
        &mut self,
        recorder: &mut Recorder,
        flight: usize,
        turn: &FrameTurn,
    ) -> Result<Content, GpuError> {
        self.record_arrivals(recorder)?;
        let Self { scenes, renderer, .. } = self;
        let at = turn.display_time;
        let stages = &renderer.stages;
        let picture_arrived = recorder.scope("switch", |r| scenes.record_switch(r, stages, at))?;
        let content = Content { picture_arrived, ..self.content_at(at) };
        let Self { scenes, renderer, interpolation, .. } = self;
        let stages = &renderer.stages;
        let (Some(now), Some(world_time), Some(scene)) =
            (content.time, content.world_time, scenes.shown_mut())
        else {
            return Ok(content);
        };
        let scene = recorder.scope("motion", |r| {
            let skinned = scene.record_poses(r, stages, flight, world_time);
            let report = scene.record_motion(r, stages, (now, world_time), *interpolation);
            r.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ); // palettes, for skinning
            scene.record_skin(r, stages);
            SceneReport { skinned, ..report }
        });
        recorder.barrier(Access::COMPUTE_WRITE, Access::VERTEX_READ); // positions, for the one draw
        Ok(Content { scene, ..content })
    }

    /// What is on display at a time, before anything of it is moved there.
    fn content_at(&mut self, at: ClientTime) -> Content {
        let Some(scene) = self.scenes.shown_mut() else { return Content::default() };
        scene.clock.show(at);
        let Some(now) = scene.clock.server_time(at) else { return Content::default() };
        Content {
            time: Some(now),
            world_time: Some(scene.world.show(now)),
            clock_error_bound_ns: scene.clock.error_bound_ns(at),
            update: scene.update(),
            ..Content::default()
        }
    }

    fn finish(&mut self, turn: &FrameTurn, views: &Views, content: Content, drawn: Drawn) -> Step {
        let report = FrameReport {
            display_time: turn.display_time,
            server_time: content.time,
            world_time: content.world_time,
            clock_error_bound_ns: content.clock_error_bound_ns,
            motion_time: content.scene.motion_time,
            is_rendered: drawn == Drawn::Now,
            is_repeated: drawn == Drawn::Before,
            update: content.update,
            is_new: content.picture_arrived.is_some(),
            held_vertices: content.scene.motionless.held + content.scene.skinned.held_vertices,
            frozen_vertices: content.scene.motionless.frozen + content.scene.skinned.frozen_vertices,
            withheld_vertices: content.scene.skinned.withheld_vertices,
            withheld_patches: content.scene.drawn.withheld_patches,
            arena_waiting_bytes: content.scene.arena_waiting_bytes,
        };
        self.note_frame(&report, content.picture_arrived, views, turn.period_ns, turn.should_render);
        Step::Frame(report)
    }
}
