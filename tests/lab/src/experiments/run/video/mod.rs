//! `shadecast-lab run --renderer video`: what a video of both eyes shows at the same rate over the same link.
//!
//! The server renders what both eyes are expected to see, by the truth's renderer, wider by a margin, and encodes it. The client turns the
//! newest picture to where the head looks now (rotational time-warp); with depth, also to where it is (positional time-warp). Head, link,
//! durations of stages, prediction and encoder are those of the other renderers. In favour of video: clocks agree, each picture has the light of several places of a pixel, the encoder has its loop filter,
//! and its quantiser follows the rate closely. Pictures that the link cannot carry queue up: the rate must fit the link.

mod depth;
mod rate;
mod studio;
mod warp;

use super::{Look, Report, add_flicker, comparer, progress, write_pictures};
use crate::image::Rgb8Image;
use crate::measure::compare::{Comparer, Shown};
use crate::measure::percentiles::median;
use crate::report::stats::{Counted, MbitPerS, Summary};
use crate::session::options::RunOptions;
use crate::session::walk::Walk;
use crate::session::{SERVER_EPOCH_NS, START_NS, Server};
use anyhow::{Context, ensure};
use shadecast_mock_runtime::clock::period_begin_ns;
use shadecast_mock_runtime::config::MockConfig;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::HeadState;
use shadecast_protocol::time::ServerTime;
use shadecast_server::visibility::predict::extrapolate;
use shadecast_transport::endpoint::{Endpoint, EndpointConfig};
use shadecast_transport::event::{Event, PeerId};
use shadecast_transport::{Direction, Pair, ServerIdentity};
use std::collections::{BTreeMap, VecDeque};
use studio::Studio;
use warp::Decoded;

/// From a picture's begin to its first display, until the first is reported.
const FIRST_DELAY_NS: i64 = 80_000_000;
/// Reports whose median is the next delay.
const DELAYS: usize = 15;
/// Bytes of what goes with a picture: its number, pose, field of view and time.
const HEADER_BYTES: usize = 64;
const SEED: u64 = 0x7669_6465_6f00;

