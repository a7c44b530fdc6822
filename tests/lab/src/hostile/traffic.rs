//! Recorded messages of a well-behaved client and a real server, as seeds for the fuzz targets of `tests/fuzz`. Inputs without
//! them are refused at the first bytes.

use crate::hostile::lawful::{self, Lawful, Recorded};
use crate::hostile::process::Server;
use crate::hostile::scene;
use anyhow::{Context, ensure};
use shadecast_fuzz::script::put_step;
use shadecast_fuzz::{client_session, decoder, deltas, messages, pictures, server_session};
use shadecast_protocol::limits::MAX_DATAGRAM_BYTES;
use shadecast_protocol::message::{ClientDatagram, ServerMessage};
use shadecast_protocol::picture::I420;
use shadecast_protocol::wire::{StreamMessage, encode_picture, frame_control, parse_stream};
use shadecast_server::encode::openh264::{EncoderSettings, OpenH264Encoder};
use shadecast_server::encode::{Encoder, Source, encode_one};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long the first picture may take.
const PATIENCE: Duration = Duration::from_secs(120);
/// Pictures that are recorded, from the first on.
const PICTURES: usize = 12;
/// Heads and pongs that are kept of each recording: they are all alike.
const DATAGRAMS: usize = 24;
/// Of an access unit this much is kept where nobody decodes it.
const UNIT_HEAD: usize = 48;
/// Extent of the pictures for the decoder: several blocks in each direction.
const CODED_EXTENT_TEXELS: [u32; 2] = [96, 64];

/// Serves a small scene for a moment, and writes a seed for each target into its folder under `out`.
///
/// # Errors
/// The server does not start or serve, or a file cannot be written.
pub fn record(out: &Path) -> anyhow::Result<()> {
    let work = std::env::temp_dir().join(format!("shadecast-traffic-{}", std::process::id()));
    std::fs::create_dir_all(&work)?;
    let traffic = converse(&work);
    let _ = std::fs::remove_dir_all(&work); // temporary files are nobody's loss
    let traffic = traffic?;
    for (target, seed) in seeds(&traffic)? {
        let folder = out.join(target);
        std::fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
        let path = folder.join("recorded");
        std::fs::write(&path, &seed).with_context(|| format!("writing {}", path.display()))?;
        println!("{}: {} bytes", path.display(), seed.len());
    }
    Ok(())
}

fn converse(work: &Path) -> anyhow::Result<Vec<Recorded>> {
    let scene = scene::write(work)?.display().to_string();
    let server = Server::start(&scene, &work.join("server"), "paired", PATIENCE.as_secs_f64() * 2.0)?;
    let mut hello = lawful::hello();
    hello.capabilities.max_vertex_slots = deltas::VERTEX_SLOTS;
    hello.capabilities.max_patch_slots = deltas::PATCH_SLOTS;
    let record = Arc::new(Mutex::new(Vec::new()));
    let client = Lawful::start_as(server.address, hello, Some(record.clone()))?;
    let deadline = Instant::now() + PATIENCE;
    while client.log().pictures.len() < PICTURES {
        ensure!(Instant::now() < deadline, "the server sent too few pictures: {:?}", client.log().ends);
        std::thread::sleep(Duration::from_millis(20));
    }
    client.leave();
    let traffic = record.lock().unwrap_or_else(PoisonError::into_inner).clone();
    Ok(traffic)
}

fn seeds(traffic: &[Recorded]) -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    Ok(vec![
        ("deltas", of_deltas(traffic)),
        ("client_session", of_client(traffic)),
        ("server_session", of_server(traffic)?),
        ("messages", of_messages(traffic)),
        ("framing", of_framing(traffic)),
        ("sps", access_units(traffic).next().context("no picture was recorded")?),
        ("pictures", of_pictures(traffic)),
        ("decoder", coded_pictures()?),
    ])
}

