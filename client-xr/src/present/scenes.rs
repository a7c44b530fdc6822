//! The scene on display and its successor. A new connection's scene is drawn from its first complete bundle on.

use super::scene::Scene;
use crate::draw::stages::Stages;
use crate::handover::Loan;
use shadecast_gpu::{GpuError, Recorder};
use shadecast_protocol::time::ClientTime;

/// See the module.
#[derive(Default)]
pub(crate) struct Scenes {
    shown: Option<Scene>,
    next: Option<Scene>,
}

impl Scenes {
    /// A connection begins to bring a scene.
    pub(crate) fn begin(&mut self, scene: Scene) {
        self.next = Some(scene);
    }

    /// A connection has ended. What it has on display stays there, on the clock as it was known.
    pub(crate) fn end(&mut self, serial: u64) {
        self.next.take_if(|scene| scene.serial == serial);
    }

    /// The one on display.
    pub(crate) fn shown(&self) -> Option<&Scene> {
        self.shown.as_ref()
    }

    /// The same, to move it on.
    pub(crate) fn shown_mut(&mut self) -> Option<&mut Scene> {
        self.shown.as_mut()
    }

    /// The one that what arrives belongs to.
    pub(crate) fn arriving(&self) -> Option<&Scene> {
        self.next.as_ref().or(self.shown.as_ref())
    }

    /// That of a connection.
    pub(crate) fn of_serial(&mut self, serial: u64) -> Option<&mut Scene> {
        let all = self.shown.iter_mut().chain(&mut self.next);
        all.into_iter().find(|scene| scene.serial == serial)
    }

    /// Whether anything was handed over that is not taken in.
    pub(crate) fn have_arrivals(&self) -> bool {
        self.shown.iter().chain(&self.next).any(Scene::has_arrivals)
    }

    /// Takes in what was handed over. Needs a barrier before and after it.
    ///
    /// # Errors
    /// As [`Scene::record_arrivals`].
    pub(crate) fn record_arrivals(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
    ) -> Result<(), GpuError> {
        if let Some(scene) = &mut self.shown {
            recorder.scope("arrivals", |r| scene.record_arrivals(r, stages))?;
        }
        self.next.as_mut().map_or(Ok(()), |scene| scene.record_arrivals(recorder, stages))
    }

    /// Puts the newest complete bundle on display. That of a new connection takes the whole scene with it. Gives when the last byte
    /// of its picture came.
    ///
    /// # Errors
    /// As [`Scene::record_switch`].
    pub(crate) fn record_switch(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        display_time: ClientTime,
    ) -> Result<Option<ClientTime>, GpuError> {
        let Some(scene) = self.next.as_mut().or(self.shown.as_mut()) else { return Ok(None) };
        let Some(time) = scene.clock.server_time(display_time) else { return Ok(None) };
        let Some(picture_arrived) = scene.record_switch(recorder, stages, scene.world.world_time(time))?
        else {
            return Ok(None);
        };
        if let Some(mut next) = self.next.take() {
            let seen = self.shown.as_ref().and_then(|ended| ended.clock.server_time(display_time));
            seen.into_iter().for_each(|seen| next.clock.go_on_from(display_time, seen));
            self.shown = Some(next);
        }
        Ok(Some(picture_arrived))
    }

    /// What is not needed any more, once the GPU is done with the frame; with the connection's serial.
    pub(crate) fn take_spent(&mut self) -> impl Iterator<Item = (Loan, u64)> + '_ {
        let all = self.shown.iter_mut().chain(&mut self.next);
        all.flat_map(|scene| {
            let serial = scene.serial;
            scene.spent.drain(..).map(move |loan| (loan, serial))
        })
    }
}
