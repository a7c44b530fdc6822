//! A desktop window in place of a headset. Keys and pointer move the head; one or both eyes are visible.
//!
//! The desktop's events and the clock enter, and drawn images. Frame turns, views and presses leave. Nothing here knows OpenXR
//! and the drawn content.

mod head;
mod pace;
mod scale;

use crate::display::{Activity, Display, DisplayError, EyeImages, FrameTurn, Presses, Views};
use crate::platform::monotonic_now;
use crate::platform::requirements::REQUIRED;
use head::Head;
use pace::Pace;
use scale::Scale;
use shadecast_desktop::canvas::{Canvas, CanvasError};
use shadecast_desktop::controls::Controls;
use shadecast_desktop::png::write_png;
use shadecast_desktop::present::Shows;
use shadecast_desktop::winit::application::ApplicationHandler;
use shadecast_desktop::winit::event::WindowEvent;
use shadecast_desktop::winit::event_loop::{ActiveEventLoop, EventLoop};
use shadecast_desktop::winit::keyboard::KeyCode;
use shadecast_desktop::winit::platform::pump_events::{EventLoopExtPumpEvents, PumpStatus};
use shadecast_desktop::winit::window::WindowId;
use shadecast_gpu::{Access, Gpu, GpuOptions, Image, ImageDesc, Needs, Part, Recorder, WindowImage, vk};
use std::cell::RefCell;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

/// How long a window that shows nothing sleeps.
const HIDDEN_WAIT: Duration = Duration::from_millis(10);
const FORMAT: vk::Format = REQUIRED.eye_formats[0];

/// How the window is opened.
#[derive(Clone, Debug)]
pub struct WindowOptions {
    /// In its title.
    pub title: String,
    /// Pixels of each eye, and of the window at first.
    pub extent_pixels: [u32; 2],
    /// From top to bottom, degrees.
    pub fov_deg: f32,
    /// Both eyes from the start.
    pub both_eyes: bool,
    /// Figures from the start.
    pub figures: bool,
    /// What was seen last, as a PNG.
    pub screenshot: Option<PathBuf>,
    /// Vulkan validation layers on.
    pub validation: bool,
    /// Part of the wanted device's name.
    pub device_name: Option<String>,
}

/// The desktop's events. There is one of them in a program's life.
#[derive(Clone)]
pub struct Desktop(Rc<RefCell<EventLoop<()>>>);

impl Desktop {
    /// Begins to take events, on the program's main thread.
    ///
    /// # Errors
    /// No display.
    pub fn connect() -> Result<Self, DisplayError> {
        let events = EventLoop::new().map_err(|error| refused(CanvasError::no_display(&error)))?;
        Ok(Self(Rc::new(RefCell::new(events))))
    }

    fn pump(&self, handler: &mut impl ApplicationHandler) -> PumpStatus {
        self.0.borrow_mut().pump_app_events(Some(Duration::ZERO), handler)
    }
}

fn refused(error: CanvasError) -> DisplayError {
    match error {
        CanvasError::Gpu(error) => DisplayError::Gpu(error),
        no_display => DisplayError::Window(format!(
            "{no_display}; set DISPLAY or WAYLAND_DISPLAY, or leave --window out to use a headset or a simulator"
        )),
    }
}

/// An open window. Fields drop in order: what the device made goes before the window.
pub struct WindowDisplay {
    eyes: Image,
    handles: [vk::Image; 1],
    canvas: Canvas,
    desktop: Desktop,
    name: String,
    user: User,
    pace: Pace,
    scale: Scale,
    /// Of this frame.
    part: Part,
    /// The window's, between waiting for a frame and its end.
    image: Option<WindowImage>,
    screenshot: Option<PathBuf>,
    /// Frames were shown, so that there is something to keep.
    has_shown: bool,
}

/// Who sits before the window.
struct User {
    head: Head,
    controls: Controls,
    both_eyes: bool,
    figures: bool,
    presses: Presses,
    /// Figures were switched off since they were last written.
    has_closed_figures: bool,
    is_leaving: bool,
}