/// Runs and measures, as [`super::run`] does.
///
/// # Errors
/// No device, a file, or a size that the encoder does not take.
pub(super) fn run(options: &RunOptions, config: &MockConfig) -> anyhow::Result<Report> {
    let server = Server::new(options)?;
    let frames = (options.seconds * options.refresh_hz).round() as u64;
    let walk = Walk::new(config, server.scene.scene.world_from_stage, options.fov_degrees)?;
    let mut comparer = comparer(&server, options)?;
    let mut show = Show {
        studio: Studio::new(options, &server)?,
        wire: Wire::new(options)?,
        options,
        server,
        walk,
        pictures: BTreeMap::new(),
        begun_ns: BTreeMap::new(),
        leaving: VecDeque::new(),
        next_ns: START_NS,
        number: 0,
        head: None,
        delays_ns: VecDeque::new(),
        shown: None,
        sent: Sent::default(),
    };
    let (mut summary, mut looks, mut last) = (Summary::default(), Vec::new(), None);
    let (mut sent_before, mut with_bundle) = (Sent::default(), 0);
    let bar = progress(options.verbose, frames);
    for frame in 0..frames {
        show.play_to(period_begin_ns(START_NS, options.refresh_hz, frame))?;
        if frame == options.compare_from {
            sent_before = show.sent;
        }
        show.begin_frame(frame);
        with_bundle += u64::from(show.shown.is_some());
        if options.compares(frame)
            && let Some(number) = show.shown
        {
            let pictures = show.compare(&mut comparer, &mut summary, number, frame)?;
            add_flicker(&mut summary, &looks, last.as_ref(), frame, &pictures);
            last = Some(pictures);
            looks.push(Look::of(frame, summary.last_two()));
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    ensure!(with_bundle > 0, "the client showed no picture in {} s", options.seconds);
    let seconds = options.seconds - options.compare_from as f64 / options.refresh_hz;
    let sent = show.sent.since(sent_before);
    let stats = summary.finish(Counted {
        device: show.server.gpu.device_name(),
        device_is_cpu: show.server.gpu.is_cpu(),
        renderer: options.renderer.name().into(),
        server_fps: sent.pictures as f64 / seconds,
        client_fps: options.refresh_hz,
        mbit_per_s: MbitPerS { atlas: sent.bytes as f64 * 8e-6 / seconds, geometry: 0.0 },
        mean_qp: Some(sent.qp_sum as f64 / sent.pictures.max(1) as f64),
        validation_messages: show.server.gpu.checked_messages().map(u64::from),
        stage_ms: Some(options.stages),
        ..Counted::default()
    });
    stats.write_json(&options.out.join("stats.json"))?;
    if let Some([client, truth]) = &last {
        write_pictures(&options.out, client, truth, None, &stats)?;
    }
    Ok(Report {
        stats,
        frames_with_bundle: with_bundle,
        frames_before_first_bundle: frames - with_bundle,
        runtime_errors: 0,
        motion: None,
        compared: Vec::new(),
        looks,
    })
}

/// What went on the wire.
#[derive(Clone, Copy, Default)]
struct Sent {
    pictures: u64,
    bytes: u64,
    qp_sum: u64,
}

impl Sent {
    fn since(self, before: Self) -> Self {
        Self {
            pictures: self.pictures - before.pictures,
            bytes: self.bytes - before.bytes,
            qp_sum: self.qp_sum - before.qp_sum,
        }
    }
}

/// A picture of both eyes from its begin to the end of its display.
struct Picture {
    /// What the client decodes of it.
    eyes: [Decoded; 2],
    /// When that is done.
    ready_ns: Option<i64>,
}

/// Both ends, and what is between them.
struct Show<'a> {
    options: &'a RunOptions,
    server: Server,
    walk: Walk,
    studio: Studio,
    wire: Wire,
    /// By number; those before the one on display are gone.
    pictures: BTreeMap<u64, Picture>,
    /// When pictures were begun that no report has told of: reports come when pictures are long gone.
    begun_ns: BTreeMap<u64, i64>,
    /// Coded pictures, and when they leave.
    leaving: VecDeque<(i64, Vec<u8>)>,
    /// When the next picture begins, and its number.
    next_ns: i64,
    number: u64,
    /// The newest that the server knows.
    head: Option<HeadState>,
    /// From the begin of pictures to their first display.
    delays_ns: VecDeque<i64>,
    /// The picture on display.
    shown: Option<u64>,
    sent: Sent,
}

impl Show<'_> {
    /// All that happens up to a time.
    fn play_to(&mut self, until_ns: i64) -> anyhow::Result<()> {
        loop {
            let leaves_ns = self.leaving.front().map_or(i64::MAX, |(at_ns, _)| *at_ns);
            let next_ns = leaves_ns.min(self.next_ns);
            self.hear(next_ns.min(until_ns))?;
            if next_ns >= until_ns {
                return Ok(());
            }
            if leaves_ns <= self.next_ns {
                let (_, bytes) = self.leaving.pop_front().expect("one leaves");
                self.wire.pair.server.send_stream(self.wire.at_server, bytes, 0)?;
            } else {
                self.begin_picture()?;
            }
        }
    }

    /// Takes what arrives up to a time at either end.
    fn hear(&mut self, until_ns: i64) -> anyhow::Result<()> {
        loop {
            let events = self.wire.pair.step_to_events(until_ns);
            if events.is_empty() {
                return Ok(());
            }
            for (end, event) in events {
                match (end, event) {
                    (Direction::ToServer, Event::Datagram { bytes, .. }) => self.hear_head(&bytes),
                    (Direction::ToClient, Event::Stream { bytes, at_ns, .. }) => {
                        let number = u64::from_le_bytes(bytes[..8].try_into()?);
                        let picture = self.pictures.get_mut(&number).context("a picture that was sent")?;
                        picture.ready_ns = Some(at_ns + self.options.stages.ns(self.options.stages.decode));
                    }
                    _ => {}
                }
            }
        }
    }

    /// A frame's begin as the client told it: its number, and which picture it shows for the first time.
    fn hear_head(&mut self, bytes: &[u8]) {
        let word = |at: usize| bytes[8 * at..][..8].try_into().map(u64::from_le_bytes).expect("eight bytes");
        let frame = word(0);
        // As the atlas's client tells it: where the head will be when the frame is seen.
        let seen_ns = self.display_ns(frame);
        let [linear_velocity, angular_velocity] = self.walk.velocities(seen_ns);
        let state = HeadState {
            sequence: frame as u32,
            time: ServerTime(seen_ns - SERVER_EPOCH_NS),
            world_from_head: self.walk.world_from_head(seen_ns),
            linear_velocity,
            angular_velocity,
            eyes: self.walk.eyes(),
            discontinuity: DiscontinuityId(0),
        };
        if self.head.is_none_or(|head| head.time < state.time) {
            self.head = Some(state);
        }
        if let Some(begun_ns) = word(1).checked_sub(1).and_then(|number| self.begun_ns.remove(&number)) {
            self.begun_ns.retain(|_, at_ns| *at_ns > begun_ns);
            if self.delays_ns.len() == DELAYS {
                self.delays_ns.pop_front();
            }
            self.delays_ns.push_back(self.display_ns(frame) - begun_ns);
        }
    }

    /// When a frame is seen: when the next one begins.
    fn display_ns(&self, frame: u64) -> i64 {
        period_begin_ns(START_NS, self.options.refresh_hz, frame + 1)
    }

    /// The server renders and encodes for where the head will be, if it knows of one.
    fn begin_picture(&mut self) -> anyhow::Result<()> {
        let begun_ns = self.next_ns;
        self.next_ns += (1e9 / self.options.rate_hz) as i64;
        let Some(head) = self.head else { return Ok(()) };
        let first_ns = match self.delays_ns.is_empty() {
            true => FIRST_DELAY_NS,
            false => median(self.delays_ns.iter().map(|delay_ns| *delay_ns as f64)) as i64,
        };
        let on_display_ns = 1e9 / self.options.rate_hz - 1e9 / self.options.refresh_hz;
        let seen_ns = begun_ns + first_ns + (0.5 * on_display_ns.max(0.0)) as i64;
        let world_from_head = extrapolate(&head, ServerTime(seen_ns - SERVER_EPOCH_NS));
        let number = self.number;
        self.number += 1;
        let world_from_eyes = self.walk.eyes().map(|eye| world_from_head.then(eye.head_from_eye));
        let qp = self.studio.qp();
        let (eyes, coded) =
            self.studio.picture(world_from_eyes, self.server.world_time(seen_ns), begun_ns)?;
        let mut bytes = vec![0; HEADER_BYTES];
        bytes[..8].copy_from_slice(&number.to_le_bytes());
        bytes.extend(coded.concat());
        self.sent.pictures += 1;
        self.sent.bytes += bytes.len() as u64;
        self.sent.qp_sum += u64::from(qp);
        let stages = self.options.stages;
        self.leaving.push_back((begun_ns + stages.ns(stages.server) + stages.ns(stages.encode), bytes));
        self.pictures.insert(number, Picture { eyes, ready_ns: None });
        self.begun_ns.insert(number, begun_ns);
        Ok(())
    }

    /// The client takes the newest picture for a frame and says so, with where its head is.
    fn begin_frame(&mut self, frame: u64) {
        let begin_ns = period_begin_ns(START_NS, self.options.refresh_hz, frame);
        // Each picture needs the one before.
        let ready =
            self.pictures.iter().take_while(|(_, picture)| picture.ready_ns.is_some_and(|at| at <= begin_ns));
        let newest = ready.map(|(number, _)| *number).last();
        let is_new = newest != self.shown;
        self.shown = newest.or(self.shown);
        if let Some(shown) = self.shown {
            self.pictures = self.pictures.split_off(&shown);
        }
        let first_shown = self.shown.filter(|_| is_new).map_or(0, |number| number + 1);
        let bytes = [frame, first_shown].map(u64::to_le_bytes).concat();
        self.wire.pair.client.send_datagram(self.wire.at_client, &bytes);
    }

    /// Both eyes of a frame against the truth: client and truth by eye.
    fn compare(
        &self,
        comparer: &mut Comparer,
        summary: &mut Summary,
        number: u64,
        frame: u64,
    ) -> anyhow::Result<[[Rgb8Image; 2]; 2]> {
        let display_ns = self.display_ns(frame);
        let world_from_head = self.walk.world_from_head(display_ns);
        let (mut clients, mut truths) = (Vec::new(), Vec::new());
        for (eye, decoded) in self.walk.eyes().iter().zip(&self.pictures[&number].eyes) {
            let world_from_eye = world_from_head.then(eye.head_from_eye);
            let picture = decoded.warped(world_from_eye, eye.fov, self.options.extent_pixels);
            let time = self.server.world_time(display_ns);
            let shown = Shown { world_from_eye, fov: eye.fov, time, picture: &picture, probe: None };
            let (truth, metrics) = comparer.measure_whole(&shown)?;
            summary.add(metrics);
            clients.push(picture);
            truths.push(truth);
        }
        let pair = |pictures: Vec<Rgb8Image>| pictures.try_into().ok().context("two eyes");
        Ok([pair(clients)?, pair(truths)?])
    }
}

/// The simulated link with both ends, connected.
struct Wire {
    pair: Pair,
    /// The client as the server knows it, and the server as the client does.
    at_server: PeerId,
    at_client: PeerId,
}

impl Wire {
    fn new(options: &RunOptions) -> anyhow::Result<Self> {
        let seed = options.seed ^ SEED;
        let identity = ServerIdentity::from_seed(seed)?;
        let config = |salt| EndpointConfig { seed: Some(seed ^ salt), ..EndpointConfig::default() };
        let server = Endpoint::server(&identity, config(1))?;
        let mut pair = Pair::new(server, Endpoint::client(config(2)), options.link.clone(), seed);
        let at_server = pair.connect();
        ensure!(pair.now_ns() < START_NS, "connecting took longer than a second of the virtual clock");
        let at_client = pair.client.peers().next().context("the client is connected")?;
        Ok(Self { pair, at_server, at_client })
    }
}
