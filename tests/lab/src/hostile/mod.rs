//! `shadecast-lab hostile`: the real programs on loopback, attacking strangers, and the effect on well-behaved peers.
//!
//! Attacks and durations enter. A report against bars leaves. Nothing here knows pictures' quality and virtual time.
//!
//! [`server`] has a server serve a well-behaved client while strangers attack it from other sockets. It checks that the client
//! keeps its picture, that the next one is served soon after, and that memory does not grow. Everything here runs in real time
//! and sends to this machine only. [`client`] connects a client to a server that breaks the rules. [`neighbours`] measures the
//! cost of a misbehaving viewer to the others.

pub mod attacks;
pub mod client;
mod lawful;
pub mod neighbours;
mod process;
mod report;
mod rogue;
mod scene;
pub mod server;
mod stranger;
pub mod traffic;

pub use report::{AttackReport, Bars, ClientReport, HostileReport};

use std::path::PathBuf;

/// What to attack with, and for how long.
#[derive(Clone, Debug)]
pub struct HostileOptions {
    /// Names of attacks; empty: all. Those on clients are among them.
    pub attacks: Vec<String>,
    /// Whether attacks that leave the place to others are made while nobody is served, too.
    pub always_alone: bool,
    /// Seconds that each attack lasts.
    pub seconds: f64,
    /// What is served; `None`: one turning cube.
    pub scene: Option<String>,
    /// What is still good.
    pub bars: Bars,
    /// Folder for identities and the scene; `None`: one that goes away.
    pub work: Option<PathBuf>,
    /// Says what is done, as it is done.
    pub verbose: bool,
}

impl HostileOptions {
    /// Every attack for so many seconds, judged by the bars of a machine that does nothing else.
    pub fn all(seconds: f64) -> Self {
        Self {
            attacks: Vec::new(),
            always_alone: true,
            seconds,
            scene: None,
            bars: Bars::STRICT,
            work: None,
            verbose: false,
        }
    }
}

/// Every attack for so many seconds: for the long runs.
///
/// # Errors
/// A program is missing or does not start. What the attacks do is no error: it stands in the report.
pub fn run_all(seconds: f64) -> anyhow::Result<HostileReport> {
    run(&HostileOptions { verbose: true, ..HostileOptions::all(seconds) })
}

/// Runs the attacks that were asked for.
///
/// # Errors
/// An attack is unknown, or a program is missing or does not start.
pub fn run(options: &HostileOptions) -> anyhow::Result<HostileReport> {
    check_names(&options.attacks)?;
    let is_wanted =
        |name: &str| options.attacks.is_empty() || options.attacks.iter().any(|it| it == "all" || it == name);
    let folder = Work::open(options.work.as_deref())?;
    let on_server: Vec<_> =
        attacks::ATTACKS.iter().filter(|attack| is_wanted(attack.name)).copied().collect();
    let (seconds, work) = (options.seconds, folder.path());
    Ok(HostileReport {
        seconds,
        attacks: server::attack_all(options, &on_server, work)?,
        client_attacks: client::attack_all(&is_wanted, seconds, &options.bars, work, options.verbose)?,
    })
}

/// The names of all attacks.
pub fn names() -> impl Iterator<Item = &'static str> {
    attacks::ATTACKS.iter().map(|attack| attack.name).chain(client::ATTACKS.iter().map(|(name, ..)| *name))
}

fn check_names(wanted: &[String]) -> anyhow::Result<()> {
    let unknown = wanted.iter().find(|name| *name != "all" && names().all(|known| known != *name));
    let Some(unknown) = unknown else { return Ok(()) };
    anyhow::bail!("\"{unknown}\" is no attack; there are all, {}", names().collect::<Vec<_>>().join(", "))
}

/// A folder, and whether it stays.
enum Work {
    Kept(PathBuf),
    Passing(PathBuf),
}

impl Work {
    /// `kept`, or one that goes away.
    fn open(kept: Option<&std::path::Path>) -> std::io::Result<Self> {
        let folder = match kept {
            Some(path) => Self::Kept(path.to_owned()),
            None => {
                Self::Passing(std::env::temp_dir().join(format!("shadecast-hostile-{}", std::process::id())))
            }
        };
        std::fs::create_dir_all(folder.path())?;
        Ok(folder)
    }

    fn path(&self) -> &std::path::Path {
        match self {
            Self::Kept(path) | Self::Passing(path) => path,
        }
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        if let Self::Passing(path) = self {
            let _ = std::fs::remove_dir_all(path); // temporary files are nobody's loss
        }
    }
}
