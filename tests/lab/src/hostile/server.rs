//! Attacks on a server, one after the other, each once with a well-behaved client and once without one.

use crate::hostile::HostileOptions;
use crate::hostile::attacks::{Attack, CONTROL, Effort, Target};
use crate::hostile::lawful::{self, Lawful};
use crate::hostile::process::Server;
use crate::hostile::report::AttackReport;
use crate::hostile::scene;
use anyhow::{Context, bail};
use shadecast_transport::identity::{KnownDevices, Rights};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How long a lawful client is waited for, in peace and after an attack.
const PATIENCE: Duration = Duration::from_secs(60);
/// Of peace, before each attack, this much is watched.
const SHORTEST_QUIET: Duration = Duration::from_millis(500);
/// See [`SHORTEST_QUIET`].
const LONGEST_QUIET: Duration = Duration::from_secs(5);
/// Who comes a quarter into an attack of this length has had time to be served before its end.
const LONG_ENOUGH: Duration = Duration::from_secs(8);
/// After the first picture the server's buffers have their sizes: memory counts from then on.
const SETTLING: Duration = Duration::from_millis(500);

/// Where the attacks happen.
struct Arena {
    scene: String,
    identity: PathBuf,
    lifetime_s: f64,
    /// `None` after it has ended.
    server: Option<Server>,
    asks_for_codes: bool,
}

/// Makes all attacks on one server; a server that did not survive is replaced for the next.
pub(crate) fn attack_all(
    options: &HostileOptions,
    attacks: &[Attack],
    folder: &Path,
) -> anyhow::Result<Vec<AttackReport>> {
    if attacks.is_empty() {
        return Ok(Vec::new());
    }
    let scene = match &options.scene {
        Some(scene) => scene.clone(),
        None => scene::write(folder)?.display().to_string(),
    };
    let lifetime_s = 300.0 + attacks.len() as f64 * 4.0 * (options.seconds + PATIENCE.as_secs_f64());
    let identity = folder.join("server");
    KnownDevices::load(&identity)?.pair(lawful::identity()?.fingerprint(), Rights::ALL)?;
    let mut arena = Arena { scene, identity, lifetime_s, server: None, asks_for_codes: false };
    let mut reports: Vec<AttackReport> = Vec::new();
    // The control first: others are judged by it.
    let (control, others): (Vec<&Attack>, Vec<&Attack>) =
        attacks.iter().partition(|attack| attack.name == CONTROL);
    for attack in control.into_iter().chain(others) {
        for while_serving in [true, false] {
            if !while_serving && attack.leaves_place && !options.always_alone {
                continue;
            }
            let mut report = arena.attack(attack, options.seconds, while_serving)?;
            let control = reports.iter().find(|it| it.attack == CONTROL && it.while_serving);
            report.control_per_s = control.and_then(|it| it.attacked_per_s).filter(|_| attack.burns_core);
            report.judge(&options.bars);
            if options.verbose {
                println!("{report}");
            }
            reports.push(report);
        }
    }
    Ok(reports)
}

impl Arena {
    /// The server, started anew where there is none.
    fn server(&mut self) -> anyhow::Result<&mut Server> {
        if self.server.as_mut().is_some_and(|server| !server.program.is_running()) {
            self.server = None;
        }
        match &mut self.server {
            Some(server) => Ok(server),
            none => {
                let admit = if self.asks_for_codes { "paired-only" } else { "paired" };
                Ok(none.insert(Server::start(&self.scene, &self.identity, admit, self.lifetime_s)?))
            }
        }
    }

