//! The ground truth in a window: a driver with its own clock and event loop. One frame is in flight: data for the GPU is
//! written after the previous frame has finished.

use crate::encode::picture;
use crate::scene::{SceneGpu, SceneGpuError, SceneOptions};
use crate::truth::forward::Forward;
use ash::vk;
use shadecast_desktop::camera::{Mode, ViewCamera, fov_of_picture};
use shadecast_desktop::canvas::{Canvas, CanvasError};
use shadecast_desktop::controls::{Controls, Pressed};
use shadecast_desktop::present::Shows;
use shadecast_desktop::winit::application::ApplicationHandler;
use shadecast_desktop::winit::event::WindowEvent;
use shadecast_desktop::winit::event_loop::{ActiveEventLoop, EventLoop};
use shadecast_desktop::winit::keyboard::KeyCode;
use shadecast_desktop::winit::window::WindowId;
use shadecast_gpu::{Access, GpuError, GpuOptions, Recorder, Timings};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::Scene;
use shadecast_scene::process::Loading;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How often the figures change: readable, and fresh.
const FIGURES_EVERY: Duration = Duration::from_millis(250);

/// How the window is run.
#[derive(Clone, Debug)]
pub struct WindowOptions {
    /// Name of the scene, for the title.
    pub title: String,
    /// Width and height at first, pixels.
    pub extent: [u32; 2],
    /// Samples a pixel.
    pub samples: vk::SampleCountFlags,
    /// Where it looks from at first.
    pub camera: ViewCamera,
    /// Scene time of the first frame, seconds.
    pub start_s: f64,
    /// Frames a second of scene time, for single steps and for a fixed number of frames.
    pub fps: f64,
    /// Ends after so many frames, each a step of scene time, however long it took.
    pub frames: Option<u32>,
    /// Ends after so many seconds.
    pub seconds: Option<f64>,
    /// Figures are shown from the start.
    pub figures: bool,
    /// The last frame, as a PNG.
    pub screenshot: Option<PathBuf>,
    /// How the scene is brought to the GPU.
    pub scene: SceneOptions,
    /// Where sampled clips are kept, and the wish to end, which ends the window too.
    pub loading: Loading,
    /// The device.
    pub gpu: GpuOptions,
}

/// How it went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowStats {
    /// Frames presented.
    pub frames: u32,
    /// From the first frame to the end, seconds.
    pub seconds: f64,
    /// Validation messages.
    pub validation_messages: u32,
}

/// Why there is no window, or no longer.
#[derive(Debug, thiserror::Error)]
pub enum WindowError {
    /// No window.
    #[error(
        "{0}; set DISPLAY or WAYLAND_DISPLAY, or render without a window: \
         --out FOLDER for PNG files, --out FILE.y4m or FILE.mp4 for a video"
    )]
    NoWindow(CanvasError),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneGpuError),
    /// The screenshot.
    #[error(transparent)]
    Screenshot(#[from] std::io::Error),
}

/// Shows `scene` until the user, or the options, end it.
///
/// # Errors
/// No display, no device for it, or the device failed.
pub fn run(scene: Scene, options: WindowOptions) -> Result<WindowStats, WindowError> {
    let no_display = |error: shadecast_desktop::winit::error::EventLoopError| {
        WindowError::NoWindow(CanvasError::no_display(&error))
    };
    let events = EventLoop::new().map_err(no_display)?;
    let mut app = App { scene: Some(scene), options, shown: None, result: Ok(()), stats: None };
    events.run_app(&mut app).map_err(no_display)?;
    if let Some(shown) = app.shown.take() {
        app.stats = Some(shown.stats());
    }
    app.result?;
    Ok(app.stats.unwrap_or(WindowStats { frames: 0, seconds: 0.0, validation_messages: 0 }))
}

impl From<CanvasError> for WindowError {
    fn from(error: CanvasError) -> Self {
        match error {
            CanvasError::Gpu(error) => Self::Gpu(error),
            no_display => Self::NoWindow(no_display),
        }
    }
}

struct App {
    scene: Option<Scene>,
    options: WindowOptions,
    shown: Option<Shown>,
    result: Result<(), WindowError>,
    stats: Option<WindowStats>,
}

impl App {
    /// Ends the program, with an error where there is one.
    fn end(&mut self, events: &ActiveEventLoop, result: Result<(), WindowError>) {
        self.result = result;
        events.exit();
    }
}

