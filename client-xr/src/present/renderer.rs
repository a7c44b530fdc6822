//! The renderer: the headset's images, the stages with their shared resources, and the visible texts. There is one per headset
//! session, across connections.

use super::figures_panel::FiguresPanel;
use super::scene::Scene;
use super::stillness::Stillness;
use crate::display::Display;
use crate::draw::draw_list::Drawable;
use crate::draw::stages::Stages;
use crate::draw::stages::background::Backdrop;
use crate::draw::stages::probe::{EyeView, Probe, ProbeView};
use crate::draw::stages::text::{Text, panel_ahead};
use crate::options::ClientOptions;
use crate::report::FrameReport;
use shadecast_gpu::{Gpu, GpuError, Recorder, Ticket, Timings, vk};
use shadecast_protocol::pose::Pose;
use std::fmt::Write as _;
use std::sync::Arc;

/// Bytes of a status that are said again in a notice: more than a panel has characters.
const MOST_STATUS_BYTES: usize = 512;

/// What draws. Fields are dropped in this order: what the device made goes before the session.
pub(crate) struct Renderer {
    pub(crate) stages: Stages,
    probe: Option<Probe>,
    pub(crate) last_drawn: Option<LastDrawn>,
    /// Of the last rendered frame.
    pub(crate) last_ticket: Option<Ticket>,
    pub(crate) gpu: Arc<Gpu>,
    pub(crate) display: Box<dyn Display>,
    pub(crate) words: Words,
}

/// What the last rendered frame showed, for the probe.
#[derive(Clone, Copy)]
pub(crate) struct LastDrawn {
    pub(crate) eyes: [EyeView; 2],
    pub(crate) drawn: Drawable,
}

/// What is said in the waiting room, and before a world that stands still.
pub(crate) struct Words {
    /// Where they are in the waiting room, once the head has been seen.
    stage_from_panel: Option<Pose>,
    status: Text,
    /// The same for who writes the notice, and the notice's own first line: their memory is taken once.
    status_words: String,
    notice_head: String,
    /// Said before a world that stands still: why, and for how many seconds it has.
    notice: Text,
    notice_s: i64,
    stillness: Stillness,
    /// How it goes, where the display has no place of its own for that.
    pub(crate) figures: FiguresPanel,
}

impl Renderer {
    /// On an open display.
    pub(crate) fn new(display: Box<dyn Display>, options: &ClientOptions) -> Result<Self, GpuError> {
        let gpu = display.gpu().clone();
        let samples = samples(options.msaa_on(&gpu), gpu.sample_counts());
        let words = Words {
            stage_from_panel: None,
            status: Text::new("Shadecast"),
            status_words: String::with_capacity(MOST_STATUS_BYTES),
            notice_head: String::with_capacity(MOST_STATUS_BYTES),
            notice: Text::default(),
            notice_s: 0,
            stillness: Stillness::default(),
            figures: FiguresPanel::default(),
        };
        let stages = Stages::new(&gpu, display.eye_images(), samples, options.colours())?;
        Ok(Self { stages, probe: None, last_drawn: None, last_ticket: None, gpu, display, words })
    }

    /// Says `text` in the waiting room, and before a world that stands still without a connection.
    pub(crate) fn set_status(&mut self, text: &str) {
        let Words { status, status_words, notice_s, .. } = &mut self.words;
        *status = Text::new(text);
        status_words.clear();
        status_words.push_str(&text[..text.floor_char_boundary(MOST_STATUS_BYTES)]);
        *notice_s = 0;
    }

    /// Pixels per eye, width and height.
    pub(crate) fn eye_extent_pixels(&self) -> [u32; 2] {
        self.display.eye_images().extent_pixels
    }

    /// What the stages of the last rendered frame took on the device, once for each frame. Waits for the GPU.
    pub(crate) fn frame_timings(&mut self) -> Result<Timings, GpuError> {
        match self.last_ticket.take() {
            Some(ticket) => self.gpu.wait_timed(ticket),
            None => Ok(Timings::default()),
        }
    }

    /// Notes what a display frame showed to a head.
    pub(crate) fn note(&mut self, frame: &FrameReport, stage_from_head: Pose) {
        self.words.stillness.note(frame, stage_from_head);
        self.words.write_notice();
        self.words.figures.note(stage_from_head);
        self.words.stage_from_panel.get_or_insert_with(|| panel_ahead(stage_from_head));
    }

