//! The ground truth in a window: a driver, with a clock and an event loop of its own. One frame is in flight: what a
//! frame writes for the GPU is written when the last one is over.

use crate::picture;
use crate::scene::{SceneGpu, SceneGpuError, SceneOptions};
use crate::truth::camera::{Mode, ViewCamera, fov_of_picture};
use crate::truth::forward::Forward;
use crate::truth::present::Present;
use ash::vk;
use glam::Vec3;
use shadecast_gpu::{
    Access, Buffer, Framebuffer, Gpu, GpuError, GpuOptions, Image, ImageDesc, Memory, Recorder, Swapchain,
    Ticket, Timings, WindowDevice,
};
use shadecast_protocol::time::ServerTime;
use shadecast_scene::Scene;
use shadecast_scene::process::Loading;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent};
use winit::event_loop::{ActiveEventLoop, EventLoop};
use winit::keyboard::{KeyCode, PhysicalKey};
use winit::raw_window_handle::{HasDisplayHandle, HasWindowHandle};
use winit::window::{Window, WindowId};

/// How often the figures change: readable, and fresh.
const FIGURES_EVERY: Duration = Duration::from_millis(250);
/// Wheel pixels of a touchpad that count as a notch.
const PIXELS_PER_NOTCH: f32 = 40.0;

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
    /// No display.
    #[error(
        "no window can be opened here: {0}; set DISPLAY or WAYLAND_DISPLAY, or render without a window: \
         --out FOLDER for PNG files, --out FILE.y4m or FILE.mp4 for a video"
    )]
    NoDisplay(String),
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
    let no_display = |error: winit::error::EventLoopError| WindowError::NoDisplay(reason(&error.to_string()));
    let events = EventLoop::new().map_err(no_display)?;
    let mut app = App { scene: Some(scene), options, shown: None, result: Ok(()), stats: None };
    events.run_app(&mut app).map_err(no_display)?;
    if let Some(shown) = app.shown.take() {
        app.stats = Some(shown.stats());
    }
    app.result?;
    Ok(app.stats.unwrap_or(WindowStats { frames: 0, seconds: 0.0, validation_messages: 0 }))
}

/// An error of the operating system without the place in the source that `winit` puts before it.
fn reason(text: &str) -> String {
    let after_place = text.split_once(".rs:").and_then(|(_, rest)| rest.split_once(": "));
    after_place.map_or(text, |(_, reason)| reason).trim_end_matches('.').to_owned()
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
                if shown.key(&event) {
                    self.end(events, Ok(()));
                }
            }
            WindowEvent::Focused(false) => shown.held.clear(),
            other => shown.pointer(&other),
        }
    }

    fn about_to_wait(&mut self, _: &ActiveEventLoop) {
        if let Some(shown) = &self.shown {
            shown.window.request_redraw();
        }
    }
}

/// The window with all that draws it. Fields drop in order: what uses the window goes before it.
struct Shown {
    present: Present,
    forward: Forward,
    swapchain: Swapchain,
    scene: Arc<SceneGpu>,
    gpu: Arc<Gpu>,
    window: Arc<Window>,
    options: WindowOptions,
    camera: ViewCamera,
    scene_time_s: f64,
    is_paused: bool,
    figures: bool,
    held: BTreeSet<KeyCode>,
    is_dragging: bool,
    pointer: [f32; 2],
    last: Option<Ticket>,
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
        let refused = |error: &dyn std::fmt::Display| WindowError::NoDisplay(reason(&error.to_string()));
        let [width, height] = options.extent;
        let attributes = Window::default_attributes()
            .with_title(format!("{} - Shadecast", options.title))
            .with_inner_size(PhysicalSize::new(width, height));
        let window = Arc::new(events.create_window(attributes).map_err(|error| refused(&error))?);
        let display = window.display_handle().map_err(|error| refused(&error))?.as_raw();
        let handle = window.window_handle().map_err(|error| refused(&error))?.as_raw();
        let gpu = Gpu::open(&options.gpu, &WindowDevice { display })?;
        // SAFETY: the window and, through the event loop, its display outlive the swapchain: fields drop in order.
        let swapchain = unsafe { Swapchain::new(&gpu, display, handle)? };
        let scene = Arc::new(SceneGpu::cached(&gpu, scene, &options.scene, &options.loading)?);
        let forward = Forward::with_samples(&gpu, &scene, options.extent, options.samples)?;
        let mut present = Present::new(&gpu, swapchain.pass(), !swapchain.codes_srgb())?;
        present.show(forward.image())?;
        let now = Instant::now();
        Ok(Self {
            present,
            forward,
            swapchain,
            scene,
            gpu,
            window,
            camera: options.camera,
            scene_time_s: options.start_s,
            is_paused: false,
            figures: options.figures,
            held: BTreeSet::new(),
            is_dragging: false,
            pointer: [0.0; 2],
            last: None,
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
            validation_messages: self.gpu.validation_messages(),
        }
    }

