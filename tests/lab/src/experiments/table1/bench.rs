//! One cell once. Server and client are connected, and the client gets updates without a link until everything has arrived.
//! Then each works alone without a pause, then both at once on the one device.
//!
//! The server's time covers an update, its delta's bytes, and its messages of motion until the next. Link and codec are left
//! out; the codec is measured beside it. The client's time is its display frame. Nothing arrives meanwhile: the client draws
//! its scene, at advancing times.

use super::cell::{Cell, Mode, REFRESH_HZ, Set, UPDATES_HZ};
use crate::measure::percentiles::median;
use crate::session::options::RunOptions;
use crate::session::seat::Seat;
use crate::session::{Lab, SERVER_EPOCH_NS, Server};
use anyhow::{Context, bail, ensure};
use serde::{Deserialize, Serialize};
use shadecast_client::client::{Client, FrameReport, Step};
use shadecast_mock_runtime::config::MockConfig;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Codec, Displayed, HeadState};
use shadecast_protocol::session::{Out, picture_stream};
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_scene::{Model, Scene};
use shadecast_server::encode;
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::pacing::quality::DEFAULT_QP;
use shadecast_server::serve::encoding::Encoding;
use shadecast_server::serve::viewer::{Reported, Viewer};
use shadecast_server::support::lock::lock;
use shadecast_server::update::{Shaded, ViewerUpdates};
use shadecast_server::world::World;
use shadecast_system::clock::thread_cpu_ns;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Updates that are handed over before anything is measured: in full detail the first brings all that is in view.
const UPDATES_BEFORE: u32 = 2;
/// The same with levels of detail, which take a few to come to rest.
const UPDATES_BEFORE_SHIPPED: u32 = 6;
/// Display frames after which waiting for an update to be shown is given up.
const MOST_FRAMES: u32 = 600;
/// How long updates that are measured in a row shall take, where those asked for take less, and how many more that makes at most.
const SERVER_TIME: Duration = Duration::from_millis(2500);
const MOST_TIMES_UPDATES: u32 = 8;
/// Display frames that are measured in a row, and how long they shall take.
const CLIENT_FRAMES: std::ops::Range<u32> = 10..60;
const CLIENT_TIME: Duration = Duration::from_millis(2000);
/// Display frames whose stages are timed on the device; each waits for it.
const TIMED_FRAMES: u32 = 5;
/// How long an update of the scene's clock is under way to the display, nanoseconds.
const WAY_NS: i64 = 30_000_000;
/// From an update to the next on the same clock.
const PERIOD_NS: i64 = (1e9 / UPDATES_HZ) as i64;
/// What is given to the encoder for a picture.
const PATIENCE: Duration = Duration::from_secs(60);

/// Milliseconds by stage.
pub type Stages = BTreeMap<String, f64>;

/// What an update takes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ServerCost {
    /// From its start to the next, milliseconds of real time.
    pub update_ms: f64,
    /// On the device.
    pub gpu_ms: Stages,
    /// Of the thread's CPU time: animation, the choice of what is told, its bytes, motion between updates, all else.
    pub cpu_ms: Stages,
    /// What the encoder takes for its picture, beside `update_ms`.
    pub encode_ms: f64,
}

/// What a display frame takes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClientCost {
    /// From its start to the next, milliseconds of real time.
    pub frame_ms: f64,
    /// On the device.
    pub gpu_ms: Stages,
    /// Of the thread's CPU time.
    pub cpu_ms: f64,
}

/// Rates of both at once on one device, a second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SharedRates {
    /// Updates.
    pub server_fps: f64,
    /// Display frames.
    pub client_fps: f64,
}

/// What was shown meanwhile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shown {
    /// Dragons that have pixels in the client's last picture.
    pub dragons: u32,
    /// Patches of the last update.
    pub patches: u32,
    /// Its triangles, those of two sides twice.
    pub triangles: u32,
    /// Patches in view that were left out, over all updates.
    pub dropped_patches: u64,
    /// Vertices that the client could not move in any display frame, for want of what moves them.
    pub withheld_vertices: u32,
    /// Bytes of an update's delta.
    pub delta_bytes: u64,
    /// Those of them that predict vertices.
    pub prediction_bytes: u64,
}

