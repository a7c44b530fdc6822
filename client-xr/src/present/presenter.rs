//! The render thread's half of the client. It takes prepared items, displays them and reports on them. One display frame is in
//! `frame`.

use super::figures::Figures;
use super::rehearsal;
use super::renderer::Renderer;
use super::scene::Scene;
use super::scenes::Scenes;
use super::stats::{ClientStats, Counters};
use crate::display::{Display, Views};
use crate::draw::stages::Stages;
use crate::draw::stages::atlas_draw::{BUNDLES, PictureWays};
use crate::draw::stages::batch::BATCHES;
use crate::draw::stages::interpolate::Interpolation;
use crate::draw::stages::probe::ProbeView;
use crate::handover::{FrameNote, Loan, Prepared, PresenterEnd, TurnNote};
use crate::options::ClientOptions;
use crate::report::{ClientError, FrameReport};
use shadecast_gpu::{Gpu, Ticket, Timings};
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{HeadState, Welcome};
use shadecast_protocol::time::ClientTime;
use std::sync::Arc;
use std::thread::Thread;

/// Loans of the scene on display and of the one that follows it.
const MOST_LOANS: usize = 2 * (BATCHES + BUNDLES);
/// Turns of the display for which a new scene waits, at most, for the memory of ended ones, while the device takes more work. A display
/// that shows nothing records nothing, and so frees nothing.
const MOST_HELD_TURNS: u32 = 8;

/// See the module. Fields are dropped in this order: scenes go before the device that made them.
pub struct Presenter {
    pub(crate) scenes: Scenes,
    /// What goes to the intake, with its connection's serial, once the GPU is done with a recording.
    spent: Vec<(Option<Ticket>, Loan, u64)>,
    pub(crate) renderer: Renderer,
    end: PresenterEnd,
    /// A scene that waits for the memory of ended ones, before everything that came after it.
    held: Option<Prepared>,
    held_turns: u32,
    pub(crate) interpolation: Interpolation,
    counters: Counters,
    figures: Figures,
    /// The head's state at the last display frame, once the server's clock is known.
    head: Option<HeadState>,
    head_sequence: u32,
}

impl Drop for Presenter {
    fn drop(&mut self) {
        // The session goes with its images: the GPU must be done with them. A device that is lost is done.
        if let Err(error) = self.renderer.wait_idle() {
            tracing::debug!("waiting for the GPU before the session's end: {error}");
        }
    }
}

impl Presenter {
    pub(crate) fn new(
        display: Box<dyn Display>,
        options: &ClientOptions,
        end: PresenterEnd,
    ) -> Result<Self, ClientError> {
        let counters = Counters::new(display.gpu(), display.name(), end.arrived.clone());
        Ok(Self {
            scenes: Scenes::default(),
            spent: Vec::with_capacity(MOST_LOANS),
            renderer: Renderer::new(display, options)?,
            end,
            held: None,
            held_turns: 0,
            interpolation: options.interpolation,
            counters,
            figures: Figures::default(),
            head: None,
            head_sequence: 0,
        })
    }

    /// Compiles all that displays a world, and keeps it for the next start. Takes seconds where nothing is kept and there is no GPU: to
    /// be called before a connection.
    ///
    /// # Errors
    /// Those of the device.
    pub fn rehearse(&mut self) -> Result<(), ClientError> {
        rehearsal::rehearse(&mut self.renderer)?;
        self.renderer.gpu.keep_pipelines();
        Ok(())
    }

    /// The intake has a thread of its own, which is woken when there is something to do.
    pub fn wake(&mut self, intake: Thread) {
        self.end.wake(intake);
    }

    /// Says `text` in the waiting room, which is seen until the first bundle, and before a world that stands still.
    pub fn set_status(&mut self, text: &str) {
        self.renderer.set_status(text);
    }

    /// Asks the runtime to end the session; [`crate::report::Step::Exit`] follows.
    pub fn request_exit(&mut self) {
        self.renderer.display.request_exit();
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.renderer.gpu
    }

    /// What is to make the pipelines of pictures on the device, for the intake.
    pub(crate) fn picture_ways(&self) -> PictureWays {
        let Stages { targets, atlas, .. } = &self.renderer.stages;
        PictureWays::new(&self.renderer.gpu, &targets.pass, atlas)
    }