    fn attack(&mut self, attack: &Attack, seconds: f64, while_serving: bool) -> anyhow::Result<AttackReport> {
        let duration = Duration::from_secs_f64(seconds);
        // Guesses of the attack before would leave pairing closed: each begins with a server of its own.
        if self.asks_for_codes || attack.asks_for_codes {
            (self.server, self.asks_for_codes) = (None, attack.asks_for_codes);
        }
        let address = self.server()?.address;
        let served = serve_first(address, duration.clamp(SHORTEST_QUIET, LONGEST_QUIET))?;
        let program = &self.server()?.program;
        let memory_before_bytes = program.memory_bytes().unwrap_or(0);
        let watch = program.watch_memory();
        let quiet = while_serving.then_some((served.longest_pause, served.pictures_per_s));
        let served = Some(served.client).filter(|_| while_serving); // otherwise it leaves now
        let start = Instant::now();
        let target = Target { server: address, identity: self.identity.clone(), until: start + duration };
        let expects_arrival = !while_serving && attack.leaves_place;
        let (effort, arrival) = attack_beside(attack, &target, expects_arrival, start + duration / 4)?;
        let end = Instant::now();
        let log = served.map(Lawful::leave);
        let newcomer = self.newcomer(address, end)?;
        let program = &mut self.server.as_mut().context("there was a server")?.program;
        let survived = program.is_running();
        let as_ms = |pause: Duration| pause.as_millis() as u64;
        Ok(AttackReport {
            attack: attack.name,
            what: attack.what,
            while_serving,
            is_served: !attack.leaves_place,
            effort,
            quiet_pause_ms: quiet.map(|(pause, _)| as_ms(pause)),
            attacked_pause_ms: log.as_ref().map(|log| as_ms(log.longest_pause(start, end))),
            quiet_per_s: quiet.map(|(_, per_s)| per_s),
            attacked_per_s: log.as_ref().map(|log| log.pictures_per_s(start, end)),
            control_per_s: None,
            losses: log.map(|log| log.losses(start, end)).unwrap_or_default(),
            arrival_ms: arrival.map(as_ms),
            arrival_counts: expects_arrival && duration >= LONG_ENOUGH,
            newcomer_ms: newcomer.map(as_ms),
            survived,
            last_words: if survived { String::new() } else { program.last_words() },
            memory_before_bytes,
            memory_peak_bytes: watch.peak_bytes(),
            memory_after_bytes: program.memory_bytes().unwrap_or(0),
            misses: Vec::new(),
        })
    }

    /// How long after `end` a lawful client that comes then has its first picture.
    fn newcomer(&mut self, server: SocketAddr, end: Instant) -> anyhow::Result<Option<Duration>> {
        let newcomer = Lawful::start(server)?;
        let deadline = end + PATIENCE;
        while Instant::now() < deadline && self.server.as_mut().is_some_and(|it| it.program.is_running()) {
            if let Some(at) = newcomer.wait_picture(end, Duration::from_millis(200)) {
                return Ok(Some(at.duration_since(end)));
            }
        }
        Ok(None)
    }
}

/// Attacks; where a lawful client is to come meanwhile, how long it waited for its first picture.
fn attack_beside(
    attack: &Attack,
    target: &Target,
    expects_arrival: bool,
    comes: Instant,
) -> anyhow::Result<(Effort, Option<Duration>)> {
    std::thread::scope(|scope| {
        let attacker = scope.spawn(|| attack.run(target));
        let mut arrival = None;
        if expects_arrival {
            std::thread::sleep(comes.saturating_duration_since(Instant::now()));
            let client = Lawful::start(target.server)?;
            let patience = target.until.saturating_duration_since(Instant::now());
            arrival = client.wait_picture(comes, patience).map(|at| at.duration_since(comes));
        }
        let effort = attacker.join().map_err(|_| anyhow::anyhow!("{} panicked", attack.name))??;
        Ok((effort, arrival))
    })
}

/// A client that is served in peace.
struct ServedInPeace {
    client: Lawful,
    longest_pause: Duration,
    pictures_per_s: f64,
}

/// Has a lawful client served, and watches it for a while.
fn serve_first(server: SocketAddr, quiet: Duration) -> anyhow::Result<ServedInPeace> {
    let client = Lawful::start(server)?;
    let Some(_) = client.wait_picture(Instant::now(), PATIENCE) else {
        bail!("a lawful client is not served in peace: {:?}", client.log().ends);
    };
    std::thread::sleep(SETTLING);
    let from = Instant::now();
    std::thread::sleep(quiet);
    let (log, to) = (client.log(), Instant::now());
    let (longest_pause, pictures_per_s) = (log.longest_pause(from, to), log.pictures_per_s(from, to));
    Ok(ServedInPeace { client, longest_pause, pictures_per_s })
}