    /// Draws and presents a frame. True when the options say that it was the last.
    fn frame(&mut self) -> Result<bool, WindowError> {
        if let Some(ticket) = self.last.take() {
            self.timings = self.gpu.wait_timed(ticket)?;
        }
        self.advance();
        let size = self.window.inner_size();
        let Some(image) = self.swapchain.acquire([size.width, size.height])? else {
            // Minimised, or resized just now: nothing to show, and nothing to burn a core for.
            std::thread::sleep(Duration::from_millis(10));
            return Ok(self.is_to_end());
        };
        if self.forward.extent() != self.swapchain.extent() {
            self.forward.resize(self.swapchain.extent())?;
            self.present.show(self.forward.image())?;
        }
        self.write_figures();
        let mut recorder = self.gpu.record()?;
        self.record_scene(&mut recorder);
        recorder.scope("present", |r| {
            self.present.record(r, self.swapchain.pass(), self.swapchain.target(&image));
        });
        self.window.pre_present_notify();
        self.last = Some(self.swapchain.present(recorder, image)?);
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
        let axis = |more, less| {
            f32::from(u8::from(self.held.contains(&more))) - f32::from(u8::from(self.held.contains(&less)))
        };
        let axes = Vec3::new(
            axis(KeyCode::KeyD, KeyCode::KeyA),
            axis(KeyCode::KeyE, KeyCode::KeyQ),
            axis(KeyCode::KeyW, KeyCode::KeyS),
        );
        self.camera.walk(axes, step_s as f32);
        if self.is_paused || self.frames == 0 {
            return;
        }
        self.scene_time_s += if self.options.frames.is_some() { 1.0 / self.options.fps } else { step_s };
    }

    /// Records the scene as the camera sees it, ready to be sampled.
    fn record_scene(&mut self, recorder: &mut Recorder) {
        let eye = self.scene.scene.world_from_stage.then(self.camera.pose());
        let fov = fov_of_picture(self.camera.fov_deg, self.forward.extent());
        let time = ServerTime((self.scene_time_s * 1e9) as i64);
        self.forward.record(recorder, eye, fov, time);
        let layouts = [vk::ImageLayout::TRANSFER_SRC_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
        recorder.transition(self.forward.image(), layouts, Access::COLOR_WRITE, Access::FRAGMENT_READ);
    }

    fn write_figures(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.clock.figures);
        if !self.figures {
            self.present.write(&[]);
        } else if passed >= FIGURES_EVERY || self.frames == 0 {
            let frames = self.frames - self.clock.figures_frame;
            let lines = self.figures(f64::from(frames) / passed.as_secs_f64().max(1e-6));
            self.present.write(&lines);
            (self.clock.figures, self.clock.figures_frame) = (now, self.frames);
        }
    }

