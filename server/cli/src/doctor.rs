//! `shadecast-server doctor`: measures this machine as a server, and advises changes.

use crate::{DEFAULT_LISTEN, DEFAULT_RATE_HZ};
use anyhow::ensure;
use clap::Args;
use serde::Serialize;
use shadecast_gpu::limits::{Verdict, most_textures, verdicts};
use shadecast_gpu::{FoundDevice, Needs, survey};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::picture::I420;
use shadecast_protocol::text::with_causes;
use shadecast_server::encode::choice::{Kind, survey as encoders_here};
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::encode::{self, EncodeError, Source};
use shadecast_server::pacing::quality::DEFAULT_QP;
use shadecast_system::monotonic_now_ns;
use shadecast_transport::{SocketTrial, try_socket};
use std::fmt;
use std::net::SocketAddr;
use std::time::Instant;

/// Atlas sizes of the encoder trials, texels.
const EXTENTS: [[u32; 2]; 2] = [[2048, 2048], [4096, 2048]];
/// Pictures after the first one. Their median counts.
const PICTURES: usize = 8;
/// Inverse of the part of a picture that changes from one picture to the next: a third, in bands.
const CHANGES: usize = 3;
/// Readings of the clock. The smallest step counts.
const CLOCK_LOOKS: usize = 10_000;

/// Options of `doctor`.
#[derive(Args)]
pub(crate) struct DoctorArgs {
    /// UDP address of a server
    #[arg(long, default_value = DEFAULT_LISTEN)]
    listen: SocketAddr,
    /// Part of the Vulkan device's name
    #[arg(long)]
    device: Option<String>,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// A Vulkan device.
#[derive(Clone, Debug, Serialize)]
struct Device {
    name: String,
    kind: &'static str,
    vulkan: String,
    memory_mb: u64,
    /// Missing requirements.
    lacks: Option<String>,
    limits: Vec<Limit>,
    /// Most textures of a scene.
    most_textures: u32,
    has_two_queues: bool,
    /// A server would use it.
    is_chosen: bool,
    #[serde(skip)]
    is_cpu: bool,
}

/// A device limit that a server relies on.
#[derive(Clone, Debug, Serialize)]
struct Limit {
    name: &'static str,
    needed: u32,
    offered: u32,
}

impl From<Verdict> for Limit {
    fn from(Verdict { name, needed, offered }: Verdict) -> Self {
        Self { name, needed, offered }
    }
}

/// Times of an encoder at one picture size.
#[derive(Clone, Debug, Serialize)]
struct EncoderTrial {
    encoder: &'static str,
    extent_texels: [u32; 2],
    /// Time of the first picture, an IDR picture, in milliseconds.
    first_ms: f64,
    /// Median time of a later picture in milliseconds.
    next_ms: f64,
}

/// An encoder that does not work here.
#[derive(Clone, Debug, Serialize)]
struct NoEncoder {
    encoder: &'static str,
    reason: String,
}

/// A socket, or the reason for its absence.
#[derive(Clone, Debug, Serialize)]
struct Udp {
    address: SocketAddr,
    buffer_kib: Option<[usize; 2]>,
    wanted_kib: Option<usize>,
    error: Option<String>,
}

/// Findings about this machine.
#[derive(Clone, Debug, Serialize)]
struct Findings {
    devices: Vec<Device>,
    /// Reason for the absence of devices.
    no_devices: Option<String>,
    /// Best first.
    encoders: Vec<EncoderTrial>,
    no_encoders: Vec<NoEncoder>,
    udp: Udp,
    /// Smallest observed step of the clock in nanoseconds.
    clock_step_ns: i64,
    /// Advised changes, the most urgent first.
    advice: Vec<String>,
    /// A server could start.
    can_serve: bool,
}

/// Examines the machine and prints the findings.
///
/// # Errors
/// A server could not start here.
pub(crate) fn doctor(args: &DoctorArgs) -> anyhow::Result<()> {
    let mut findings = look(args)?;
    findings.advice = advice(&findings, args.device.as_deref());
    findings.can_serve =
        findings.devices.iter().any(|device| device.is_chosen) && findings.udp.error.is_none();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&findings)?);
    } else {
        print!("{findings}");
    }
    ensure!(findings.can_serve, "a server cannot start on this machine; follow the advice above");
    Ok(())
}

