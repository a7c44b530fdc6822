//! What a viewer that behaves badly costs the others of the same server: how many pictures a lawful client gets beside each
//! kind of neighbour, of those that it gets beside another lawful one.

use crate::hostile::attacks::{Target, control_bytes, hello_bytes};
use crate::hostile::lawful::{Lawful, head};
use crate::hostile::process::Server;
use crate::hostile::scene;
use crate::hostile::stranger::Stranger;
use anyhow::Context;
use serde::Serialize;
use shadecast_protocol::message::{ClientDatagram, ClientMessage};
use std::fmt;
use std::net::SocketAddr;
use std::path::Path;
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
    /// It is served, and asks for refreshes as fast as the network takes it.
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
    let folder = std::env::temp_dir().join(format!("shadecast-neighbours-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let report = measure_in(&folder, seconds);
    let _ = std::fs::remove_dir_all(&folder); // temporary files are nobody's loss
    report
}

fn measure_in(folder: &Path, seconds: f64) -> anyhow::Result<NeighboursReport> {
    let scene = scene::write(folder)?.display().to_string();
    let whole_s = ROUNDS as f64 * Neighbour::ALL.len() as f64 * (seconds + PATIENCE.as_secs_f64());
    let mut rounds: Vec<[(f64, Duration); Neighbour::ALL.len()]> = Vec::new();
    for _ in 0..ROUNDS {
        let mut round = [(0.0, Duration::ZERO); Neighbour::ALL.len()];
        for (measured, neighbour) in round.iter_mut().zip(Neighbour::ALL) {
            // Each has a server of its own: what one leaves behind is not the next one's fault.
            let server = Server::start(&scene, &folder.join("server"), whole_s)?;
            *measured = beside(server.address, neighbour, Duration::from_secs_f64(seconds))?;
        }
        rounds.push(round);
    }
    let lawful = Neighbour::ALL.iter().position(|it| *it == Neighbour::Lawful).unwrap_or(0);
    let neighbours: Vec<_> = Neighbour::ALL
        .into_iter()
        .enumerate()
        .map(|(at, neighbour)| {
            let rates: Vec<f64> = rounds.iter().map(|round| round[at].0).collect();
            let shares = rounds.iter().map(|round| round[at].0 / round[lawful].0).collect();
            let longest = rounds.iter().map(|round| round[at].1).max().unwrap_or_default();
            NeighbourReport {
                neighbour,
                pictures_per_s: median(rates.clone()),
                rounds: rates,
                share_of_lawful: median(shares),
                longest_pause_ms: longest.as_millis() as u64,
            }
        })
        .collect();
    let least_share = neighbours.iter().map(|it| it.share_of_lawful).fold(f64::INFINITY, f64::min);
    Ok(NeighboursReport { seconds, least_share, neighbours })
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Pictures a second of a lawful client beside a neighbour, and the longest time without one.
fn beside(server: SocketAddr, neighbour: Neighbour, duration: Duration) -> anyhow::Result<(f64, Duration)> {
    let client = Lawful::start(server)?;
    client.wait_picture(Instant::now(), PATIENCE).context("a lawful client is not served in peace")?;
    let until = Instant::now() + SETTLING + duration;
    let from = until - duration;
    std::thread::scope(|scope| {
        let target = Target { server, until };
        let other = scope.spawn(move || neighbour.behave(&target));
        std::thread::sleep(until.saturating_duration_since(Instant::now()));
        other.join().map_err(|_| anyhow::anyhow!("a neighbour panicked"))?
    })?;
    let log = client.leave();
    let count = log.pictures.iter().filter(|at| (from..until).contains(*at)).count();
    Ok((count as f64 / duration.as_secs_f64(), log.longest_pause(from, until)))
}

impl Neighbour {
    fn behave(self, target: &Target) -> anyhow::Result<()> {
        match self {
            Self::Nobody => {}
            Self::Lawful => {
                let client = Lawful::start(target.server)?;
                std::thread::sleep(target.until.saturating_duration_since(Instant::now()));
                client.leave();
            }
            Self::TakesNothing => serve_stranger(target, target.until, |_| {})?,
            Self::Silent => {
                let mut stranger = served(target)?;
                stranger.pump_until(Instant::now() + POSE_PERIOD, |_| false)?;
                std::thread::sleep(target.until.saturating_duration_since(Instant::now()));
            }
            Self::Floods => {
                let request = control_bytes(&ClientMessage::RefreshRequest { after: None }).repeat(1000);
                serve_stranger(target, target.until, |stranger| {
                    stranger.write_control(&request);
                })?;
            }
            Self::Killed => {
                while !target.is_over() {
                    let lives = Instant::now() + target.until.saturating_duration_since(Instant::now()) / 3;
                    // Dropped without a word.
                    serve_stranger(target, lives.max(Instant::now() + SETTLING), |_| {})?;
                }
            }
        }
        Ok(())
    }
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
    Ok(())
}

impl fmt::Display for NeighboursReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for it in &self.neighbours {
            let name = format!("{:?}", it.neighbour);
            writeln!(
                f,
                "{name:<14} {:5.1} pictures/s, {:5.2} of beside a lawful one, longest pause {} ms",
                it.pictures_per_s, it.share_of_lawful, it.longest_pause_ms
            )?;
        }
        write!(f, "least share {:.2}", self.least_share)
    }
}