/// A cell once.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// The Vulkan device.
    pub device: String,
    /// The server by itself.
    pub server: ServerCost,
    /// The client by itself.
    pub client: ClientCost,
    /// Both at once.
    pub shared: SharedRates,
    /// What they showed.
    pub shown: Shown,
}

/// Measures a cell with so many updates of each kind. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// No device, no memory, no runtime; a cell that does not come to rest.
pub fn measure(
    cell: Cell,
    scene: &Scene,
    options: &RunOptions,
    config: &MockConfig,
    updates: u32,
) -> anyhow::Result<Measured> {
    let server = || Server::of_scene(options, cell.scene(scene));
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open_with(options, config, server) }?;
    let now_ns = connect(&mut lab)?;
    let head =
        lab.client.presenter.head_state().context("the client's head is known once it shows something")?;
    let (server, seat, client) = lab.apart();
    server.world.effort_mut().measure_by(thread_cpu_ns);
    let device = server.gpu.device_name();
    let mut client = ClientBench { client, now_ns, withheld_vertices: 0 };
    let mut server = ServerBench::new(cell, server, seat, head, now_ns)?;
    let before = if cell.set == Set::Paper { UPDATES_BEFORE } else { UPDATES_BEFORE_SHIPPED };
    (0..before).try_for_each(|_| server.hand_over(&mut client))?;
    server.tell_ahead(&mut client, longest_clip_s(scene))?;
    let client_cost = client.alone()?;
    let server_cost = server.alone(updates)?;
    let shared = shared(&mut server, &mut client, updates_in_a_row(updates, server_cost.update_ms))?;
    let last = server.last.take().context("updates were made")?;
    let shows = server.viewer.updates().shows(server.world);
    let shown = Shown {
        dragons: dragons_seen(client.client, scene)?,
        patches: shows.patches,
        triangles: shows.triangles,
        dropped_patches: server.viewer.updates().dropped_patches(),
        withheld_vertices: client.withheld_vertices,
        delta_bytes: last.delta_bytes,
        prediction_bytes: last.prediction_bytes,
    };
    if options.validation {
        let said = crate::report::stats::messages_of_both(&lab.server.gpu, &lab.client.presenter.stats());
        ensure!(said == Some(0), "the validation layers have said something");
    }
    Ok(Measured { device, server: server_cost, client: client_cost, shared, shown })
}

/// Lets the run go on until the newest update is on display; gives the last display time.
fn connect(lab: &mut Lab) -> anyhow::Result<i64> {
    for _ in 0..MOST_FRAMES {
        let Step::Frame(shown) = lab.step()? else {
            bail!("the OpenXR session ends before anything is shown")
        };
        let made = lab.seat().sent.updates;
        if shown.update.is_some_and(|update| u64::from(update.0) + 1 == made) {
            return Ok(shown.display_time.0);
        }
    }
    bail!("after {MOST_FRAMES} display frames the client does not show the newest update")
}

fn longest_clip_s(scene: &Scene) -> f32 {
    let clips =
        |model: &Model| (0..model.clips.len()).map(|clip| model.duration_s(Some(clip))).fold(0.0, f32::max);
    scene.models.iter().map(clips).fold(0.0, f32::max)
}

/// How many updates are measured, of which one took so long: as many as asked for, more where they are short.
fn updates_in_a_row(asked: u32, one_ms: f64) -> u32 {
    let wanted = (SERVER_TIME.as_secs_f64() * 1e3 / one_ms.max(0.1)).ceil();
    asked.max((wanted as u32).min(MOST_TIMES_UPDATES * asked))
}

/// How many dragons have pixels in what the client drew last.
fn dragons_seen(client: &mut Client, scene: &Scene) -> anyhow::Result<u32> {
    let views = client.presenter.probe()?;
    let seen: BTreeSet<u32> = views.iter().flat_map(|view| view.instance.iter().copied()).collect();
    let is_dragon = |instance: &&u32| {
        scene.instances.get(**instance as usize).is_some_and(|instance| instance.clip.is_some())
    };
    Ok(seen.iter().filter(is_dragon).count() as u32)
}

