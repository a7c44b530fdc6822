//! The test's own display: Xvfb, with a file as its screen.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

/// A display, ended by its pid.
pub struct Display {
    child: Child,
    number: u32,
    folder: tempfile::TempDir,
}

impl Display {
    /// Starts one with a screen of so many pixels.
    pub fn start(screen: [u32; 2]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut command = Command::new("Xvfb");
        command.args([
            "-displayfd",
            "1",
            "-screen",
            "0",
            &format!("{}x{}x24", screen[0], screen[1]),
            "-nolisten",
            "tcp",
            "-fbdir",
        ]);
        command.arg(folder.path()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().expect("Xvfb; `./shadecast setup` installs it (package xvfb)");
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        Self { child, number: line.trim().parse().expect("Xvfb says its number"), folder }
    }

    /// What `DISPLAY` must say.
    pub fn name(&self) -> String {
        format!(":{}", self.number)
    }

    /// Its number.
    pub fn number(&self) -> u32 {
        self.number
    }

    /// What is on the screen, 4 bytes a pixel: the pixels of the frame buffer file, which is an X window dump.
    pub fn screen(&self) -> Vec<u8> {
        let dump = std::fs::read(self.folder.path().join("Xvfb_screen0")).unwrap();
        let word = |i: usize| u32::from_be_bytes(dump[i * 4..][..4].try_into().unwrap()) as usize;
        // XWDFile.h: the header's size, and 19 colours of 12 bytes each.
        dump[word(0) + word(19) * 12..].to_vec()
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// How many different colours a screen has.
pub fn colours(screen: &[u8]) -> usize {
    screen.chunks_exact(4).collect::<BTreeSet<&[u8]>>().len()
}
