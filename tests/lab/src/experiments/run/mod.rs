//! `shadecast-lab run`: one run in virtual time, measured and recorded.
//!
//! Options enter ([`RunOptions`]). Pictures leave, `stats.json`, and a report. Nothing here knows the question behind the run.

mod forward;
mod video;

use crate::image::Rgb8Image;
use crate::measure::compare::{Comparer, Shown};
use crate::measure::metrics::{FrameMetrics, ProbeView, psnr_db};
use crate::measure::motion::{Motion, MotionReport};
use crate::report::sheet::{Sheet, difference};
use crate::report::stats::{Counted, MbitPerS, Stats, Summary, messages_of_both};
use crate::session::options::{Head, Renderer, RunOptions};
use crate::session::runtime::BUILT_IN_WALK;
use crate::session::seat::Sent;
use crate::session::{Lab, SERVER_EPOCH_NS, START_NS, Server};
use anyhow::{Context, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, FovDegrees, MockConfig};
use shadecast_mock_runtime::head_path::COLUMNS;
use shadecast_mock_runtime::record::{FrameRecord, Side, picture_path, read_frames};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::{ServerTime, WorldTime};
use shadecast_scene::HeadPath;
use shadecast_scene::load::load_head_path;
use shadecast_server::encode::Source;
use std::path::{Path, PathBuf};

/// What a run leaves behind, beside its files.
#[derive(Clone, Debug)]
pub struct Report {
    /// As in `stats.json`.
    pub stats: Stats,
    /// Display frames shown with a bundle.
    pub frames_with_bundle: u64,
    /// Display frames before the first bundle.
    pub frames_before_first_bundle: u64,
    /// Calls that the OpenXR runtime refused.
    pub runtime_errors: u64,
    /// How vertices moved, where that was asked for.
    pub motion: Option<MotionReport>,
    /// What was on display in the frames that were compared, and when.
    pub compared: Vec<(UpdateId, WorldTime)>,
    /// How far each of these was from the truth.
    pub looks: Vec<Look>,
}

/// What a display frame showed, the worse of both eyes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Its number: the first is 0.
    pub frame: u64,
    /// Part of the truth's geometry that is missing, 0..1.
    pub holes: f64,
    /// The same of what is animated, where there is enough of it.
    pub animated_holes: Option<f64>,
    /// Distance from the truth, 0..1, where there is enough to see.
    pub flip: Option<f64>,
}

impl Look {
    /// Of the frame's eyes, as they were measured.
    pub(super) fn of(frame: u64, eyes: &[FrameMetrics]) -> Self {
        let most = |of: fn(&FrameMetrics) -> Option<f64>| eyes.iter().filter_map(of).reduce(f64::max);
        Self {
            frame,
            holes: most(|eye| Some(eye.holes.strict)).unwrap_or(0.0),
            animated_holes: most(|eye| eye.animated.picture.map(|_| eye.animated.holes.strict)),
            flip: most(|eye| eye.picture.map(|picture| picture.flip)),
        }
    }
}

/// Takes in how much errors changed, where the last look, at `last`, was at the frame before.
pub(super) fn add_flicker(
    summary: &mut Summary,
    looks: &[Look],
    last: Option<&[[Rgb8Image; 2]; 2]>,
    frame: u64,
    now: &[[Rgb8Image; 2]; 2],
) {
    let follows = looks.last().is_some_and(|look| look.frame + 1 == frame);
    if let Some(before) = last.filter(|_| follows) {
        summary.add_flicker(before, now);
    }
}

/// The mock runtime's configuration for a run.
pub fn mock_config(options: &RunOptions, clock: ClockKind, capture_every: u32) -> anyhow::Result<MockConfig> {
    let half = options.fov_degrees * 0.5;
    let head_path = match &options.head {
        Head::File(path) => {
            std::fs::metadata(path).with_context(|| format!("head path {}", path.display()))?;
            std::path::absolute(path)?
        }
        Head::Walk => write_head_path(options, "walk.csv", BUILT_IN_WALK)?,
        Head::Named(name) => {
            let path = load_head_path(&options.scene, name)?;
            let text = head_path_csv(&path, options.seconds, options.refresh_hz);
            write_head_path(options, "head.csv", &text)?
        }
    };
    Ok(MockConfig {
        extent_pixels: options.extent_pixels,
        fov_degrees: FovDegrees { left: half, right: half, up: half, down: half },
        refresh_hz: options.refresh_hz,
        clock,
        virtual_start_ns: START_NS,
        head_path: Some(head_path),
        seconds: options.seconds,
        capture_dir: Some(std::path::absolute(options.out.join("capture"))?),
        capture_every,
        ..MockConfig::default()
    })
}