    /// Whether frames are to leave the cores to others for a while: a server may need them, where there is no GPU.
    pub(crate) fn leaves_cores(&self) -> bool {
        self.renderer.gpu.is_cpu() && !self.renderer.display.rests()
    }

    /// Waits until the device has drawn the last frame.
    ///
    /// # Errors
    /// Those of the device.
    pub(crate) fn wait_for_frame(&self) -> Result<(), ClientError> {
        let Renderer { gpu, last_ticket, .. } = &self.renderer;
        Ok(last_ticket.map_or(Ok(()), |ticket| gpu.wait(ticket))?)
    }

    /// Pixels per eye, width and height.
    pub fn eye_extent_pixels(&self) -> [u32; 2] {
        self.renderer.eye_extent_pixels()
    }

    /// Gives back what the GPU is done with.
    pub(crate) fn give_back(&mut self) -> Result<(), ClientError> {
        let mut next = 0;
        while let Some((ticket, ..)) = self.spent.get(next) {
            if !ticket.map_or(Ok(true), |ticket| self.renderer.gpu.is_done(ticket))? {
                next += 1;
                continue;
            }
            let (ticket, loan, serial) = self.spent.remove(next);
            if let Some(loan) = self.end.lend(loan, serial) {
                self.spent.insert(next, (ticket, loan, serial));
                return Ok(());
            }
        }
        Ok(())
    }

    /// Waits until the GPU is done with the oldest bundle that is to go back, and gives it back.
    pub(crate) fn wait_for_bundle(&mut self) -> Result<(), ClientError> {
        let oldest = self.spent.iter().find(|(_, loan, _)| matches!(loan, Loan::Bundle(_)));
        if let Some(ticket) = oldest.and_then(|(ticket, ..)| *ticket) {
            self.renderer.gpu.wait(ticket)?;
        }
        self.give_back()
    }

    /// The recording behind `ticket` is the last that uses what is spent.
    pub(crate) fn used_by(&mut self, ticket: Ticket) {
        let spent = self.scenes.take_spent().map(|(loan, serial)| (Some(ticket), loan, serial));
        self.spent.extend(spent);
    }

    /// Another turn for a scene that is held. Of a device that is busy, memory will come.
    pub(crate) fn count_held_turn(&mut self, takes_work: bool) {
        self.held_turns += u32::from(takes_work && self.held.is_some());
    }

    /// Takes what the intake has prepared to where it is shown. With `is_alone`, the intake runs on a thread of its own.
    pub(crate) fn take_prepared(&mut self, is_alone: bool) -> Result<(), ClientError> {
        while let Some(prepared) = self.held.take().or_else(|| self.end.take()) {
            if is_alone && matches!(prepared, Prepared::Scene(..)) && self.waits_for_memory() {
                self.held = Some(prepared);
                return Ok(());
            }
            match prepared {
                Prepared::Status(text) => {
                    self.renderer.set_status(&text);
                    self.end.give_back(text);
                }
                Prepared::Scene(terms, serial) => self.begin_scene(*terms, serial)?,
                Prepared::Clock(estimate, serial) => {
                    let scene = self.scenes.of_serial(serial);
                    scene.into_iter().for_each(|scene| scene.clock.follow(estimate));
                }
                Prepared::World(clock, serial) => {
                    let scene = self.scenes.of_serial(serial);
                    scene.into_iter().for_each(|scene| scene.world.follow(clock));
                }
                Prepared::Loan(loan, serial) => {
                    if let Some(scene) = self.scenes.of_serial(serial) {
                        scene.add(loan);
                    }
                }
                Prepared::Ended(serial) => self.scenes.end(serial),
            }
        }
        Ok(())
    }

    /// Whether a new scene is to wait for another turn: with servers that come and go quickly, the memory of three scenes and more
    /// would be held at once.
    fn waits_for_memory(&self) -> bool {
        self.counters.connections > 0 && self.held_turns < MOST_HELD_TURNS && self.renderer.gpu.has_retired()
    }

