//! A minimal X client that acts as a window's user: it focuses the window and presses keys (X11R7 protocol and the XTEST
//! extension, version 2.2). Keys are evdev's numbers plus 8, as on Linux servers.

use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::Duration;

/// F.
pub const KEY_F: u8 = 33 + 8;
/// B.
pub const KEY_B: u8 = 48 + 8;
/// D.
pub const KEY_D: u8 = 32 + 8;
/// Escape.
pub const KEY_ESCAPE: u8 = 1 + 8;

const CONFIGURE_WINDOW: u8 = 12;
const QUERY_TREE: u8 = 15;
const SET_INPUT_FOCUS: u8 = 42;
const GET_INPUT_FOCUS: u8 = 43;
const QUERY_EXTENSION: u8 = 98;
const FAKE_INPUT: u8 = 2;
const KEY_PRESS: u8 = 2;
const KEY_RELEASE: u8 = 3;

/// A client without windows.
pub struct Connection {
    stream: UnixStream,
    root: u32,
    xtest: u8,
}

impl Connection {
    /// To a display of this machine that asks for no authorisation.
    pub fn open(display: u32) -> io::Result<Self> {
        let mut stream = UnixStream::connect(format!("/tmp/.X11-unix/X{display}"))?;
        stream.set_read_timeout(Some(Duration::from_secs(20)))?;
        stream.write_all(&[b'l', 0, 11, 0, 0, 0, 0, 0, 0, 0, 0, 0])?;
        let mut head = [0; 8];
        stream.read_exact(&mut head)?;
        assert_eq!(head[0], 1, "the display refuses the connection");
        let mut setup = vec![0; usize::from(u16::from_le_bytes([head[6], head[7]])) * 4];
        stream.read_exact(&mut setup)?;
        // After 32 bytes the vendor's name, padded, the pixmap formats of 8 bytes each, and the first screen.
        let vendor = usize::from(u16::from_le_bytes([setup[16], setup[17]])).next_multiple_of(4);
        let screen = 32 + vendor + usize::from(setup[21]) * 8;
        let root = word(&setup, screen);
        let mut connection = Self { stream, root, xtest: 0 };
        let mut name = vec![5, 0, 0, 0];
        name.extend(b"XTEST\0\0\0");
        let reply = connection.ask(QUERY_EXTENSION, 0, &name)?;
        assert_eq!(reply[8], 1, "the display has XTEST");
        connection.xtest = reply[9];
        Ok(connection)
    }

    /// Gives the keyboard to the last visible window.
    pub fn focus(&mut self) -> io::Result<()> {
        for window in self.windows()? {
            // Windows that are not visible answer with an error, which `ask` skips.
            self.send(SET_INPUT_FOCUS, 1, &[window.to_le_bytes(), [0; 4]].concat())?;
        }
        self.sync()
    }

    /// Makes all windows so large, as a user who drags their corners.
    pub fn resize(&mut self, [width, height]: [u32; 2]) -> io::Result<()> {
        const WIDTH_AND_HEIGHT: u32 = 4 | 8;
        for window in self.windows()? {
            let body = [window, WIDTH_AND_HEIGHT, width, height].map(u32::to_le_bytes).concat();
            self.send(CONFIGURE_WINDOW, 0, &body)?;
        }
        self.sync()
    }

    fn windows(&mut self) -> io::Result<Vec<u32>> {
        let tree = self.ask(QUERY_TREE, 0, &self.root.to_le_bytes())?;
        let children = usize::from(u16::from_le_bytes([tree[16], tree[17]]));
        Ok((0..children).map(|child| word(&tree, 32 + child * 4)).collect())
    }

    /// Returns when the display has done all that was sent: it answers in order.
    fn sync(&mut self) -> io::Result<()> {
        self.ask(GET_INPUT_FOCUS, 0, &[]).map(|_| ())
    }

    /// Presses a key and lets it go.
    pub fn press(&mut self, key: u8) -> io::Result<()> {
        self.hold(key)?;
        self.let_go(key)
    }

    /// Presses a key.
    pub fn hold(&mut self, key: u8) -> io::Result<()> {
        self.fake(KEY_PRESS, key)
    }

    /// Lets a key go.
    pub fn let_go(&mut self, key: u8) -> io::Result<()> {
        self.fake(KEY_RELEASE, key)
    }

    fn fake(&mut self, kind: u8, key: u8) -> io::Result<()> {
        let mut event = vec![0; 32];
        (event[0], event[1]) = (kind, key);
        self.send(self.xtest, FAKE_INPUT, &event)?;
        self.sync()
    }

    fn send(&mut self, opcode: u8, data: u8, body: &[u8]) -> io::Result<()> {
        let words = (1 + body.len() / 4) as u16;
        let [low, high] = words.to_le_bytes();
        self.stream.write_all(&[&[opcode, data, low, high], body].concat())
    }

    fn ask(&mut self, opcode: u8, data: u8, body: &[u8]) -> io::Result<Vec<u8>> {
        self.send(opcode, data, body)?;
        loop {
            let mut reply = vec![0; 32];
            self.stream.read_exact(&mut reply)?;
            if reply[0] == 1 {
                let mut rest = vec![0; word(&reply, 4) as usize * 4];
                self.stream.read_exact(&mut rest)?;
                reply.extend(rest);
                return Ok(reply);
            }
        }
    }
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}