fn write_head_path(options: &RunOptions, file: &str, text: &str) -> anyhow::Result<PathBuf> {
    std::fs::create_dir_all(&options.out).with_context(|| format!("making {}", options.out.display()))?;
    let path = options.out.join(file);
    shadecast_system::write_atomically(&path, text.as_bytes())
        .with_context(|| format!("writing {}", path.display()))?;
    Ok(std::path::absolute(path)?)
}

/// Rows of a head path per display frame: what the mock runtime interpolates linearly between them is no rounder.
const ROWS_PER_FRAME: f64 = 4.0;

/// A head path of the scene as the mock runtime reads it, time 0 of one being time 0 of the other; a second longer
/// than the run, since poses are also asked for ahead of time.
fn head_path_csv(path: &HeadPath, seconds: f64, refresh_hz: f64) -> String {
    let rate_hz = refresh_hz * ROWS_PER_FRAME;
    let mut text = format!("{COLUMNS}\n");
    for row in 0..=((seconds + 1.0) * rate_hz).ceil() as u32 {
        let t_s = f64::from(row) / rate_hz;
        let Pose { position: p, orientation: q } = path.stage_from_head(t_s);
        text += &format!("{t_s:.9},{},{},{},{},{},{},{}\n", p.x, p.y, p.z, q.x, q.y, q.z, q.w);
    }
    text
}

/// What compares with the truth as a run's options say.
pub(crate) fn comparer(server: &Server, options: &RunOptions) -> anyhow::Result<Comparer> {
    Comparer::with_places(&server.gpu, &server.scene, options.extent_pixels, options.truth_places)
}

