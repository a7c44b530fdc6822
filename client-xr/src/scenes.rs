//! The scene on display and the one that takes its place: a new connection's is drawn only when it has a whole bundle.

use crate::decode::Picture;
use crate::link::{Ended, Link};
use crate::report::ClientError;
use crate::scene::{Scene, Switched};
use crate::stages::Stages;
use shadecast_gpu::{Gpu, Recorder};
use shadecast_protocol::clock::ClockEstimator;
use shadecast_protocol::time::{ClientTime, ServerTime};

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
    pub(crate) fn end(&mut self, ended: Option<Ended>) {
        self.next = None;
        let Some((Ended { serial, clock }, shown)) = ended.zip(self.shown.as_mut()) else { return };
        if shown.serial == serial {
            shown.ended_clock = Some(Box::new(clock));
        }
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

    /// The same, to take it in.
    pub(crate) fn arriving_mut(&mut self) -> Option<&mut Scene> {
        self.next.as_mut().or(self.shown.as_mut())
    }

    fn all(&self) -> impl Iterator<Item = &Scene> {
        self.shown.iter().chain(&self.next)
    }

    /// Whether one holds as much as it may until the GPU has taken it.
    pub(crate) fn is_full(&self) -> bool {
        self.all().any(|scene| scene.motion.is_full())
    }

    /// Whether anything has arrived about vertices that is not written.
    pub(crate) fn have_arrivals(&self) -> bool {
        self.all().any(Scene::has_arrivals)
    }

    /// Bytes of what has come and waits: for its picture, for the GPU's vertex memory.
    pub(crate) fn waiting_bytes(&self) -> usize {
        self.all().map(Scene::waiting_bytes).sum()
    }

    /// Writes what has arrived about vertices and skeletons. Needs a barrier before and after it.
    pub(crate) fn record_arrivals(&mut self, recorder: &mut Recorder, stages: &Stages, flight: usize) {
        if let Some(scene) = &mut self.shown {
            recorder.scope("arrivals", |r| scene.record_arrivals(r, stages, flight));
        }
        if let Some(scene) = &mut self.next {
            scene.record_arrivals(recorder, stages, flight);
        }
    }

    /// Puts the newest complete bundle on display. That of a new connection takes the whole scene with it.
    pub(crate) fn record_switch(
        &mut self,
        gpu: &Gpu,
        recorder: &mut Recorder,
        link: &mut Link,
        display_time: ClientTime,
    ) -> Result<Option<Switched>, ClientError> {
        let is_next = self.next.is_some();
        let Some(scene) = self.arriving_mut() else { return Ok(None) };
        let Some(time) = server_time(scene, link, display_time) else { return Ok(None) };
        let recycle = |picture: Picture| link.recycle(picture);
        let switched = scene.record_switch(gpu, recorder, time, recycle)?;
        if is_next && switched.is_some() {
            let seen = self.shown.as_ref().and_then(|ended| server_time(ended, link, display_time));
            self.shown = self.next.take();
            if let (Some(scene), Some(seen)) = (&self.shown, seen) {
                link.go_on_from(scene.serial, display_time, seen);
            }
        }
        Ok(switched)
    }
}

/// The clock of the server that made `scene`.
pub(crate) fn server_clock<'a>(scene: &'a Scene, link: &'a Link) -> Option<&'a ClockEstimator> {
    scene.ended_clock.as_deref().or_else(|| link.clock())
}

/// `at` on that clock.
pub(crate) fn server_time(scene: &Scene, link: &Link, at: ClientTime) -> Option<ServerTime> {
    server_clock(scene, link)?.server_time(at)
}