fn streams(traffic: &[Recorded]) -> impl Iterator<Item = (&[u8], StreamMessage<'_>)> {
    traffic.iter().filter_map(|it| match it {
        Recorded::ServerStream(bytes) => parse_stream(bytes).ok().map(|message| (&bytes[..], message)),
        _ => None,
    })
}

fn access_units(traffic: &[Recorded]) -> impl Iterator<Item = Vec<u8>> {
    streams(traffic).filter_map(|(_, message)| match message {
        StreamMessage::Picture { access_unit, .. } => Some(access_unit.to_vec()),
        _ => None,
    })
}

/// A stream as it was, but of a picture only its head and the first bytes.
fn shortened(bytes: &[u8]) -> Vec<u8> {
    match parse_stream(bytes) {
        Ok(StreamMessage::Picture { header, access_unit }) => {
            encode_picture(header, &access_unit[..access_unit.len().min(UNIT_HEAD)])
        }
        _ => bytes.to_vec(),
    }
}

fn of_deltas(traffic: &[Recorded]) -> Vec<u8> {
    let mut payloads: Vec<_> = streams(traffic)
        .filter_map(|(_, message)| match message {
            StreamMessage::Geometry { head, payload } => Some((head.sequence, payload)),
            _ => None,
        })
        .collect();
    payloads.sort_by_key(|(frame, _)| *frame);
    let mut script = Vec::new();
    payloads.iter().for_each(|(_, payload)| put_step(&mut script, deltas::DELTA, payload));
    script
}

fn of_client(traffic: &[Recorded]) -> Vec<u8> {
    let (mut script, mut datagrams) = (Vec::new(), 0);
    for it in traffic {
        match it {
            Recorded::ClientControl(message) if script.is_empty() => {
                put_step(&mut script, client_session::HELLO, message);
            }
            Recorded::ClientControl(message) => put_step(&mut script, client_session::OWN_MESSAGE, message),
            Recorded::ServerControl(message) => put_step(&mut script, client_session::CONTROL, message),
            Recorded::ServerStream(bytes) => {
                put_step(&mut script, client_session::STREAM, &shortened(bytes));
                put_step(&mut script, client_session::PONG, &2_000_u64.to_le_bytes());
            }
            Recorded::ClientDatagram(bytes) | Recorded::ServerDatagram(bytes) => {
                let own = matches!(it, Recorded::ClientDatagram(_));
                let operation = if own { client_session::OWN_DATAGRAM } else { client_session::DATAGRAM };
                if !script.is_empty() && datagrams < DATAGRAMS {
                    put_step(&mut script, operation, bytes);
                    datagrams += 1;
                }
            }
        }
    }
    script
}

fn of_server(traffic: &[Recorded]) -> anyhow::Result<Vec<u8>> {
    let is_welcome = |message: &[u8]| matches!(ServerMessage::decode(message), Ok(ServerMessage::Welcome(_)));
    let welcome = traffic.iter().find_map(|it| match it {
        Recorded::ServerControl(message) if is_welcome(message) => Some(message),
        _ => None,
    });
    let (mut script, mut datagrams) = (Vec::new(), 0);
    put_step(&mut script, server_session::WELCOME, welcome.context("no welcome was recorded")?);
    for it in traffic {
        match it {
            Recorded::ClientControl(message) => put_step(&mut script, server_session::CONTROL, message),
            Recorded::ClientDatagram(bytes) if datagrams < DATAGRAMS => {
                put_step(&mut script, server_session::DATAGRAM, bytes);
                datagrams += 1;
            }
            Recorded::ServerStream(bytes)
                if matches!(parse_stream(bytes), Ok(StreamMessage::Geometry { .. })) =>
            {
                put_step(&mut script, server_session::UPDATE, &[0; 4]);
            }
            _ => {}
        }
    }
    Ok(script)
}