/// Runs and measures; writes `stats.json`, the contact sheet and the dumped pictures into `options.out`. The forward renderer
/// writes its pictures alone.
///
/// # Errors
/// Anything that keeps the run from going on: no device, no runtime, a file.
pub fn run(options: &RunOptions) -> anyhow::Result<Report> {
    let capture_every = match (options.compare_pairs, options.dump_every) {
        (true, _) => 1,
        (false, 0) => options.compare_every,
        (false, dump_every) => dump_every,
    };
    let capture = options.out.join("capture");
    clear(&capture)?;
    let config = mock_config(options, ClockKind::Virtual, capture_every)?;
    if options.renderer == Renderer::Forward {
        return forward::run(options, &config);
    }
    let frames = (options.seconds * options.refresh_hz).round() as u64;
    let from = options.compare_from;
    ensure!(
        from < frames,
        "comparing from display frame {from} on: the run has {frames}; give it more seconds"
    );
    if options.renderer == Renderer::Video {
        return video::run(options, &config);
    }
    // SAFETY: this is called from the main thread of the program, or from tests that hold the lab's lock, before the
    // client's threads start.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let comparer = comparer(&lab.server, options)?;
    let mut comparer = comparer.with_true_outlines(options.spared.outlines);
    let mut run = Run {
        options,
        capture,
        frame: 0,
        sent_before: Sent::default(),
        summary: Summary::default(),
        with_bundle: 0,
        before: 0,
        last: None,
        motion: Motion::default(),
        clock_errors_ms: Vec::new(),
        compared: Vec::new(),
        looks: Vec::new(),
    };
    let bar = progress(options.verbose, frames);
    while let Step::Frame(shown) = lab.step()? {
        let time = ServerTime(shown.display_time.0 - SERVER_EPOCH_NS);
        if options.motion {
            let world_time = lab.server.world_time(shown.display_time.0);
            run.motion.look(&mut lab, &shown, world_time)?;
        }
        if let (Some(_), Some(estimate)) = (shown.update, shown.server_time) {
            run.clock_errors_ms.push(estimate.since(time) as f64 * 1e-6);
        }
        run.look(&mut lab, &mut comparer, shown.update)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    run.finish(&lab)
}

/// Takes away the pictures of a run before.
pub(super) fn clear(capture: &Path) -> anyhow::Result<()> {
    if capture.exists() {
        std::fs::remove_dir_all(capture).with_context(|| format!("clearing {}", capture.display()))?;
    }
    Ok(())
}

/// A bar that is only seen where it is asked for.
pub fn progress(visible: bool, length: u64) -> ProgressBar {
    if !visible {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left");
    ProgressBar::new(length).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

struct Run<'a> {
    options: &'a RunOptions,
    capture: PathBuf,
    /// Display frames so far.
    frame: u64,
    /// What was sent before the first frame that is compared: rates are those of what comes after.
    sent_before: Sent,
    summary: Summary,
    with_bundle: u64,
    before: u64,
    /// Client and truth of both eyes, the last compared.
    last: Option<[[Rgb8Image; 2]; 2]>,
    motion: Motion,
    /// The client's clock less the server's at each display frame with a bundle.
    clock_errors_ms: Vec<f64>,
    compared: Vec<(UpdateId, WorldTime)>,
    looks: Vec<Look>,
}

impl Run<'_> {
    /// Counts the frame just shown, and compares it where it was captured.
    fn look(
        &mut self,
        lab: &mut Lab,
        comparer: &mut Comparer,
        update: Option<UpdateId>,
    ) -> anyhow::Result<()> {
        let (frame, has_bundle) = (self.frame, update.is_some());
        self.frame += 1;
        if frame == self.options.compare_from && frame > 0 {
            self.sent_before = lab.seat().sent;
        }
        if !has_bundle && self.with_bundle == 0 {
            self.before += 1;
            if !self.options.compare_waiting {
                return Ok(());
            }
        }
        self.with_bundle += u64::from(has_bundle);
        if !self.options.compares(frame) {
            return Ok(()); // the frame log grows: it is read only where there are pictures
        }
        let records = read_frames(&self.capture).context("reading the runtime's frame log")?;
        let Some(record) = records.last().filter(|record| record.captured) else { return Ok(()) };
        let probes = if has_bundle { Some(lab.client.presenter.probe()?.map(into_probe)) } else { None };
        let world_from_stage = lab.server.scene.scene.world_from_stage;
        let time = lab.server.world_time(record.predicted_display_time_ns);
        self.compared.extend(update.map(|update| (update, time)));
        let pictures = compare(
            comparer,
            &mut self.summary,
            record,
            &self.capture,
            world_from_stage,
            time,
            probes.as_ref(),
        )?;
        add_flicker(&mut self.summary, &self.looks, self.last.as_ref(), frame, &pictures);
        self.looks.push(Look::of(frame, self.summary.last_two()));
        if self.options.dump_every > 0 {
            dump(&self.options.out, record.frame, &pictures)?;
        }
        self.last = Some(pictures);
        Ok(())
    }

    fn finish(self, lab: &Lab) -> anyhow::Result<Report> {
        let (server, seat, sent, before) = (&lab.server, lab.seat(), lab.seat().sent, self.sent_before);
        ensure!(self.with_bundle > 0, "the client showed no bundle in {} s", self.options.seconds);
        let seconds = self.options.seconds - self.options.compare_from as f64 / self.options.refresh_hz;
        let updates = (sent.updates - before.updates).max(1) as f64;
        let mbit = |of: fn(&Sent) -> u64| (of(&sent) - of(&before)) as f64 * 8e-6 / seconds;
        let validation_messages = messages_of_both(&server.gpu, &lab.client.presenter.stats());
        let stats = self.summary.finish(Counted {
            device: server.gpu.device_name(),
            device_is_cpu: server.gpu.is_cpu(),
            renderer: self.options.renderer.name().into(),
            server_fps: (sent.updates - before.updates) as f64 / seconds,
            client_fps: lab.client.presenter.stats().client_fps,
            mbit_per_s: MbitPerS {
                atlas: mbit(|sent| sent.atlas_bytes),
                geometry: mbit(|sent| sent.geometry_bytes + sent.motion.total()),
            },
            bits_by_cause: (sent.bits.total() > 0).then(|| sent.bits - before.bits),
            geometry_mbit_per_s: sent
                .geometry_since(&before)
                .map(|(part, bytes)| (part.to_owned(), bytes as f64 * 8e-6 / seconds))
                .collect(),
            bytes_per_animated_vertex_sample: (sent.motion.samples > 0)
                .then(|| sent.motion.sample_bytes as f64 / sent.motion.samples as f64),
            mean_qp: (self.options.renderer == Renderer::Stream && sent.updates > 0)
                .then(|| (sent.qp_sum - before.qp_sum) as f64 / updates),
            validation_messages,
            gpu_ms: seat
                .gpu_ms
                .iter()
                .map(|(stage, ms)| ((*stage).to_owned(), ms / sent.updates.max(1) as f64))
                .collect(),
            dropped_patches: seat.dropped_patches(),
            triangles: (sent.triangles - before.triangles) as f64 / updates,
            texels_per_pixel: (sent.texels_per_pixel_sum - before.texels_per_pixel_sum) / updates,
            stored_blocks: seat.shows.last().map_or(0, |shows| shows.stored_blocks),
            reused_share: 1.0
                - (sent.texels[1] - before.texels[1]) as f64
                    / (sent.texels[0] - before.texels[0]).max(1) as f64,
            mean_level: sent.lods[0] as f64 / sent.lods[1].max(1) as f64,
            clock_errors_ms: self.clock_errors_ms,
            clock_error_bound_ms: lab.client.presenter.stats().clock_error_bound_ms,
            stage_ms: Some(lab.stages()),
        });
        stats.write_json(&self.options.out.join("stats.json"))?;
        let atlas = match &seat.last {
            Some(shaded) => Some(atlas_picture(&shaded.picture)?),
            None => None,
        };
        if let Some([client, truth]) = &self.last {
            write_pictures(&self.options.out, client, truth, atlas.as_ref(), &stats)?;
        }
        let motion = self.motion.report();
        if let Some(motion) = &motion {
            shadecast_system::write_atomically(
                &self.options.out.join("motion.json"),
                serde_json::to_string_pretty(motion)?.as_bytes(),
            )?;
        }
        let runtime_errors =
            shadecast_mock_runtime::record::read_summary(&self.capture).map_or(0, |s| s.errors);
        Ok(Report {
            stats,
            frames_with_bundle: self.with_bundle,
            frames_before_first_bundle: self.before,
            runtime_errors,
            motion,
            compared: self.compared,
            looks: self.looks,
        })
    }
}

/// An atlas as it looks.
fn atlas_picture(atlas: &Source) -> anyhow::Result<Rgb8Image> {
    let Source::Planes(atlas) = atlas;
    let [width, height] = atlas.extent_texels();
    Ok(Rgb8Image::new(width, height, shadecast_server::encode::picture::rgb_of(atlas))?)
}

/// A client's probe as the metrics want it.
pub fn into_probe(probe: shadecast_client::draw::stages::probe::ProbeView) -> ProbeView {
    ProbeView {
        width: probe.width,
        height: probe.height,
        instance: probe.instance,
        depth_m: probe.distance_m,
    }
}

/// Measures both eyes of a captured frame; client and truth pictures, by eye.
#[allow(clippy::too_many_arguments)]
pub fn compare(
    comparer: &mut Comparer,
    summary: &mut Summary,
    record: &FrameRecord,
    capture: &Path,
    world_from_stage: Pose,
    time: WorldTime,
    probes: Option<&[ProbeView; 2]>,
) -> anyhow::Result<[[Rgb8Image; 2]; 2]> {
    let mut clients = Vec::new();
    let mut truths = Vec::new();
    for (eye, side) in [Side::Left, Side::Right].into_iter().enumerate() {
        let picture = Rgb8Image::read_png(&picture_path(capture, record.frame, side))?;
        let view = record.views.get(eye).context("a captured frame has two views")?;
        let fov: Fov = view.frustum();
        let shown = Shown {
            world_from_eye: world_from_stage.then(view.stage_pose.into()),
            fov,
            time,
            picture: &picture,
            probe: probes.map(|probes| &probes[eye]),
        };
        let (truth, metrics): (Rgb8Image, FrameMetrics) = comparer.measure(&shown)?;
        summary.add(metrics);
        clients.push(picture);
        truths.push(truth);
    }
    let pair = |pictures: Vec<Rgb8Image>| {
        <[Rgb8Image; 2]>::try_from(pictures).map_err(|_| anyhow::anyhow!("two eyes"))
    };
    Ok([pair(clients)?, pair(truths)?])
}

fn dump(out: &Path, frame: u64, [client, truth]: &[[Rgb8Image; 2]; 2]) -> anyhow::Result<()> {
    for (eye, side) in ["left", "right"].into_iter().enumerate() {
        client[eye].write_png(&out.join(format!("client-{frame:06}-{side}.png")))?;
        truth[eye].write_png(&out.join(format!("truth-{frame:06}-{side}.png")))?;
    }
    Ok(())
}

/// The last compared pictures, their difference, the atlas, and one sheet of all of them.
pub fn write_pictures(
    out: &Path,
    client: &[Rgb8Image; 2],
    truth: &[Rgb8Image; 2],
    atlas: Option<&Rgb8Image>,
    stats: &Stats,
) -> anyhow::Result<()> {
    let cell = [client[0].width, client[0].height].map(|side| side.clamp(256, 384));
    let mut sheet = Sheet::new("Shadecast", 3, cell);
    sheet.section("", &format!("{}.", stats.in_words()));
    for (eye, (side, name)) in [("left", "Left eye"), ("right", "Right eye")].into_iter().enumerate() {
        client[eye].write_png(&out.join(format!("client-{side}.png")))?;
        truth[eye].write_png(&out.join(format!("truth-{side}.png")))?;
        let different = add_eye(&mut sheet, name, &client[eye], &truth[eye])?;
        different.write_png(&out.join(format!("difference-{side}.png")))?;
    }
    if let Some(atlas) = atlas {
        atlas.write_png(&out.join("atlas.png"))?;
        sheet.add("Shading atlas", atlas, "All surfaces in reach, shaded once, sent as video.")?;
    }
    sheet.render()?.write_png(&out.join("sheet.png"))?;
    Ok(())
}

/// How many times brighter differences are drawn.
const DIFFERENCE_GAIN: f32 = 4.0;

/// Adds client, truth and their difference, which is given back.
pub fn add_eye(
    sheet: &mut Sheet,
    name: &str,
    client: &Rgb8Image,
    truth: &Rgb8Image,
) -> anyhow::Result<Rgb8Image> {
    let different = difference(truth, client, DIFFERENCE_GAIN);
    let psnr_db = psnr_db(truth, client, &vec![true; truth.pixel_count()]);
    sheet.add(&format!("{name}: client"), client, "What the headset shows.")?;
    sheet.add(&format!("{name}: truth"), truth, "The same pose and moment, rendered per pixel.")?;
    let note = format!("This picture, background included: {psnr_db:.1} dB.");
    sheet.add(&format!("{name}: difference \u{d7}{DIFFERENCE_GAIN}"), &different, &note)?;
    Ok(different)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_mock_runtime::head_path::HeadPath as MockHeadPath;
    use shadecast_scene::SceneSource;

    #[test]
    fn mock_runtime_moves_its_head_as_the_scene_says() {
        let path = load_head_path(&SceneSource::Dragons(1), "walk").expect("every scene has it");
        let mock = MockHeadPath::parse(&head_path_csv(&path, 3.0, 72.0), "head.csv").expect("valid");
        assert!(mock.end_s() >= 4.0);
        for frame in 0..216 {
            // Between rows too.
            let t_s = f64::from(frame) / 72.0 + 0.0011;
            let (found, expected) = (mock.pose_at(t_s), path.stage_from_head(t_s));
            assert!(found.position.distance(expected.position) < 1e-5, "{t_s}: {found:?}");
            assert!(found.orientation.angle_between(expected.orientation) < 1e-3, "{t_s}: {found:?}");
        }
    }

    #[test]
    fn ordinary_assets_stay_in_view_along_the_built_in_walk() {
        let walk = MockHeadPath::parse(BUILT_IN_WALK, "walk.csv").expect("valid");
        for name in ["CesiumMan.glb", "Fox.glb"] {
            let Some(path) = crate::scenes::assets::asset(name) else {
                eprintln!("SKIPPED: {name} is not there; the project ships no models of others");
                continue;
            };
            let scene = shadecast_scene::load_scene(&SceneSource::File(path)).expect(name);
            let model = &scene.models[0];
            for step in 0..20 {
                let t_s = f64::from(step) * 0.25;
                let eye_from_stage = walk.pose_at(t_s).inverse().affine();
                let pose = crate::measure::truth::InstancePose::at(&scene, 0, t_s);
                let is_seen = |vertex: &usize| {
                    let at = eye_from_stage.transform_point3(pose.vertex(model, *vertex).as_vec3());
                    at.z < -0.1 && (at.truncate() / -at.z).abs().max_element() <= 1.0
                };
                let seen = (0..model.vertices.len()).filter(is_seen).count();
                assert!(
                    seen * 10 >= model.vertices.len() * 9,
                    "{name}, {t_s} s: {seen} of {}",
                    model.vertices.len()
                );
            }
        }
    }

    #[test]
    fn head_path_that_the_scene_does_not_have_is_suggested() {
        let folder = tempfile::tempdir().expect("a folder");
        let head = Head::Named("wakl".into());
        let options = RunOptions { head, ..RunOptions::new(SceneSource::Dragons(1), folder.path().into()) };
        let error = mock_config(&options, ClockKind::Virtual, 0).expect_err("unknown").to_string();
        assert_eq!(error, "the scene has no head path \"wakl\"; did you mean \"walk\"?");
    }
}