impl WindowDisplay {
    /// Opens a window.
    ///
    /// # Errors
    /// No display, or no device that can present to it.
    pub fn open(desktop: &Desktop, options: &WindowOptions) -> Result<Self, DisplayError> {
        let mut opening = Opening { options, opened: None };
        desktop.pump(&mut opening);
        let nothing = || CanvasError::NoDisplay("the desktop does not answer".to_owned());
        let mut canvas = opening.opened.unwrap_or_else(|| Err(nothing())).map_err(refused)?;
        let gpu = canvas.gpu();
        let is_cpu = gpu.is_cpu();
        let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::SAMPLED;
        let desc = ImageDesc::new("eyes", options.extent_pixels, FORMAT, usage);
        let eyes = Image::new(gpu, ImageDesc { layers: 2, ..desc })?;
        canvas.present_mut().show(&eyes)?;
        let monitor = canvas.window().current_monitor();
        let rate = monitor.and_then(|monitor| monitor.refresh_rate_millihertz());
        Ok(Self {
            handles: [eyes.handle()],
            eyes,
            canvas,
            desktop: desktop.clone(),
            name: "a window".to_owned(),
            user: User {
                head: Head::new(options.fov_deg),
                controls: Controls::default(),
                both_eyes: options.both_eyes,
                figures: options.figures,
                presses: Presses::default(),
                has_closed_figures: false,
                is_leaving: false,
            },
            // Without a GPU a server may need the same cores.
            pace: Pace::of_display(rate).sharing(is_cpu),
            scale: if is_cpu { Scale::without_gpu(options.extent_pixels) } else { Scale::default() },
            part: Part { extent: options.extent_pixels, first_alone: !options.both_eyes },
            image: None,
            screenshot: options.screenshot.clone(),
            has_shown: false,
        })
    }

    fn pump(&mut self) {
        if let PumpStatus::Exit(_) = self.desktop.pump(&mut self.user) {
            self.user.is_leaving = true;
        }
    }

    /// Shows the eyes as the recording leaves them.
    fn present(&mut self, recorder: Recorder) -> Result<(), DisplayError> {
        let Some(image) = self.image.take() else { return Ok(()) };
        let present = self.canvas.present_mut();
        present.show_part(self.part);
        if std::mem::take(&mut self.user.has_closed_figures) {
            present.write(&[]);
        }
        self.canvas.present(recorder, image)?;
        self.has_shown = true;
        Ok(())
    }

    /// Keeps what was seen last, once.
    fn keep_screenshot(&mut self) -> Result<(), DisplayError> {
        let Some(path) = self.screenshot.take().filter(|_| self.has_shown) else { return Ok(()) };
        let shot = self.canvas.screenshot()?;
        write_png(&path, shot.extent, &shot.rgb8).map_err(|error| DisplayError::Window(error.to_string()))
    }
}

impl Display for WindowDisplay {
    fn gpu(&self) -> &Arc<Gpu> {
        self.canvas.gpu()
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn eye_images(&self) -> EyeImages<'_> {
        EyeImages {
            images: &self.handles,
            format: FORMAT,
            extent_pixels: self.eyes.desc().extent,
            one_eye: true,
            density_maps: None,
        }
    }

    fn part(&self) -> Part {
        self.part
    }

    fn rests(&self) -> bool {
        true
    }

    fn request_exit(&mut self) {
        self.user.is_leaving = true;
    }

    fn poll_events(&mut self) -> Result<Activity, DisplayError> {
        self.pump();
        if self.user.is_leaving {
            self.keep_screenshot()?;
            return Ok(Activity::Exit);
        }
        Ok(Activity::Running)
    }

    fn wait_frame(&mut self) -> Result<FrameTurn, DisplayError> {
        if self.canvas.finish()?.is_some() {
            self.scale.note(self.pace.finished(monotonic_now()));
        }
        self.part =
            Part { extent: self.scale.of(self.eyes.desc().extent), first_alone: !self.user.both_eyes };
        self.image = self.canvas.acquire()?;
        let should_render = self.image.is_some();
        match self.pace.wait_ns(monotonic_now()) {
            // Minimised, or resized just now.
            _ if !should_render => std::thread::sleep(HIDDEN_WAIT),
            0 => {}
            ns => std::thread::sleep(Duration::from_nanos(ns as u64)),
        }
        let display_time = self.pace.begin(monotonic_now());
        let period_ns = self.pace.period_ns;
        Ok(FrameTurn { own_time_ns: display_time.0, display_time, period_ns, should_render })
    }