fn stages_of<'a>(timings: impl Iterator<Item = (&'a str, f64)>) -> Stages {
    let mut stages = Stages::new();
    timings.for_each(|(stage, ms)| *stages.entry(stage.to_owned()).or_default() += ms);
    stages
}

/// The middle of each stage.
fn median_stages<'a>(all: impl Iterator<Item = &'a Stages> + Clone) -> Stages {
    let names: BTreeSet<&String> = all.clone().flat_map(BTreeMap::keys).collect();
    let of = |name: &String| median(all.clone().map(|stages| stages.get(name).copied().unwrap_or(0.0)));
    names.into_iter().map(|name| (name.clone(), of(name))).collect()
}

// ---- the client ----

struct ClientBench<'a> {
    client: &'a mut Client,
    /// Of the last display frame, on the virtual clock.
    now_ns: i64,
    withheld_vertices: u32,
}

impl ClientBench<'_> {
    fn frame(&mut self) -> anyhow::Result<FrameReport> {
        self.now_ns += (1e9 / REFRESH_HZ) as i64;
        let now = ClientTime(self.now_ns);
        let Step::Frame(shown) = self.client.step_with(|intake| intake.advance(now))? else {
            bail!("the OpenXR session ends while it is measured");
        };
        self.withheld_vertices = self.withheld_vertices.max(shown.withheld_vertices);
        Ok(shown)
    }

    /// Takes what the server sends, all of which is streams.
    fn take(&mut self, out: Out) -> anyhow::Result<()> {
        let Out::Stream { bytes, .. } = out else { bail!("the server sends more than streams") };
        self.client.intake.receive_stream(ClientTime(self.now_ns), &bytes);
        Ok(())
    }

    /// Draws until an update is on display.
    fn show(&mut self, update: UpdateId) -> anyhow::Result<()> {
        for _ in 0..MOST_FRAMES {
            if self.frame()?.update == Some(update) {
                // What it could not move before counts for nothing.
                self.withheld_vertices = 0;
                return Ok(());
            }
        }
        bail!("after {MOST_FRAMES} display frames the client does not show update {}", update.0)
    }

    fn alone(&mut self) -> anyhow::Result<ClientCost> {
        self.client.presenter.frame_timings()?; // nothing is under way when the clock starts
        let (began, began_cpu_ns, mut frames) = (Instant::now(), thread_cpu_ns(), 0);
        while frames < CLIENT_FRAMES.start || (frames < CLIENT_FRAMES.end && began.elapsed() < CLIENT_TIME) {
            self.frame()?;
            frames += 1;
        }
        let cpu_ms = (thread_cpu_ns() - began_cpu_ns) as f64 * 1e-6 / f64::from(frames);
        self.client.presenter.frame_timings()?; // all that was submitted is done when it stops
        let frame_ms = began.elapsed().as_secs_f64() * 1e3 / f64::from(frames);
        let mut timed = Vec::new();
        for _ in 0..TIMED_FRAMES {
            self.frame()?;
            timed.push(stages_of(self.client.presenter.frame_timings()?.iter()));
        }
        Ok(ClientCost { frame_ms, gpu_ms: median_stages(timed.iter()), cpu_ms })
    }
}

// ---- the server ----

/// Bytes of an update's delta.
#[derive(Clone, Copy)]
struct Bytes {
    delta_bytes: u64,
    prediction_bytes: u64,
}

struct ServerBench<'a> {
    cell: Cell,
    world: &'a mut World,
    viewer: &'a mut Viewer<ViewerUpdates>,
    encoding: Encoding,
    /// For what is handed over.
    uncoded: Encoding,
    head: HeadState,
    displayed: Option<Displayed>,
    now_ns: i64,
    last: Option<Bytes>,
}

/// An update that was made, and what it took.
struct Made {
    wall_ms: f64,
    gpu_ms: Stages,
    cpu_ms: Stages,
    /// Its delta, and what is said of motion.
    streams: Vec<Out>,
    shaded: Box<Shaded>,
}

