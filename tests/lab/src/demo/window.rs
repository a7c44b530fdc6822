//! `shadecast-lab demo --window`: a server and a window on it, for users without headset and simulator.

use crate::process::{PATIENCE, Running, free_address, program};
use anyhow::{Context, ensure};
use shadecast_scene::load::SceneSource;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The server ends by itself where nobody closes the window, seconds.
const LONGEST_S: f64 = 12.0 * 3600.0;

/// What to show.
#[derive(Clone, Debug)]
pub struct DemoWindowOptions {
    /// Scene.
    pub scene: SceneSource,
    /// Folder for what comes out.
    pub out: PathBuf,
    /// Pixels of each eye, and of the window at first.
    pub extent_pixels: [u32; 2],
    /// Closes the window after so many seconds.
    pub seconds: Option<f64>,
    /// Validation layers in both processes.
    pub validation: bool,
}

/// Streams into a window until it is closed; leaves what it showed last, and what both counted, in `options.out`.
///
/// # Errors
/// A program is missing, fails or finds no desktop.
pub fn demo_window(options: &DemoWindowOptions) -> anyhow::Result<()> {
    let out = std::path::absolute(&options.out)?;
    std::fs::create_dir_all(&out).with_context(|| format!("making {}", out.display()))?;
    let address = free_address()?.to_string();
    let mut server = Command::new(program("shadecast-server")?);
    server.args(["stream", &options.scene.to_string(), "--listen", &address]);
    server.arg("--identity").arg(out.join("server-identity")).arg("--stats").arg(out.join("server.json"));
    server.args(["--seconds", &LONGEST_S.to_string()]);
    let [width, height] = options.extent_pixels;
    let mut client = Command::new(program("shadecast-client")?);
    client.args(["--window", "--connect", &address, "--size", &format!("{width}x{height}")]);
    client.arg("--identity").arg(out.join("client-identity")).arg("--stats").arg(out.join("client.json"));
    client.arg("--screenshot").arg(out.join("window.png"));
    if let Some(seconds) = options.seconds {
        client.args(["--seconds", &seconds.to_string()]);
    }
    if options.validation {
        server.arg("--validation");
        client.arg("--validation");
    }
    let mut server = Running::start("shadecast-server", server.stdout(Stdio::piped()))?;
    server.says("Listening")?;
    println!("Drag to look around, WASD and QE walk, B shows both eyes, F figures, R goes back, Esc ends");
    let mut client = Running::start("shadecast-client", client.stdout(Stdio::null()))?;
    while client.is_running()? {
        ensure!(server.is_running()?, "{} ended early; its messages are above", server.name);
        std::thread::sleep(Duration::from_millis(100));
    }
    client.wait(Instant::now() + PATIENCE)?;
    server.interrupt()?;
    server.wait(Instant::now() + PATIENCE)?;
    println!("What the window showed last: {}", out.join("window.png").display());
    Ok(())
}