fn look(args: &DoctorArgs) -> anyhow::Result<Findings> {
    let (devices, no_devices) = match survey(Needs::Server) {
        Ok(found) => (chosen(found, args.device.as_deref()), None),
        Err(error) => (Vec::new(), Some(error.to_string())),
    };
    let (encoders, no_encoders) = try_encoders(encoders_here());
    let udp = match try_socket(args.listen) {
        Ok(SocketTrial { buffer_bytes, wanted_bytes }) => Udp {
            address: args.listen,
            buffer_kib: Some(buffer_bytes.map(|bytes| bytes >> 10)),
            wanted_kib: Some(wanted_bytes >> 10),
            error: None,
        },
        Err(error) => {
            Udp { address: args.listen, buffer_kib: None, wanted_kib: None, error: Some(with_causes(&error)) }
        }
    };
    let clock_step_ns = clock_step_ns();
    let (advice, can_serve) = (Vec::new(), false);
    Ok(Findings { devices, no_devices, encoders, no_encoders, udp, clock_step_ns, advice, can_serve })
}

/// Marks the device that a server would use: the best one that lacks nothing.
fn chosen(found: Vec<FoundDevice>, wanted: Option<&str>) -> Vec<Device> {
    let best = found.iter().position(|device| device.is_usable(wanted));
    let devices = found.into_iter().enumerate();
    devices
        .map(|(index, device)| Device {
            name: device.name,
            kind: device.kind,
            vulkan: format!("{}.{}", device.vulkan_version[0], device.vulkan_version[1]),
            memory_mb: device.memory_bytes / 1_000_000,
            lacks: device.lacks,
            limits: verdicts(&device.limits, Needs::Server).into_iter().map(Limit::from).collect(),
            most_textures: most_textures(&device.limits),
            has_two_queues: device.has_two_queues,
            is_chosen: Some(index) == best,
            is_cpu: device.is_cpu,
        })
        .collect()
}

/// Divides the encoders into those that work and the others. An encoder may work for small pictures only.
fn try_encoders(all: Vec<(Kind, Result<(), String>)>) -> (Vec<EncoderTrial>, Vec<NoEncoder>) {
    let (mut encoders, mut no_encoders) = (Vec::new(), Vec::new());
    for (kind, tried) in all {
        let mut no = |reason| no_encoders.push(NoEncoder { encoder: kind.name, reason });
        if let Err(reason) = tried {
            no(reason);
            continue;
        }
        for extent_texels in EXTENTS {
            let [width, height] = extent_texels;
            match try_encoder(&kind, extent_texels) {
                Ok(trial) => encoders.push(trial),
                Err(error) => no(format!("at {width}x{height}: {error}")),
            }
        }
    }
    (encoders, no_encoders)
}

/// Encodes painted noise. A third of it changes from picture to picture.
fn try_encoder(kind: &Kind, extent_texels: [u32; 2]) -> Result<EncoderTrial, EncodeError> {
    let extent = AtlasExtent::new(extent_texels[0], extent_texels[1]).expect("an atlas's extent");
    let settings = EncoderSettings::for_stream(extent, DEFAULT_QP, DEFAULT_RATE_HZ);
    let mut encoder = kind.encoder(settings)?;
    let mut took_ms = Vec::with_capacity(PICTURES + 1);
    for index in 0..=PICTURES {
        let picture = Source::Planes(painted(extent_texels, index));
        let began = Instant::now();
        encode::encode_one(&mut *encoder, picture, index as i64 * 33_333_333, index == 0)?;
        took_ms.push(began.elapsed().as_secs_f64() * 1e3);
    }
    let first_ms = took_ms.remove(0);
    took_ms.sort_by(f64::total_cmp);
    Ok(EncoderTrial { encoder: kind.name, extent_texels, first_ms, next_ms: took_ms[PICTURES / 2] })
}