    fn begin_scene(&mut self, terms: Welcome, serial: u64) -> Result<(), ClientError> {
        let Renderer { gpu, stages, .. } = &self.renderer;
        self.counters.connections += 1;
        self.held_turns = 0;
        self.counters.sample_ring = terms.motion.sample_ring;
        let (scene, loans) = Scene::new(gpu, stages, terms, serial)?;
        self.counters.motion_memory_bytes = scene.motion_memory_bytes();
        self.scenes.begin(scene);
        self.spent.extend(loans.into_iter().map(|loan| (None, loan, serial)));
        self.give_back()
    }

    /// A turn of the display that showed nothing of ours.
    pub(crate) fn note_turn(&mut self, is_seen: bool) {
        let presses = self.renderer.display.presses();
        self.end.report(TurnNote { is_seen, presses, frame: None });
    }

    /// Takes note of a display frame, and tells the server.
    pub(crate) fn note_frame(
        &mut self,
        report: &FrameReport,
        picture_arrived: Option<ClientTime>,
        views: &Views,
        display_period_ns: i64,
        is_seen: bool,
    ) {
        self.counters.count(report);
        self.show_figures(report, picture_arrived);
        self.renderer.note(report, views.stage_from_head);
        let frame = FrameNote {
            report: *report,
            shown: self.scenes.shown().map(|scene| scene.serial),
            picture_arrived,
            eyes: views.eyes(),
            display_period_ns,
            head: self.locate_head(report.display_time, views),
        };
        let presses = self.renderer.display.presses();
        self.end.report(TurnNote { is_seen, presses, frame: Some(frame) });
    }

    /// Where the head will be at a display time, for the server of the scene that arrives.
    fn locate_head(&mut self, at: ClientTime, views: &Views) -> Option<(HeadState, u64)> {
        let scene = self.scenes.arriving()?;
        let (time, world_from_stage) = (scene.clock.server_time(at)?, scene.terms.world_from_stage);
        let head = HeadState {
            sequence: self.head_sequence,
            time,
            world_from_head: world_from_stage.then(views.stage_from_head),
            linear_velocity: world_from_stage.orientation * views.linear_velocity,
            angular_velocity: world_from_stage.orientation * views.angular_velocity,
            eyes: views.eyes(),
            discontinuity: DiscontinuityId(views.jumps),
        };
        self.head = Some(head);
        self.head_sequence = self.head_sequence.wrapping_add(1);
        Some((head, scene.serial))
    }

    /// Tells who wants to see it how it goes.
    fn show_figures(&mut self, frame: &FrameReport, picture_arrived: Option<ClientTime>) {
        let Renderer { display, words, .. } = &mut self.renderer;
        if !display.wants_figures() {
            self.figures.begin_anew();
            words.figures.hide();
        } else if let Some(lines) = self.figures.note(&self.counters, frame, picture_arrived)
            && !display.show_figures(lines)
        {
            words.figures.write(lines);
        }
    }

    /// The head's state at the last display frame, once the server's clock is known.
    pub fn head_state(&self) -> Option<HeadState> {
        self.head
    }

    /// For measurements: instance and distance of what the last rendered frame showed, left and right eye. Waits for the
    /// GPU.
    pub fn probe(&mut self) -> Result<[ProbeView; 2], ClientError> {
        Ok(self.renderer.probe(self.scenes.shown())?)
    }

    /// For measurements: what the stages of the last rendered frame took on the device, once for each frame. Waits for the
    /// GPU.
    pub fn frame_timings(&mut self) -> Result<Timings, ClientError> {
        Ok(self.renderer.frame_timings()?)
    }

    /// For tests: the vertex slots of every triangle that the last rendered frame drew.
    pub fn drawn_triangles(&self) -> Vec<[u32; 3]> {
        let drawn = self.scenes.shown().zip(self.renderer.drawn());
        drawn.map_or(Vec::new(), |(scene, drawn)| scene.drawn_triangles(drawn))
    }

    /// For tests: position and state of every vertex slot as the last display frame had them; empty without a bundle.
    pub fn read_positions(&self) -> Result<Vec<[f32; 4]>, ClientError> {
        let shown = self.scenes.shown();
        shown.map_or(Ok(Vec::new()), |scene| scene.read_positions(&self.renderer.gpu))
    }

    /// How it went so far.
    pub fn stats(&self) -> ClientStats {
        self.counters.stats(&self.renderer.gpu)
    }
}