fn of_messages(traffic: &[Recorded]) -> Vec<u8> {
    let (mut script, mut heads) = (Vec::new(), 0);
    for it in traffic {
        match it {
            Recorded::ClientControl(message) => put_step(&mut script, messages::CLIENT_MESSAGE, message),
            Recorded::ServerControl(message) => put_step(&mut script, messages::SERVER_MESSAGE, message),
            Recorded::ServerStream(bytes) if bytes.len() <= MAX_DATAGRAM_BYTES => {
                put_step(&mut script, messages::STREAM, &shortened(bytes));
            }
            Recorded::ServerStream(_) => {}
            Recorded::ClientDatagram(bytes) if heads < DATAGRAMS => {
                heads += usize::from(matches!(ClientDatagram::decode(bytes), Ok(ClientDatagram::Pose(_))));
                put_step(&mut script, messages::CLIENT_DATAGRAM, bytes);
            }
            Recorded::ServerDatagram(bytes) if heads < DATAGRAMS => {
                put_step(&mut script, messages::SERVER_DATAGRAM, bytes);
            }
            _ => {}
        }
    }
    script
}

fn of_framing(traffic: &[Recorded]) -> Vec<u8> {
    let mut stream = vec![6];
    stream.extend(frame_control(&[])); // opens the stream
    for it in traffic {
        if let Recorded::ClientControl(message) = it {
            stream.extend(frame_control(message));
        }
    }
    stream
}

/// The second picture comes late, and the fifth never.
fn of_pictures(traffic: &[Recorded]) -> Vec<u8> {
    let mut all: Vec<Vec<u8>> = streams(traffic)
        .filter(|(_, message)| matches!(message, StreamMessage::Picture { .. }))
        .map(|(bytes, _)| shortened(bytes))
        .collect();
    let mut script = Vec::new();
    if all.len() > 5 {
        all.swap(1, 2);
        all.remove(4);
    }
    for picture in &all {
        put_step(&mut script, pictures::PICTURE, picture);
        put_step(&mut script, pictures::WAIT, &30_000_u64.to_le_bytes());
    }
    put_step(&mut script, pictures::GIVEN_UP, &4_u32.to_le_bytes());
    put_step(&mut script, pictures::WAIT, &700_000_u64.to_le_bytes());
    script
}

/// Pictures of the embedded encoder: a pattern that moves, with a piece that changes at once, fine and coarse, and refreshes.
fn coded_pictures() -> anyhow::Result<Vec<u8>> {
    let mut encoder = OpenH264Encoder::new(EncoderSettings::new(CODED_EXTENT_TEXELS))?;
    let mut script = Vec::new();
    for (number, qp) in [26, 26, 38, 38, 20, 44, 30, 30, 51, 34, 24, 24].into_iter().enumerate() {
        encoder.set_qp(qp)?;
        let source = Source::Planes(moving_pattern(number as u32)?);
        let unit = encode_one(&mut encoder, source, number as i64 * 16_666_667, number == 7)?;
        put_step(&mut script, decoder::UNIT, &unit.bytes);
    }
    Ok(script)
}

/// Stripes of all slopes that move by 1 texel right and 2 down per picture, and a square of another pattern in each picture.
fn moving_pattern(number: u32) -> anyhow::Result<I420> {
    let [width, height] = CODED_EXTENT_TEXELS;
    let mut bytes = Vec::new();
    for (scale, width, height) in [(1, width, height), (2, width / 2, height / 2), (3, width / 2, height / 2)]
    {
        bytes.extend((0..width * height).map(|at| {
            let (x, y) = (at % width + 256 - number, at / width + 256 - 2 * number);
            let in_square = (at % width) / 16 == number % (width / 16) && (at / width) / 16 == 1;
            let pattern =
                if in_square { x * y * 5 } else { x * x / 40 * scale + y * 3 + (x / 24 + y / 20) * 60 };
            (pattern % 256) as u8
        }));
    }
    I420::new(CODED_EXTENT_TEXELS, bytes).context("making a pattern")
}
