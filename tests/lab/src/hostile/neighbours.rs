//! Cost of a misbehaving viewer to the others of the same server: a well-behaved client's pictures beside each kind of
//! neighbour, relative to those beside another well-behaved one.

use crate::hostile::Work;
use crate::hostile::attacks::{REFUSED_PAUSE, Repeated, Target, control_bytes, hello_bytes};
use crate::hostile::lawful::{Lawful, head};
use crate::hostile::process::Server;
use crate::hostile::scene;
use crate::hostile::stranger::Stranger;
use crate::measure::percentiles::median;
use anyhow::Context;
use serde::Serialize;
use shadecast_protocol::message::{ClientDatagram, ClientMessage};
use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How long a lawful client is waited for.
const PATIENCE: Duration = Duration::from_secs(60);
/// From the neighbour's coming to the first picture that counts.
const SETTLING: Duration = Duration::from_millis(1000);
/// How often each neighbour is measured; machines change their speed, so that the median counts.
const ROUNDS: usize = 5;
/// From one look at the network to the next.
const NAP: Duration = Duration::from_millis(1);
/// From one display frame of a stranger to the next.
const POSE_PERIOD: Duration = Duration::from_millis(14);

/// How a neighbour behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Neighbour {
    /// There is none.
    Nobody,
    /// As it should.
    Lawful,
    /// It is served, and takes none of the streams that it is sent; what arrives is acknowledged.
    TakesNothing,
    /// It is served, and says nothing any more, not even what a network does by itself.
    Silent,
    /// It is served, and asks for refreshes as fast as the network takes it; sent away for that, it comes again.
    Floods,
    /// It is served, and vanishes in the middle; again and again.
    Killed,
}

impl Neighbour {
    const ALL: [Self; 6] =
        [Self::Nobody, Self::Lawful, Self::TakesNothing, Self::Silent, Self::Floods, Self::Killed];
}

/// What a neighbour makes of the pictures of a lawful client.
#[derive(Clone, Debug, Serialize)]
pub struct NeighbourReport {
    /// The neighbour.
    pub neighbour: Neighbour,
    /// Pictures a second of the lawful client, the median of the rounds.
    pub pictures_per_s: f64,
    /// The same by rounds.
    pub rounds: Vec<f64>,
    /// Of those that it gets beside a lawful neighbour in the same round; the median.
    pub share_of_lawful: f64,
    /// Longest pause between two of its pictures, milliseconds.
    pub longest_pause_ms: u64,
    /// How often the neighbour came, over all rounds.
    pub came: u64,
}

/// All neighbours.
#[derive(Clone, Debug, Serialize)]
pub struct NeighboursReport {
    /// Seconds that each was beside the lawful client, in each round.
    pub seconds: f64,
    /// The least share, over all neighbours.
    pub least_share: f64,
    /// One a kind.
    pub neighbours: Vec<NeighbourReport>,
}

/// Measures all of them, each for so many seconds in each of some rounds.
///
/// # Errors
/// The server does not start, or a lawful client is not served.
pub fn measure(seconds: f64) -> anyhow::Result<NeighboursReport> {
    let folder = Work::open(None)?;
    let folder = folder.path();
    let scene = scene::write(folder)?.display().to_string();
    let whole_s = ROUNDS as f64 * Neighbour::ALL.len() as f64 * (seconds + PATIENCE.as_secs_f64());
    let mut rounds: Vec<[Beside; Neighbour::ALL.len()]> = Vec::new();
    for _ in 0..ROUNDS {
        let mut round = [Beside::default(); Neighbour::ALL.len()];
        for (measured, neighbour) in round.iter_mut().zip(Neighbour::ALL) {
            // Each has a server of its own: what one leaves behind is not the next one's fault.
            let identity = folder.join("server");
            let server = Server::start(&scene, &identity, "paired", whole_s)?;
            *measured = beside((server.address, identity), neighbour, Duration::from_secs_f64(seconds))?;
        }
        rounds.push(round);
    }
    let lawful = Neighbour::ALL.iter().position(|it| *it == Neighbour::Lawful).unwrap_or(0);
    let neighbours: Vec<_> = Neighbour::ALL
        .into_iter()
        .enumerate()
        .map(|(at, neighbour)| {
            let rates: Vec<f64> = rounds.iter().map(|round| round[at].pictures_per_s).collect();
            let shares = rounds.iter().map(|round| round[at].pictures_per_s / round[lawful].pictures_per_s);
            let longest = rounds.iter().map(|round| round[at].pause).max().unwrap_or_default();
            NeighbourReport {
                neighbour,
                pictures_per_s: median(rates.iter().copied()),
                rounds: rates,
                share_of_lawful: median(shares),
                longest_pause_ms: longest.as_millis() as u64,
                came: rounds.iter().map(|round| round[at].came).sum(),
            }
        })
        .collect();
    let least_share = neighbours.iter().map(|it| it.share_of_lawful).fold(f64::INFINITY, f64::min);
    Ok(NeighboursReport { seconds, least_share, neighbours })
}