impl<'a> ServerBench<'a> {
    fn new(
        cell: Cell,
        server: &'a mut Server,
        seat: &'a mut Seat,
        head: HeadState,
        now_ns: i64,
    ) -> anyhow::Result<Self> {
        let settings =
            EncoderSettings::for_stream(server.offer().atlas_extent_texels, DEFAULT_QP, UPDATES_HZ);
        Ok(Self {
            cell,
            world: &mut server.world,
            viewer: seat.viewer.as_mut().context("the client is served")?,
            encoding: Encoding::new(encode::encoder(Codec::H264, settings)?),
            uncoded: Encoding::new(encode::encoder(Codec::Raw, settings)?),
            head,
            displayed: None,
            now_ns,
            last: None,
        })
    }

    /// Nothing of an update before is believed, as far as the cell does without.
    fn forget(&mut self) {
        if self.cell.set == Set::Paper {
            self.world.forget_shadow_map();
        }
        if self.cell.mode == Mode::AsPaper {
            self.world.forget_samples();
        }
    }

    fn update(&mut self) -> anyhow::Result<Made> {
        self.now_ns += PERIOD_NS;
        let now = ServerTime(self.now_ns - SERVER_EPOCH_NS);
        self.head = HeadState { time: now, sequence: self.head.sequence.wrapping_add(1), ..self.head };
        let reported =
            Reported { head: Some(self.head), displayed: self.displayed.take(), ..Reported::default() };
        self.viewer.apply(reported);
        self.forget();
        let effort = *self.world.effort();
        let (began, began_cpu_ns) = (Instant::now(), thread_cpu_ns());
        let updates = self.viewer.begin(None, self.now_ns);
        let shaded = updates.update(self.world, now)?.context("a viewer with a head has updates")?;
        let updated_cpu_ns = thread_cpu_ns();
        let (delta, update) = self.viewer.finish(shaded);
        let finished_cpu_ns = thread_cpu_ns();
        let mut streams = vec![delta];
        streams.extend(self.viewer.motion().into_iter().flat_map(|motion| lock(motion).tick(now, None)));
        let wall_ms = began.elapsed().as_secs_f64() * 1e3;
        let ms = |from_ns: i64, to_ns: i64| (to_ns - from_ns) as f64 * 1e-6;
        let animation_ms = self.world.effort().animation_ms() - effort.animation_ms();
        let delta_ms = self.world.effort().delta_ms() - effort.delta_ms();
        let cpu = [
            ("animation", animation_ms),
            ("delta", delta_ms),
            ("delta's bytes", ms(updated_cpu_ns, finished_cpu_ns)),
            ("motion", ms(finished_cpu_ns, thread_cpu_ns())),
            ("all else", ms(began_cpu_ns, updated_cpu_ns) - animation_ms - delta_ms),
        ];
        self.last = Some(Bytes {
            delta_bytes: update.sizes.total_bytes as u64,
            prediction_bytes: update.sizes.prediction_bytes as u64,
        });
        let (shaded, display_time) = (update.shaded, now.plus_ns(WAY_NS));
        self.displayed = Some(Displayed { update: shaded.update, display_time, ..Displayed::default() });
        let gpu_ms = stages_of(shaded.timings.iter());
        Ok(Made { wall_ms, gpu_ms, cpu_ms: stages_of(cpu.into_iter()), streams, shaded })
    }

    /// Makes an update, and has the client show it.
    fn hand_over(&mut self, client: &mut ClientBench<'_>) -> anyhow::Result<()> {
        let Made { streams, shaded, .. } = self.update()?;
        streams.into_iter().try_for_each(|out| client.take(out))?;
        self.uncoded.submit(shaded, true, DEFAULT_QP)?;
        let coded = self.uncoded.poll(PATIENCE).context("a picture is given as it is")??;
        client.take(picture_stream(coded.header, &coded.unit.bytes)?)?;
        self.viewer.recycle(*coded.shaded);
        client.show(coded.header.update)
    }