    /// What the last rendered frame drew; `None` where it showed no scene.
    pub(crate) fn drawn(&self) -> Option<Drawable> {
        self.last_drawn.map(|last| last.drawn)
    }

    /// Instance and distance of what the last rendered frame showed of `scene`, left and right eye. Waits for the GPU.
    pub(crate) fn probe(&mut self, scene: Option<&Scene>) -> Result<[ProbeView; 2], GpuError> {
        let extent = self.eye_extent_pixels();
        let nothing = || [ProbeView::empty(extent), ProbeView::empty(extent)];
        let (Some(scene), Some(last)) = (scene, self.last_drawn) else { return Ok(nothing()) };
        let probe = match &mut self.probe {
            Some(probe) => probe,
            none => none.insert(Probe::new(&self.gpu, extent)?),
        };
        Ok(scene.probe(probe, last.eyes, last.drawn)?.unwrap_or_else(nothing))
    }

    /// Waits until the device is done with all that was submitted.
    pub(crate) fn wait_idle(&self) -> Result<(), GpuError> {
        let last = self.gpu.record()?.submit()?;
        self.gpu.wait(last)
    }
}

impl Words {
    /// What is behind the world, or the waiting room where there is none.
    pub(crate) fn record_backdrop(
        &self,
        recorder: &mut Recorder,
        stages: &mut Stages,
        flight: usize,
        world: Option<&Scene>,
    ) {
        let backdrop = match world {
            Some(scene) => Backdrop::Environment(&scene.terms.environment),
            None => Backdrop::WaitingRoom {
                stage_from_panel: self.stage_from_panel.unwrap_or(Pose::IDENTITY),
                text: &self.status,
            },
        };
        stages.background.record(recorder, flight, backdrop);
    }

    /// Writes what is said of a world that stands still, once a second.
    fn write_notice(&mut self) {
        let seconds = self.stillness.seconds();
        if self.stillness.panel().is_some() && seconds != self.notice_s {
            self.notice_s = seconds;
            self.notice_head.clear();
            // A string takes whatever is written.
            let _ = write!(self.notice_head, "No new picture for {seconds} s");
            self.notice = Text::of(std::iter::once(&*self.notice_head).chain(self.status_words.lines()));
        }
    }

    /// Why the world stands still, and since when, where it does.
    pub(crate) fn record_notice(
        &self,
        recorder: &mut Recorder,
        stages: &mut Stages,
        flight: usize,
        world: Option<&Scene>,
    ) {
        let Some((scene, stage_from_panel)) = world.zip(self.stillness.panel()) else { return };
        let world_from_panel = scene.terms.world_from_stage.then(stage_from_panel);
        stages.notice.record(recorder, flight, world_from_panel, &self.notice);
    }

    /// How it goes, in the world or in the waiting room, where somebody wants to see it.
    pub(crate) fn record_figures(
        &self,
        recorder: &mut Recorder,
        stages: &mut Stages,
        flight: usize,
        world: Option<&Scene>,
    ) {
        let Some((stage_from_panel, text)) = self.figures.shown() else { return };
        let space_from_stage = world.map_or(Pose::IDENTITY, |scene| scene.terms.world_from_stage);
        stages.figures.record(recorder, flight, space_from_stage.then(stage_from_panel), text);
    }
}

/// So many samples a pixel, of which devices have 1 and 4, and some 2.
fn samples(wanted: u32, offered: vk::SampleCountFlags) -> vk::SampleCountFlags {
    match wanted {
        0 | 1 => vk::SampleCountFlags::TYPE_1,
        2 if offered.contains(vk::SampleCountFlags::TYPE_2) => vk::SampleCountFlags::TYPE_2,
        _ => vk::SampleCountFlags::TYPE_4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_samples_are_four_where_a_device_has_no_two() {
        use vk::SampleCountFlags as Samples;
        let (few, many) =
            (Samples::TYPE_1 | Samples::TYPE_4, Samples::TYPE_1 | Samples::TYPE_2 | Samples::TYPE_4);
        assert_eq!(
            [1, 2, 4].map(|wanted| samples(wanted, few)),
            [Samples::TYPE_1, Samples::TYPE_4, Samples::TYPE_4]
        );
        assert_eq!(
            [1, 2, 4].map(|wanted| samples(wanted, many)),
            [Samples::TYPE_1, Samples::TYPE_2, Samples::TYPE_4]
        );
    }
}