impl ApplicationHandler for App {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        let Some(scene) = self.scene.take() else { return };
        match Shown::open(events, scene, self.options.clone()) {
            Ok(shown) => self.shown = Some(shown),
            Err(error) => self.end(events, Err(error)),
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(shown) = &mut self.shown else { return };
        match event {
            WindowEvent::CloseRequested => self.end(events, Ok(())),
            WindowEvent::RedrawRequested => match shown.frame() {
                Ok(false) => {}
                Ok(true) => self.end(events, Ok(())),
                Err(error) => self.end(events, Err(error)),
            },
            WindowEvent::KeyboardInput { event, .. } => {
                if shown.controls.key(&event).is_some_and(|pressed| shown.pressed(pressed)) {
                    self.end(events, Ok(()));
                }
            }
            WindowEvent::Focused(false) => shown.controls.let_go(),
            other => shown.controls.pointer(&other, &mut shown.camera),
        }
    }

    fn about_to_wait(&mut self, _: &ActiveEventLoop) {
        if let Some(shown) = &self.shown {
            shown.canvas.window().request_redraw();
        }
    }
}

/// The window with all that draws it. Fields drop in order: what uses the device goes before the window.
struct Shown {
    forward: Forward,
    scene: Arc<SceneGpu>,
    canvas: Canvas,
    options: WindowOptions,
    camera: ViewCamera,
    controls: Controls,
    scene_time_s: f64,
    is_paused: bool,
    figures: bool,
    /// Of the frame before.
    timings: Timings,
    frames: u32,
    clock: Clock,
}

struct Clock {
    first: Instant,
    last: Instant,
    figures: Instant,
    figures_frame: u32,
}

impl Shown {
    fn open(events: &ActiveEventLoop, scene: Scene, options: WindowOptions) -> Result<Self, WindowError> {
        let mut canvas = Canvas::open(events, &options.title, options.extent, &options.gpu, Shows::Picture)?;
        let gpu = canvas.gpu();
        let scene = Arc::new(SceneGpu::cached(gpu, scene, &options.scene, &options.loading)?);
        let forward = Forward::with_samples(gpu, &scene, options.extent, options.samples)?;
        canvas.present_mut().show(forward.image())?;
        let now = Instant::now();
        Ok(Self {
            forward,
            scene,
            canvas,
            camera: options.camera,
            controls: Controls::default(),
            scene_time_s: options.start_s,
            is_paused: false,
            figures: options.figures,
            timings: Timings::default(),
            frames: 0,
            clock: Clock { first: now, last: now, figures: now, figures_frame: 0 },
            options,
        })
    }

    fn stats(&self) -> WindowStats {
        WindowStats {
            frames: self.frames,
            seconds: self.clock.first.elapsed().as_secs_f64(),
            validation_messages: self.canvas.gpu().validation_messages(),
        }
    }

    /// Draws and presents a frame. True when the options say that it was the last.
    fn frame(&mut self) -> Result<bool, WindowError> {
        if let Some(timings) = self.canvas.finish()? {
            self.timings = timings;
        }
        self.advance();
        let Some(image) = self.canvas.acquire()? else {
            // Minimised, or resized just now: nothing to show, and nothing to burn a core for.
            std::thread::sleep(Duration::from_millis(10));
            return Ok(self.is_to_end());
        };
        if self.forward.extent() != self.canvas.extent() {
            self.forward.resize(self.canvas.extent())?;
            self.canvas.present_mut().show(self.forward.image())?;
        }
        self.write_figures();
        let mut recorder = self.canvas.gpu().record()?;
        self.record_scene(&mut recorder);
        self.canvas.present(recorder, image)?;
        self.frames += 1;
        let is_last = self.options.frames.is_some_and(|most| self.frames >= most) || self.is_to_end();
        if is_last {
            self.save_screenshot()?;
        }
        Ok(is_last)
    }

    /// Time is up, or somebody asked.
    fn is_to_end(&self) -> bool {
        let is_over = |most| self.clock.first.elapsed().as_secs_f64() >= most;
        self.options.loading.cancel.is_asked() || self.options.seconds.is_some_and(is_over)
    }

    /// Moves the camera and the scene's time on.
    fn advance(&mut self) {
        let now = Instant::now();
        if self.frames == 0 {
            self.clock = Clock { first: now, last: now, figures: now, figures_frame: 0 };
        }
        let step_s = now.duration_since(self.clock.last).as_secs_f64();
        self.clock.last = now;
        self.camera.walk(self.controls.axes(), step_s as f32);
        if self.is_paused || self.frames == 0 {
            return;
        }
        self.scene_time_s += if self.options.frames.is_some() { 1.0 / self.options.fps } else { step_s };
    }