    /// Tells the client at once what it would be told of motion in so many seconds, since its time goes on by itself from now on:
    /// of clips that repeat it then has all keys.
    fn tell_ahead(&mut self, client: &mut ClientBench<'_>, seconds: f32) -> anyhow::Result<()> {
        for _ in 0..=(f64::from(seconds) * UPDATES_HZ).ceil() as u32 {
            self.now_ns += PERIOD_NS;
            let now = ServerTime(self.now_ns - SERVER_EPOCH_NS);
            let news = self.viewer.motion().map(|motion| lock(motion).tick(now, None));
            news.into_iter().flatten().try_for_each(|out| client.take(out))?;
        }
        Ok(())
    }

    /// Encodes an update's picture, and gives it back; milliseconds.
    fn encode(&mut self, shaded: Box<Shaded>) -> anyhow::Result<f64> {
        let began = Instant::now();
        self.encoding.submit(shaded, false, DEFAULT_QP)?;
        let coded = self.encoding.poll(PATIENCE).context("the encoder gives no picture")??;
        let took_ms = began.elapsed().as_secs_f64() * 1e3;
        self.viewer.recycle(*coded.shaded);
        Ok(took_ms)
    }

    fn alone(&mut self, updates: u32) -> anyhow::Result<ServerCost> {
        // The first has to catch up with the time that the client went on for; its picture is the encoder's first.
        let first = self.update()?;
        let updates = updates_in_a_row(updates, first.wall_ms);
        self.encode(first.shaded)?;
        let (mut walls, mut gpu, mut cpu, mut encodes) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for _ in 0..updates {
            let made = self.update()?;
            walls.push(made.wall_ms);
            gpu.push(made.gpu_ms);
            cpu.push(made.cpu_ms);
            encodes.push(self.encode(made.shaded)?);
        }
        Ok(ServerCost {
            update_ms: median(walls.into_iter()),
            gpu_ms: median_stages(gpu.iter()),
            cpu_ms: median_stages(cpu.iter()),
            encode_ms: median(encodes.into_iter()),
        })
    }

    /// So many updates one after the other.
    fn in_a_row(&mut self, updates: u32) -> anyhow::Result<()> {
        for _ in 0..updates {
            let made = self.update()?;
            self.viewer.recycle(*made.shaded);
        }
        Ok(())
    }
}

/// The server makes so many updates on a thread of its own, and the client draws until they are made.
fn shared(
    server: &mut ServerBench<'_>,
    client: &mut ClientBench<'_>,
    updates: u32,
) -> anyhow::Result<SharedRates> {
    let is_done = AtomicBool::new(false);
    let began = Instant::now();
    let (took_s, frames) = std::thread::scope(|scope| -> anyhow::Result<(f64, u32)> {
        let serving = scope.spawn(|| {
            let made = server.in_a_row(updates);
            is_done.store(true, Ordering::Relaxed);
            made.map(|()| began.elapsed().as_secs_f64())
        });
        let mut frames = 0;
        let drawn = loop {
            if is_done.load(Ordering::Relaxed) {
                break Ok(());
            }
            match client.frame() {
                Ok(_) => frames += 1,
                Err(error) => break Err(error),
            }
        };
        let made = serving.join().map_err(|_| anyhow::anyhow!("the server's thread has panicked"))?;
        drawn?;
        Ok((made?, frames))
    })?;
    // The last frame has ended a little later than the last update.
    let all_s = began.elapsed().as_secs_f64();
    Ok(SharedRates { server_fps: f64::from(updates) / took_s, client_fps: f64::from(frames) / all_s })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_updates_are_measured_more_often() {
        assert_eq!(updates_in_a_row(1, 10_000.0), 1);
        assert_eq!(updates_in_a_row(3, 900.0), 3);
        assert_eq!(updates_in_a_row(1, 500.0), 5);
        assert_eq!(updates_in_a_row(1, 0.0), MOST_TIMES_UPDATES);
    }

    #[test]
    fn stages_are_summed_by_name_and_their_middle_is_taken_by_name() {
        let one = |skin: f64| stages_of([("skin", skin), ("skin", 1.0), ("id buffer", 2.0)].into_iter());
        assert_eq!(one(3.0)["skin"], 4.0);
        let without = stages_of([("id buffer", 5.0)].into_iter());
        let middle = median_stages([one(3.0), one(9.0), without].iter());
        assert_eq!((middle["skin"], middle["id buffer"]), (4.0, 2.0));
    }
}