    fn locate_views(&mut self, turn: &FrameTurn) -> Result<Views, DisplayError> {
        self.pump();
        let axes = self.user.controls.axes();
        let both_eyes = !self.part.first_alone;
        Ok(self.user.head.views(turn.display_time, axes, self.eyes.desc().extent, both_eyes))
    }

    fn acquire_image(&mut self) -> Result<usize, DisplayError> {
        Ok(0)
    }

    fn release_image(&mut self) -> Result<(), DisplayError> {
        Ok(())
    }

    fn end_frame(&mut self, _: FrameTurn) -> Result<(), DisplayError> {
        let mut recorder = self.canvas.gpu().record()?;
        let layouts = [vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
        recorder.transition(&self.eyes, layouts, Access::COLOR_WRITE, Access::FRAGMENT_READ);
        self.present(recorder)
    }

    /// Does not happen while the window waits for its own last picture before it wants another.
    fn end_same_frame(&mut self, _: FrameTurn) -> Result<(), DisplayError> {
        if !self.has_shown {
            return Ok(());
        }
        let recorder = self.canvas.gpu().record()?;
        self.present(recorder)
    }

    fn end_empty_frame(&mut self, _: FrameTurn) -> Result<(), DisplayError> {
        Ok(())
    }

    fn presses(&self) -> Presses {
        self.user.presses
    }

    fn wants_figures(&self) -> bool {
        self.user.figures
    }

    fn show_figures(&mut self, lines: &[String]) -> bool {
        self.canvas.present_mut().write(lines);
        true
    }
}

/// Makes the window as soon as the desktop is ready for one.
struct Opening<'a> {
    options: &'a WindowOptions,
    opened: Option<Result<Canvas, CanvasError>>,
}

impl Opening<'_> {
    fn open(&mut self, events: &ActiveEventLoop) {
        let WindowOptions { title, extent_pixels, validation, device_name, .. } = self.options;
        let gpu =
            GpuOptions { needs: Needs::Client, validation: *validation, device_name: device_name.clone() };
        let options = (title, *extent_pixels);
        self.opened.get_or_insert_with(|| Canvas::open(events, options.0, options.1, &gpu, Shows::Eyes));
    }
}

impl ApplicationHandler for Opening<'_> {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        self.open(events);
    }

    fn window_event(&mut self, _: &ActiveEventLoop, _: WindowId, _: WindowEvent) {}

    /// Comes after each round, also where the program was resumed long ago: a second window, after the first was lost.
    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        self.open(events);
    }
}

impl ApplicationHandler for User {
    fn resumed(&mut self, _: &ActiveEventLoop) {}

    fn window_event(&mut self, _: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => self.is_leaving = true,
            WindowEvent::KeyboardInput { event, .. } => {
                let pressed = self.controls.key(&event).filter(|pressed| !pressed.is_repeat);
                if let Some(pressed) = pressed {
                    self.press(pressed.code);
                }
            }
            WindowEvent::Focused(false) => self.controls.let_go(),
            other => self.controls.pointer(&other, &mut self.head.camera),
        }
    }
}

impl User {
    fn press(&mut self, code: KeyCode) {
        match code {
            KeyCode::Escape => self.is_leaving = true,
            KeyCode::Tab => self.head.camera.switch(),
            KeyCode::KeyR => self.head.reset(),
            KeyCode::KeyB => self.both_eyes = !self.both_eyes,
            KeyCode::KeyN => self.presses.nexts += 1,
            KeyCode::Enter => self.presses.takes += 1,
            KeyCode::KeyP => self.presses.halts += 1,
            KeyCode::Period => self.presses.steps += 1,
            KeyCode::KeyF => {
                self.figures = !self.figures;
                self.has_closed_figures = !self.figures;
            }
            _ => {}
        }
    }
}