    /// Records the scene as the camera sees it, ready to be sampled.
    fn record_scene(&mut self, recorder: &mut Recorder) {
        let eye = self.scene.scene.world_from_stage.then(self.camera.pose());
        let fov = fov_of_picture(self.camera.fov_deg, self.forward.extent());
        let time = WorldTime((self.scene_time_s * 1e9) as i64);
        self.forward.record(recorder, eye, fov, time);
        let layouts = [vk::ImageLayout::TRANSFER_SRC_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
        recorder.transition(self.forward.image(), layouts, Access::COLOR_WRITE, Access::FRAGMENT_READ);
    }

    fn write_figures(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.clock.figures);
        if !self.figures {
            self.canvas.present_mut().write(&[]);
        } else if passed >= FIGURES_EVERY || self.frames == 0 {
            let frames = self.frames - self.clock.figures_frame;
            let lines = self.figures(f64::from(frames) / passed.as_secs_f64().max(1e-6));
            self.canvas.present_mut().write(&lines);
            (self.clock.figures, self.clock.figures_frame) = (now, self.frames);
        }
    }

    fn figures(&self, fps: f64) -> Vec<String> {
        let at = self.camera.position;
        let mode = if self.camera.mode == Mode::Orbit { "orbit" } else { "fly" };
        let paused = if self.is_paused { " paused" } else { "" };
        let totals = self.scene.numbering.totals;
        let mut lines = vec![
            self.canvas.gpu().device_name(),
            format!("{fps:.1} fps   scene {:.3} s{paused}", self.scene_time_s),
            format!("{mode} camera {:.2} {:.2} {:.2}", at.x, at.y, at.z),
            format!("{} instances", self.scene.numbering.instances.len()),
            format!("{} vertices, {} moving", totals.vertices, totals.animated_vertices),
        ];
        let mut stages: Vec<(&str, f64)> = Vec::new();
        for (name, ms) in self.timings.iter() {
            match stages.iter_mut().find(|(known, _)| *known == name) {
                Some((_, sum)) => *sum += ms,
                None => stages.push((name, ms)),
            }
        }
        lines.extend(stages.iter().map(|(name, ms)| format!("{name:<12}{ms:9.2} ms")));
        lines
    }

    /// A key went down. True where it ends the program.
    fn pressed(&mut self, Pressed { code, is_repeat }: Pressed) -> bool {
        if code == KeyCode::Period || code == KeyCode::Comma {
            self.step(if code == KeyCode::Period { 1.0 } else { -1.0 });
        }
        if !is_repeat {
            self.switch(code);
        }
        code == KeyCode::Escape
    }

    fn step(&mut self, frames: f64) {
        self.is_paused = true;
        self.scene_time_s += frames / self.options.fps;
    }

    fn switch(&mut self, code: KeyCode) {
        match code {
            KeyCode::Space => self.is_paused = !self.is_paused,
            KeyCode::Tab => self.camera.switch(),
            KeyCode::KeyF => self.figures = !self.figures,
            KeyCode::KeyR => {
                self.camera = self.options.camera;
                self.scene_time_s = self.options.start_s;
            }
            _ => {
                let chosen = DIGITS.iter().position(|digit| *digit == code);
                if let Some(camera) = chosen.and_then(|index| self.scene.scene.cameras.get(index)) {
                    self.camera = self.camera.moved_to(camera.stage_from_eye, camera.fov_deg);
                }
            }
        }
    }

    /// Writes the last frame, as it is on the window.
    fn save_screenshot(&mut self) -> Result<(), WindowError> {
        let Some(path) = &self.options.screenshot else { return Ok(()) };
        let shot = self.canvas.screenshot()?;
        Ok(picture::write_png(path, shot.extent, &shot.rgb8)?)
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        // Shutdown: everything below is destroyed next.
        self.canvas.gpu().wait_idle();
    }
}

const DIGITS: [KeyCode; 9] = [
    KeyCode::Digit1,
    KeyCode::Digit2,
    KeyCode::Digit3,
    KeyCode::Digit4,
    KeyCode::Digit5,
    KeyCode::Digit6,
    KeyCode::Digit7,
    KeyCode::Digit8,
    KeyCode::Digit9,
];