/// Blocks of 16x16 texels, alternately smooth and rough. Every third row of blocks differs from the previous picture.
fn painted(extent_texels: [u32; 2], index: usize) -> I420 {
    let [width, height] = extent_texels.map(|side| side as usize);
    let texel = |x: usize, y: usize| {
        let block = [x / 16, y / 16];
        let version = index + (CHANGES - 1 - (block[1] + index) % CHANGES);
        let seed = hash([block[0], block[1], version / CHANGES]);
        let (base, slope, rough) = (seed & 127, seed >> 7 & 3, seed >> 9 & 15);
        (48 + base + slope * (x % 16) + rough * (hash([x, y, seed]) & 1)) as u8
    };
    let mut bytes = vec![128; width * height * 3 / 2];
    for (y, row) in bytes[..width * height].chunks_exact_mut(width).enumerate() {
        row.iter_mut().enumerate().for_each(|(x, byte)| *byte = texel(x, y));
    }
    I420::new(extent_texels, bytes).expect("planes of this extent")
}

/// A few pseudo-random bits.
fn hash(of: [usize; 3]) -> usize {
    let mixed = of
        .into_iter()
        .fold(0x9e37_79b9_u32, |mixed, word| (mixed ^ word as u32).wrapping_mul(0x85eb_ca6b).rotate_left(13));
    (mixed ^ mixed >> 15) as usize
}

fn clock_step_ns() -> i64 {
    let looks: Vec<i64> = (0..CLOCK_LOOKS).map(|_| monotonic_now_ns()).collect();
    let steps = looks.windows(2).map(|pair| pair[1] - pair[0]);
    steps.filter(|step| *step > 0).min().unwrap_or(0)
}