    fn figures(&self, fps: f64) -> Vec<String> {
        let at = self.camera.position;
        let mode = if self.camera.mode == Mode::Orbit { "orbit" } else { "fly" };
        let paused = if self.is_paused { " paused" } else { "" };
        let totals = self.scene.numbering.totals;
        let mut lines = vec![
            self.gpu.device_name(),
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

    /// A key went down or up. True where it ends the program.
    fn key(&mut self, event: &KeyEvent) -> bool {
        let PhysicalKey::Code(code) = event.physical_key else { return false };
        if event.state == ElementState::Released {
            self.held.remove(&code);
            return false;
        }
        self.held.insert(code);
        if code == KeyCode::Period || code == KeyCode::Comma {
            self.step(if code == KeyCode::Period { 1.0 } else { -1.0 });
        }
        if !event.repeat {
            self.pressed(code);
        }
        code == KeyCode::Escape
    }

    fn step(&mut self, frames: f64) {
        self.is_paused = true;
        self.scene_time_s += frames / self.options.fps;
    }

    fn pressed(&mut self, code: KeyCode) {
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

    fn pointer(&mut self, event: &WindowEvent) {
        match event {
            WindowEvent::CursorMoved { position, .. } => {
                let at = [position.x as f32, position.y as f32];
                if self.is_dragging {
                    self.camera.drag([at[0] - self.pointer[0], at[1] - self.pointer[1]]);
                }
                self.pointer = at;
            }
            WindowEvent::MouseInput { state, button: MouseButton::Left, .. } => {
                self.is_dragging = *state == ElementState::Pressed;
            }
            WindowEvent::MouseWheel { delta, .. } => self.camera.wheel(match delta {
                MouseScrollDelta::LineDelta(_, lines) => *lines,
                MouseScrollDelta::PixelDelta(pixels) => pixels.y as f32 / PIXELS_PER_NOTCH,
            }),
            _ => {}
        }
    }

    /// Draws the last frame once more, as it is on the window, and writes it.
    fn save_screenshot(&mut self) -> Result<(), WindowError> {
        let Some(path) = self.options.screenshot.clone() else { return Ok(()) };
        if let Some(ticket) = self.last.take() {
            self.gpu.wait(ticket)?;
        }
        let (extent, format) = (self.swapchain.extent(), self.swapchain.format());
        let desc = ImageDesc::new(
            "screenshot",
            extent,
            format,
            vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC,
        );
        let image = Image::new(&self.gpu, desc)?;
        let target = Framebuffer::new(&self.gpu, self.swapchain.pass(), extent, &[image.view()])?;
        let bytes = u64::from(extent[0]) * u64::from(extent[1]) * 4;
        let readback = Buffer::new(&self.gpu, "screenshot", bytes, Memory::Readback)?;
        let mut recorder = self.gpu.record()?;
        self.present.record(&mut recorder, self.swapchain.pass(), &target);
        let layouts = [vk::ImageLayout::PRESENT_SRC_KHR, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
        recorder.transition(&image, layouts, Access::COLOR_WRITE, Access::COPY_READ);
        recorder.read_image(&image, 0, &readback, 0);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit()?)?;
        let is_bgr = matches!(format, vk::Format::B8G8R8A8_SRGB | vk::Format::B8G8R8A8_UNORM);
        let order = if is_bgr { [2, 1, 0] } else { [0, 1, 2] };
        let pixels = readback.bytes()[..bytes as usize].chunks_exact(4);
        let rgb8: Vec<u8> = pixels.flat_map(|p| order.map(|i| p[i])).collect();
        Ok(picture::write_png(&path, extent, &rgb8)?)
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        // Shutdown: everything below is destroyed next.
        self.gpu.wait_idle();
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_display_is_explained_without_places_in_the_source() {
        let text = "os error at /a/b.rs:765: neither WAYLAND_DISPLAY nor DISPLAY is set.";
        assert_eq!(reason(text), "neither WAYLAND_DISPLAY nor DISPLAY is set");
        assert_eq!(reason("not supported"), "not supported");
    }
}
