//! Whom a server serves: pairing, and the list of paired devices.

use crate::output::note;
use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use shadecast_protocol::text::printable;
use shadecast_server::serve::sessions::admission::Admit;
use shadecast_server::serve::stream;
use shadecast_transport::identity::pairing::Code;
use shadecast_transport::identity::{KnownDevices, Rights, default_directory};
use std::io::Write;
use std::path::PathBuf;
use std::str::FromStr;

/// [`Admit`] on the command line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdmitArg(pub(crate) Admit);

/// All of them.
pub(crate) const ADMITS: [AdmitArg; 3] =
    [AdmitArg(Admit::Paired), AdmitArg(Admit::PairedOnly), AdmitArg(Admit::Anyone)];

/// The name of one of them, and what it means.
pub(crate) fn of_admit(AdmitArg(admit): AdmitArg) -> (&'static str, &'static str) {
    match admit {
        Admit::Paired => {
            ("paired", "Paired devices, and programs of this machine; others are asked for a code")
        }
        Admit::PairedOnly => {
            ("paired-only", "Paired devices alone: programs of this machine need a code, too")
        }
        Admit::Anyone => {
            ("anyone", "Whoever reaches the port: sees the scene, takes the places of viewers, uses the GPU")
        }
    }
}

impl FromStr for AdmitArg {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let named = ADMITS.into_iter().find(|admit| of_admit(*admit).0 == name);
        named.ok_or_else(|| format!("\"{name}\" is none of paired, paired-only and anyone"))
    }
}

#[derive(Args)]
pub(crate) struct PairArgs {
    /// The six digits that the headset shows
    code: Code,
    #[command(flatten)]
    folder: FolderArgs,
}

#[derive(Args)]
struct FolderArgs {
    /// Folder of the server's key and its paired devices [default: the user's configuration folder]
    #[arg(long, global = true)]
    identity: Option<PathBuf>,
}

impl FolderArgs {
    fn folder(&self) -> anyhow::Result<PathBuf> {
        match &self.identity {
            Some(folder) => Ok(folder.clone()),
            None => Ok(default_directory()?),
        }
    }
}

#[derive(Args)]
pub(crate) struct DevicesArgs {
    #[command(subcommand)]
    action: Action,
    #[command(flatten)]
    folder: FolderArgs,
}

#[derive(Subcommand)]
enum Action {
    /// Lists the paired devices: name, rights, key
    List,
    /// Gives a device another name
    Rename {
        /// Its name, or the first eight or more digits of its key
        device: String,
        /// The new one
        name: String,
    },
    /// Says what a device may do; a running server follows within a second
    Allow {
        /// Its name, or the first eight or more digits of its key
        device: String,
        /// The most that it may do
        right: Right,
    },
    /// Forgets a device; it must be paired anew. A running server ends its session
    Forget {
        /// Its name, or the first eight or more digits of its key
        device: String,
    },
}

#[derive(Clone, Copy, ValueEnum)]
enum Right {
    /// See the scene
    Look,
    /// Also halt the world for all who look, and let it go on
    Halt,
}

/// `shadecast-server pair`.
///
/// # Errors
/// Nothing is paired; the error says why.
pub(crate) fn pair(args: &PairArgs) -> anyhow::Result<()> {
    let said = stream::pair(&args.folder.folder()?, &args.code.to_string().replace(' ', ""));
    note(&said.map_err(anyhow::Error::msg)?);
    Ok(())
}

/// `shadecast-server devices`.
///
/// # Errors
/// There is no such device, or the list cannot be read or written.
pub(crate) fn run(args: &DevicesArgs) -> anyhow::Result<()> {
    let mut known = KnownDevices::load(&args.folder.folder()?)?;
    match &args.action {
        Action::List => return list(&known),
        Action::Rename { device, name } => known.rename(device, name)?,
        Action::Allow { device, right: Right::Look } => known.allow(device, Rights::LOOK)?,
        Action::Allow { device, right: Right::Halt } => known.allow(device, Rights::ALL)?,
        Action::Forget { device } => drop(known.forget(device)?),
    }
    Ok(())
}

fn list(known: &KnownDevices) -> anyhow::Result<()> {
    let mut out = std::io::stdout();
    let longest = known.iter().map(|device| device.name.chars().count()).max().unwrap_or(0);
    for device in known.iter() {
        let (name, rights) = (printable(&device.name), device.rights.names().join(", "));
        writeln!(out, "{name:longest$}  {rights:10}  {}", device.fingerprint).context("writing the list")?;
    }
    Ok(())
}