/// Advised changes, the most urgent first.
fn advice(findings: &Findings, wanted: Option<&str>) -> Vec<String> {
    let mut advice = Vec::new();
    advice.extend(findings.no_devices.clone());
    match findings.devices.iter().find(|device| device.is_chosen) {
        None if findings.no_devices.is_none() => advice.push(match wanted {
            Some(wanted) => format!("no usable device has \"{wanted}\" in its name: leave --device out, or name a device listed above"),
            None => "no device meets all requirements: install a newer driver, or Mesa's software device (package mesa-vulkan-drivers)".into(),
        }),
        Some(device) if device.is_cpu => advice.push(
            "the device is a CPU: pictures are correct, but slow; install the Vulkan driver of the graphics card, if there is one".into(),
        ),
        _ => {}
    }
    advice.extend(findings.udp.error.clone());
    if findings.udp.error.is_none() && findings.udp.address.ip().is_loopback() {
        advice.push(format!(
            "{} is reachable from this machine only: a headset needs --listen 0.0.0.0:{}",
            findings.udp.address,
            findings.udp.address.port()
        ));
    }
    if let (Some([receive, send]), Some(wanted)) = (findings.udp.buffer_kib, findings.udp.wanted_kib)
        && receive.min(send) < wanted
    {
        let bytes = wanted << 10;
        advice.push(format!(
            "socket buffers are limited to {receive} and {send} KiB; {wanted} KiB are recommended: fast links may lose bursts{}",
            if cfg!(unix) {
                format!("; sysctl -w net.core.rmem_max={bytes} net.core.wmem_max={bytes}")
            } else {
                String::new()
            }
        ));
    }
    let period_ms = 1e3 / DEFAULT_RATE_HZ;
    // A server would use the first one.
    let used = findings.encoders.first().map(|trial| trial.encoder);
    let trials = findings.encoders.iter().filter(|trial| Some(trial.encoder) == used);
    if let Some(slow) = trials.into_iter().find(|trial| trial.next_ms > period_ms) {
        let [width, height] = slow.extent_texels;
        advice.push(format!(
            "{} takes {:.0} ms for a picture of {width}x{height}: at most {:.0} updates a second with this atlas; choose a \
             smaller atlas with --atlas, or a lower rate with --rate",
            slow.encoder,
            slow.next_ms,
            1e3 / slow.next_ms
        ));
    }
    advice
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Vulkan devices")?;
        for device in &self.devices {
            let Device { name, kind, vulkan, memory_mb, .. } = device;
            let verdict = match &device.lacks {
                Some(what) => format!("lacks {what}"),
                None if device.is_chosen => "would be used".into(),
                None => "could be used".into(),
            };
            let queues = if device.has_two_queues { "two queues" } else { "one queue" };
            writeln!(f, "  {name}: {kind}, Vulkan {vulkan}, {memory_mb} MB, {queues}: {verdict}")?;
            let is_shown = |limit: &&Limit| device.is_chosen || limit.offered < limit.needed;
            for Limit { name, needed, offered } in device.limits.iter().filter(is_shown) {
                writeln!(f, "    {name}: {needed} needed, {offered} offered")?;
            }
            if device.is_chosen {
                writeln!(f, "    textures of a scene: at most {}", device.most_textures)?;
            }
        }
        if let Some(error) = &self.no_devices {
            writeln!(f, "  none: {error}")?;
        }
        writeln!(
            f,
            "Encoders, milliseconds for the first and for each later picture (painted noise, a third changes)"
        )?;
        for EncoderTrial { encoder, extent_texels: [width, height], first_ms, next_ms } in &self.encoders {
            writeln!(f, "  {encoder}, {width}x{height}: {first_ms:.1}, {next_ms:.1}")?;
        }
        for NoEncoder { encoder, reason } in &self.no_encoders {
            writeln!(f, "  {encoder}: none: {reason}")?;
        }
        if !cfg!(feature = "libavcodec") {
            writeln!(f, "  others: not built in; --features libavcodec adds hardware encoders and libx264")?;
        }
        writeln!(f, "UDP")?;
        match (&self.udp.error, self.udp.buffer_kib) {
            (None, Some([receive, send])) => {
                writeln!(f, "  {} is free; buffers of {receive} and {send} KiB", self.udp.address)?
            }
            (error, _) => writeln!(f, "  {}", error.as_deref().unwrap_or("not tried"))?,
        }
        writeln!(f, "Clock\n  monotonic, steps of {} ns", self.clock_step_ns)?;
        if self.advice.is_empty() {
            return writeln!(f, "No changes needed");
        }
        writeln!(f, "Advice")?;
        self.advice.iter().try_for_each(|line| writeln!(f, "  - {line}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_server::encode::{Encoded, Encoder};
    use std::sync::Arc;
    use std::time::Duration;

    /// Takes no picture.
    struct Refuses(Vec<Source>);

    impl Encoder for Refuses {
        fn submit(&mut self, source: Source, _: i64, _: bool) {
            self.0.push(source);
        }

        fn poll(&mut self, _: Duration) -> Option<Encoded> {
            self.0.pop().map(|source| Encoded { source, result: Err(EncodeError::Stalled) })
        }

        fn set_qp(&mut self, _: u8) -> Result<(), EncodeError> {
            Ok(())
        }
    }

    #[test]
    fn an_encoder_that_fails_with_large_pictures_is_reported() {
        let refuses =
            Kind::new("h264_amf", Arc::new(|_| Ok(Box::new(Refuses(Vec::new())) as Box<dyn Encoder>)));
        let all = vec![(refuses, Ok(()))];
        let (measured, others) = try_encoders(all);
        assert!(measured.is_empty());
        let told: Vec<_> = others.iter().map(|no| (no.encoder, no.reason.as_str())).collect();
        let [(_, first), (_, second)] = told[..] else { panic!("{told:?}") };
        assert!(first.starts_with("at 2048x2048: ") && second.starts_with("at 4096x2048: "), "{told:?}");
    }

    fn healthy() -> Findings {
        let device = Device {
            name: "A GPU".into(),
            kind: "discrete GPU",
            vulkan: "1.3".into(),
            memory_mb: 8000,
            lacks: None,
            limits: vec![Limit { name: "maxPushConstantsSize", needed: 80, offered: 128 }],
            most_textures: 63,
            has_two_queues: true,
            is_chosen: true,
            is_cpu: false,
        };
        let trial = |extent_texels| EncoderTrial {
            encoder: "openh264",
            extent_texels,
            first_ms: 20.0,
            next_ms: 10.0,
        };
        let udp = Udp {
            address: "0.0.0.0:7400".parse().expect("an address"),
            buffer_kib: Some([8192, 8192]),
            wanted_kib: Some(4096),
            error: None,
        };
        Findings {
            devices: vec![device],
            no_devices: None,
            encoders: EXTENTS.map(trial).to_vec(),
            no_encoders: Vec::new(),
            udp,
            clock_step_ns: 30,
            advice: Vec::new(),
            can_serve: true,
        }
    }

    #[track_caller]
    fn advises(findings: &Findings, wanted: Option<&str>, parts: &[&str]) {
        let text = advice(findings, wanted).join("\n");
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
    }

    #[test]
    fn a_healthy_machine_needs_no_changes() {
        assert_eq!(advice(&healthy(), None), Vec::<String>::new());
        assert!(healthy().to_string().contains("No changes needed"));
    }

    #[test]
    fn limits_are_shown_where_used_or_too_low() {
        let mut findings = healthy();
        let text = findings.to_string();
        assert!(text.contains("maxPushConstantsSize: 80 needed, 128 offered"), "{text}");
        assert!(text.contains("textures of a scene: at most 63"), "{text}");
        findings.devices[0].is_chosen = false;
        assert!(!findings.to_string().contains("maxPushConstantsSize"));
        findings.devices[0].limits[0].offered = 64;
        assert!(findings.to_string().contains("maxPushConstantsSize: 80 needed, 64 offered"));
    }

    #[test]
    fn each_fault_has_its_remedy() {
        let mut slow = healthy();
        slow.encoders[1].next_ms = 50.0;
        advises(&slow, None, &["50 ms", "4096x2048", "at most 20 updates", "--atlas", "--rate"]);
        let mut narrow = healthy();
        narrow.udp.buffer_kib = Some([208, 208]);
        advises(&narrow, None, &["208", "4096", "net.core.rmem_max=4194304"]);
        let mut local = healthy();
        local.udp.address = "127.0.0.1:7777".parse().expect("an address");
        advises(&local, None, &["--listen 0.0.0.0:7777"]);
        let mut cpu = healthy();
        cpu.devices[0].is_cpu = true;
        advises(&cpu, None, &["is a CPU", "Vulkan driver"]);
        let mut none = healthy();
        none.devices[0].is_chosen = false;
        advises(&none, Some("Radeon"), &["Radeon", "--device"]);
        advises(&none, None, &["newer driver"]);
    }

    #[test]
    fn a_third_of_the_painted_picture_changes_each_time() {
        for index in 1..4 {
            let [before, after] = [index - 1, index].map(|index| painted([512, 480], index));
            let pairs =
                before.planes()[0].chunks_exact(512 * 16).zip(after.planes()[0].chunks_exact(512 * 16));
            let changed = pairs.filter(|(a, b)| a != b).count();
            assert_eq!(changed, 480 / 16 / CHANGES, "picture {index}");
        }
    }
}