/// A lawful client beside a neighbour.
#[derive(Clone, Copy, Debug, Default)]
struct Beside {
    pictures_per_s: f64,
    /// Longest time without a picture.
    pause: Duration,
    /// How often the neighbour came.
    came: u64,
}

fn beside(
    (server, identity): (SocketAddr, PathBuf),
    neighbour: Neighbour,
    duration: Duration,
) -> anyhow::Result<Beside> {
    let client = Lawful::start(server)?;
    client.wait_picture(Instant::now(), PATIENCE).context("a lawful client is not served in peace")?;
    let until = Instant::now() + SETTLING + duration;
    let from = until - duration;
    let came = std::thread::scope(|scope| {
        let target = Target { server, identity, until };
        let other = scope.spawn(move || neighbour.behave(&target));
        std::thread::sleep(until.saturating_duration_since(Instant::now()));
        other.join().map_err(|_| anyhow::anyhow!("a neighbour panicked"))?
    })?;
    let log = client.leave();
    let count = log.pictures.iter().filter(|at| (from..until).contains(*at)).count();
    let pictures_per_s = count as f64 / duration.as_secs_f64();
    Ok(Beside { pictures_per_s, pause: log.longest_pause(from, until), came })
}

impl Neighbour {
    /// Gives how often it came.
    fn behave(self, target: &Target) -> anyhow::Result<u64> {
        match self {
            Self::Nobody => {}
            Self::Lawful => {
                let client = Lawful::start(target.server)?;
                std::thread::sleep(target.until.saturating_duration_since(Instant::now()));
                client.leave();
            }
            Self::TakesNothing => return again_and_again(target, |_| target.until, || |_: &mut Stranger| {}),
            Self::Silent => {
                let mut stranger = served(target)?;
                stranger.pump_until(Instant::now() + POSE_PERIOD, |_| false)?;
                target.sleep(target.until.saturating_duration_since(Instant::now()));
            }
            Self::Floods => {
                let request = control_bytes(&ClientMessage::RefreshRequest { after: None });
                return again_and_again(
                    target,
                    |_| target.until,
                    || {
                        let mut requests = Repeated::new(&request);
                        move |stranger: &mut Stranger| {
                            requests.write(stranger);
                        }
                    },
                );
            }
            Self::Killed => {
                let third = target.until.saturating_duration_since(Instant::now()) / 3;
                return again_and_again(target, |now| now + third, || |_: &mut Stranger| {});
            }
        }
        Ok(u64::from(self != Self::Nobody))
    }
}

/// Is served until `until` of its coming, doing what `begin` gives in each turn, and then drops the connection without a word;
/// comes again whenever that has ended. Gives how often it came.
fn again_and_again<Act: FnMut(&mut Stranger)>(
    target: &Target,
    until: impl Fn(Instant) -> Instant,
    begin: impl Fn() -> Act,
) -> anyhow::Result<u64> {
    let mut came = 0;
    while !target.is_over() {
        came += 1;
        serve_stranger(target, until(Instant::now()).min(target.until), begin())?;
    }
    Ok(came)
}

/// A stranger that has said a lawful hello.
fn served(target: &Target) -> anyhow::Result<Stranger> {
    let mut stranger = Stranger::connect(target.server)?;
    stranger.pump_until(target.until, |it| it.is_connected() || it.ended().is_some())?;
    stranger.write_control(&hello_bytes(|_| {}));
    stranger.pump_until(target.until, |it| !it.heard().is_empty() || it.ended().is_some())?;
    stranger.send_datagram(&ClientDatagram::Pose(head(0, 0.0)).encode());
    Ok(stranger)
}

/// One that tells where its head is, and does something else in each turn.
fn serve_stranger(target: &Target, until: Instant, mut act: impl FnMut(&mut Stranger)) -> anyhow::Result<()> {
    let (mut stranger, start) = (served(target)?, Instant::now());
    let (mut next_pose, mut sequence) = (start, 0);
    while Instant::now() < until && stranger.is_connected() {
        if Instant::now() >= next_pose {
            next_pose += POSE_PERIOD;
            sequence += 1;
            let pose = head(sequence, start.elapsed().as_secs_f32());
            stranger.send_datagram(&ClientDatagram::Pose(pose).encode());
        }
        act(&mut stranger);
        stranger.pump()?;
        std::thread::sleep(NAP);
    }
    if !stranger.is_connected() {
        target.sleep(REFUSED_PAUSE);
    }
    Ok(())
}

impl fmt::Display for NeighboursReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for it in &self.neighbours {
            let name = format!("{:?}", it.neighbour);
            writeln!(
                f,
                "{name:<14} {:5.1} pictures/s, {:5.2} of beside a lawful one, longest pause {} ms; it came {} times",
                it.pictures_per_s, it.share_of_lawful, it.longest_pause_ms, it.came
            )?;
        }
        write!(f, "least share {:.2}", self.least_share)
    }
}
