//! OpenXR: instance, Vulkan device, session, frames, views. The only module that names `openxr`.
//!
//! The runtime's events and poses enter, and drawn images. Frame turns, views in the walked stage and presses leave. Nothing
//! here knows the drawn content.
//!
//! The module requests API 1.0, which every loader in use accepts. Frames allocate nothing: views are located through the
//! function pointers into arrays of two.

mod actions;
pub mod error;
pub mod foveation;
mod locomotion;
mod time;

use crate::display::{
    ASSUMED_EYE_HEIGHT_M, Activity, DensityMaps, Display, DisplayError, EyeImages, FrameTurn, Presses, Views,
};
use crate::platform::requirements::REQUIRED;
use crate::platform::{Platform, monotonic_now};
use actions::Actions;
use ash::vk;
use ash::vk::Handle as _;
use error::{Doing, XrError, no_runtime};
use foveation::{Foveation, Maps};
use glam::{Quat, Vec3};
use locomotion::Locomotion;
use openxr::sys;
use openxr::sys::platform::VkGetInstanceProcAddr;
use shadecast_gpu::{DeviceSource, Gpu, GpuError, GpuOptions, Needs};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::ClientTime;
use std::sync::{Arc, OnceLock};
use time::GuessedClock;

const VIEW_CONFIGURATION: openxr::ViewConfigurationType = openxr::ViewConfigurationType::PRIMARY_STEREO;

/// How the headset is opened.
#[derive(Clone, Copy, Debug, Default)]
pub struct XrOptions {
    /// Vulkan validation layers on.
    pub validation: bool,
    /// The rate that the display is asked for, frames a second: of those that it has the nearest. `None`: its own choice.
    pub refresh_hz: Option<f32>,
    /// How much less is shaded towards the border, where runtime and device can.
    pub foveation: Foveation,
    /// Whether decoders may leave pictures in the device's memory; on Android they always do.
    pub pictures_on_device: bool,
}

/// The runtime, as the maker of Vulkan's instance and device.
struct XrDevice {
    instance: openxr::Instance,
    system: openxr::SystemId,
    /// It makes density maps, and they are wanted.
    has_density_maps: bool,
    /// `vkGetInstanceProcAddr` of the loader that `Gpu::open` has opened and keeps.
    loader: OnceLock<VkGetInstanceProcAddr>,
}

/// A headset that is ready to draw to: images, and all else. Dropped in this order.
pub struct Xr {
    /// The images of both eyes.
    swapchain: Swapchain,
    /// Session, frames and views.
    headset: Headset,
}

/// A headset's session, and the device it draws with. Fields are dropped in this order: what is made first goes last.
struct Headset {
    stage: openxr::Space,
    head: openxr::Space,
    stream: openxr::FrameStream<openxr::Vulkan>,
    waiter: openxr::FrameWaiter,
    session: openxr::Session<openxr::Vulkan>,
    blend_mode: openxr::EnvironmentBlendMode,
    phase: Phase,
    refresh_hz: Option<f32>,
    exit_requested: bool,
    /// Where head and eyes were located last, in the room: the runtime's own stage.
    last_views: Option<Views>,
    /// Where they were for the image released last, once the session has shown one.
    drawn_views: Option<Views>,
    jumps: Jumps,
    actions: Actions,
    locomotion: Locomotion,
    /// A button shows and hides them.
    wants_figures: bool,
    presses: Presses,
    /// For a runtime that does not convert its times itself.
    clock: GuessedClock,
    gpu: Arc<Gpu>,
    device: XrDevice,
    runtime_name: String,
}

/// The session, as far as the frame loop must know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Not begun, or ended.
    Idle,
    /// Begun: frames must be waited for.
    Running,
    /// The runtime is done with us.
    Exiting,
}

/// Jumps of the stage: those that have happened by the times asked for, and those that are announced.
#[derive(Debug, Default)]
struct Jumps {
    count: u32,
    announced_ns: Vec<i64>,
}

impl Jumps {
    /// Announcements kept; a runtime that makes more than that at once has no use for their times.
    const MAX_ANNOUNCED: usize = 16;

    fn announce(&mut self, change_ns: i64) {
        if self.announced_ns.len() == Self::MAX_ANNOUNCED {
            self.happen();
        } else {
            self.announced_ns.push(change_ns);
        }
    }

    fn happen(&mut self) {
        self.count = self.count.wrapping_add(1);
    }

    /// The jumps up to `time_ns`.
    fn until(&mut self, time_ns: i64) -> u32 {
        let announced = self.announced_ns.len();
        self.announced_ns.retain(|change_ns| *change_ns > time_ns);
        self.count = self.count.wrapping_add((announced - self.announced_ns.len()) as u32);
        self.count
    }
}

/// The array swapchain of both eyes.
struct Swapchain {
    handle: openxr::Swapchain<openxr::Vulkan>,
    images: Vec<vk::Image>,
    /// Where fewer fragments are enough.
    maps: Option<Maps>,
    format: vk::Format,
    extent_pixels: [u32; 2],
    /// An image is ours until it is released.
    is_acquired: bool,
}

impl DeviceSource for XrDevice {
    fn create_instance(
        &self,
        entry: &ash::Entry,
        info: &vk::InstanceCreateInfo<'_>,
    ) -> Result<vk::Instance, GpuError> {
        // SAFETY: both are the type of `vkGetInstanceProcAddr`; ash and OpenXR only name handles and the result differently.
        let loader = *self
            .loader
            .get_or_init(|| unsafe { std::mem::transmute(entry.static_fn().get_instance_proc_addr) });
        // SAFETY: `info` and all that it points to live through the call; the runtime only adds to it.
        let made = unsafe {
            self.instance.create_vulkan_instance(self.system, loader, std::ptr::from_ref(info).cast())
        };
        Ok(vk::Instance::from_raw(
            made_by_runtime(made, "creating the Vulkan instance through OpenXR")? as u64
        ))
    }

    fn physical_device(
        &self,
        instance: &ash::Instance,
        _: &GpuOptions,
    ) -> Result<vk::PhysicalDevice, GpuError> {
        // SAFETY: the instance was made by `create_instance` above.
        let device = unsafe {
            self.instance.vulkan_graphics_device(self.system, instance.handle().as_raw() as usize as *const _)
        };
        let device = device.map_err(|result| {
            GpuError::NoDevice(format!(
                "the OpenXR runtime answers {result:?} when asked for the headset's device"
            ))
        })?;
        Ok(vk::PhysicalDevice::from_raw(device as u64))
    }

    fn create_device(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        info: &vk::DeviceCreateInfo<'_>,
    ) -> Result<vk::Device, GpuError> {
        let Some(loader) = self.loader.get().copied() else {
            return Err(GpuError::NoLoader(format!("{:?} is not of this runtime", instance.handle())));
        };
        // SAFETY: `physical` is the device that the runtime named; `info` and all that it points to live through the
        // call.
        let made = unsafe {
            self.instance.create_vulkan_device(
                self.system,
                loader,
                physical.as_raw() as usize as *const _,
                std::ptr::from_ref(info).cast(),
            )
        };
        Ok(vk::Device::from_raw(made_by_runtime(made, "creating the Vulkan device through OpenXR")? as u64))
    }

    fn wants_density_maps(&self) -> bool {
        self.has_density_maps
    }
}

fn made_by_runtime<T>(
    made: Result<Result<*const T, i32>, sys::Result>,
    doing: &'static str,
) -> Result<*const T, GpuError> {
    match made {
        Ok(Ok(handle)) => Ok(handle),
        Ok(Err(result)) => Err(GpuError::Vulkan { doing, result: vk::Result::from_raw(result) }),
        Err(result) => Err(GpuError::NoDevice(format!("{doing}: the OpenXR runtime answers {result:?}"))),
    }
}

/// Also whether it makes density maps.
fn open_instance(platform: &Platform, foveation: Foveation) -> Result<(openxr::Instance, bool), XrError> {
    // SAFETY: the system's OpenXR loader conforms to the specification.
    let entry = unsafe { openxr::Entry::load(platform.openxr_platform()) };
    let entry = entry.map_err(|error| XrError::NoLoader(error.to_string()))?;
    let available = entry.enumerate_extensions().map_err(no_runtime)?;
    let mut wanted = openxr::ExtensionSet::default();
    wanted.khr_vulkan_enable2 = true;
    time::want_conversion(&mut wanted, &available);
    wanted.fb_display_refresh_rate = available.fb_display_refresh_rate;
    wanted.ext_performance_settings = available.ext_performance_settings;
    wanted.bd_controller_interaction = available.bd_controller_interaction;
    let has_density_maps = foveation::want(&mut wanted, &available, foveation);
    platform.add_extensions(&mut wanted);
    if !available.khr_vulkan_enable2 {
        return Err(XrError::NoExtension { runtime: "in use".into(), extension: "XR_KHR_vulkan_enable2" });
    }
    let application = openxr::ApplicationInfo {
        application_name: "Shadecast",
        application_version: 1,
        engine_name: "Shadecast",
        engine_version: 1,
        api_version: openxr::Version::new(1, 0, 0),
    };
    let instance = entry.create_instance(&application, &wanted, &[], platform.openxr_platform());
    let instance = instance.map_err(|result| match result {
        sys::Result::ERROR_RUNTIME_UNAVAILABLE | sys::Result::ERROR_RUNTIME_FAILURE => no_runtime(result),
        _ => XrError::Call { doing: "creating the OpenXR instance", result },
    })?;
    Ok((instance, has_density_maps))
}

impl Xr {
    /// Opens the headset: instance, device, session, swapchain.
    pub fn open(platform: &Platform, options: XrOptions) -> Result<Self, XrError> {
        let (instance, has_density_maps) = open_instance(platform, options.foveation)?;
        let runtime_name = instance.properties().doing("asking for the runtime's name")?.runtime_name;
        let system = instance.system(openxr::FormFactor::HEAD_MOUNTED_DISPLAY).map_err(XrError::NoHeadset)?;
        let blend_modes = instance
            .enumerate_environment_blend_modes(system, VIEW_CONFIGURATION)
            .doing("listing blend modes")?;
        let blend_mode = blend_modes.first().copied().unwrap_or(openxr::EnvironmentBlendMode::OPAQUE);
        // The specification wants this call before a session is made; any version with 1.1 core will do.
        instance.graphics_requirements::<openxr::Vulkan>(system).doing("asking for Vulkan versions")?;
        let device =
            XrDevice { instance: instance.clone(), system, has_density_maps, loader: OnceLock::new() };
        let on_device = options.pictures_on_device || cfg!(target_os = "android");
        let needs = if on_device { Needs::ClientOfPictures } else { Needs::Client };
        let gpu_options = GpuOptions { needs, validation: options.validation, device_name: None };
        let gpu = Gpu::open(&gpu_options, &device)?;
        let (session, waiter, stream) = open_session(&instance, system, &gpu)?;
        let actions = Actions::open(&instance, &session)?;
        let stage = open_stage(&session)?;
        let head = session
            .create_reference_space(openxr::ReferenceSpaceType::VIEW, openxr::Posef::IDENTITY)
            .doing("creating the head's space")?;
        let foveation = Some(options.foveation).filter(|_| gpu.takes_density_maps());
        let swapchain = Swapchain::open(&instance, system, &session, foveation)?;
        let headset = Headset {
            stage,
            head,
            stream,
            waiter,
            session,
            blend_mode,
            phase: Phase::Idle,
            refresh_hz: options.refresh_hz,
            exit_requested: false,
            last_views: None,
            drawn_views: None,
            jumps: Jumps::default(),
            actions,
            locomotion: Locomotion::default(),
            wants_figures: false,
            presses: Presses::default(),
            clock: GuessedClock::default(),
            gpu,
            device,
            runtime_name,
        };
        Ok(Self { swapchain, headset })
    }
}

impl Display for Xr {
    fn gpu(&self) -> &Arc<Gpu> {
        &self.headset.gpu
    }

    fn name(&self) -> &str {
        &self.headset.runtime_name
    }

    fn eye_images(&self) -> EyeImages<'_> {
        let Swapchain { images, maps, format, extent_pixels, .. } = &self.swapchain;
        let density_maps =
            maps.as_ref().map(|maps| DensityMaps { images: &maps.images, extent_texels: maps.extent_texels });
        EyeImages { images, format: *format, extent_pixels: *extent_pixels, one_eye: false, density_maps }
    }

    fn request_exit(&mut self) {
        self.headset.exit_requested = true;
    }

    fn poll_events(&mut self) -> Result<Activity, DisplayError> {
        Ok(self.headset.poll_events()?)
    }

    fn wait_frame(&mut self) -> Result<FrameTurn, DisplayError> {
        Ok(self.headset.wait_frame()?)
    }

    fn locate_views(&mut self, turn: &FrameTurn) -> Result<Views, DisplayError> {
        Ok(self.headset.locate_views(turn)?)
    }

    fn acquire_image(&mut self) -> Result<usize, DisplayError> {
        Ok(self.swapchain.acquire()?)
    }

    fn release_image(&mut self) -> Result<(), DisplayError> {
        Ok(self.swapchain.release()?)
    }

    fn end_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError> {
        Ok(self.headset.end_frame(turn, &self.swapchain)?)
    }

    fn end_same_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError> {
        Ok(self.headset.end_same_frame(turn, &self.swapchain)?)
    }

    fn end_empty_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError> {
        Ok(self.headset.end_empty_frame(turn)?)
    }

    fn presses(&self) -> Presses {
        self.headset.presses
    }

    fn wants_figures(&self) -> bool {
        self.headset.wants_figures
    }
}

impl Headset {
    /// Takes in the runtime's events, and begins or ends the session as they say.
    fn poll_events(&mut self) -> Result<Activity, XrError> {
        if self.exit_requested {
            self.pass_on_exit_request()?;
        }
        let instance = self.device.instance.clone();
        let mut buffer = openxr::EventDataBuffer::new();
        while let Some(event) = instance.poll_event(&mut buffer).doing("polling events")? {
            match event {
                openxr::Event::SessionStateChanged(change) => self.change_state(change.state())?,
                openxr::Event::ReferenceSpaceChangePending(change) => {
                    // LOCAL and STAGE change together or alone; a jump too many only costs the prediction's past.
                    self.jumps.announce(change.change_time().as_nanos());
                }
                openxr::Event::DisplayRefreshRateChangedFB(change) => {
                    let [from, to] = [change.from_display_refresh_rate(), change.to_display_refresh_rate()];
                    tracing::info!("the display changes from {from} to {to} Hz");
                }
                openxr::Event::InstanceLossPending(_) => return Err(XrError::Lost("polling events")),
                _ => {}
            }
        }
        Ok(match self.phase {
            Phase::Idle => Activity::Idle,
            Phase::Running => Activity::Running,
            Phase::Exiting => Activity::Exit,
        })
    }

    fn pass_on_exit_request(&mut self) -> Result<(), XrError> {
        if self.phase == Phase::Running {
            self.exit_requested = false;
            return self.session.request_exit().doing("asking for the session's end");
        }
        self.phase = Phase::Exiting;
        Ok(())
    }

    fn change_state(&mut self, state: openxr::SessionState) -> Result<(), XrError> {
        tracing::debug!("session state {state:?}");
        match state {
            openxr::SessionState::READY => {
                self.session.begin(VIEW_CONFIGURATION).doing("beginning the session")?;
                self.jumps.happen();
                self.drawn_views = None;
                self.phase = Phase::Running;
                self.request_rate();
                self.request_performance();
            }
            openxr::SessionState::STOPPING => {
                self.phase = Phase::Idle;
                self.session.end().doing("ending the session")?;
            }
            openxr::SessionState::LOSS_PENDING => return Err(XrError::Lost("polling events")),
            openxr::SessionState::EXITING => self.phase = Phase::Exiting,
            _ => {}
        }
        Ok(())
    }

    /// Asks for as much of processor and graphics processor as a headset can give for long, where the runtime lets itself be asked.
    fn request_performance(&self) {
        let Some(performance) = self.device.instance.exts().ext_performance_settings else { return };
        for domain in [sys::PerfSettingsDomainEXT::CPU, sys::PerfSettingsDomainEXT::GPU] {
            let level = sys::PerfSettingsLevelEXT::SUSTAINED_HIGH;
            // SAFETY: the function was loaded for this instance, and the session is alive.
            let result = unsafe {
                (performance.perf_settings_set_performance_level)(self.session.as_raw(), domain, level)
            };
            if result.into_raw() < 0 {
                tracing::warn!("the OpenXR runtime refuses the performance level of {domain:?}: {result:?}");
            }
        }
    }

    /// Asks for the wanted rate. Who does not get it sees the same at another one.
    fn request_rate(&self) {
        let Some(wanted) = self.refresh_hz else { return };
        if self.device.instance.exts().fb_display_refresh_rate.is_none() {
            tracing::warn!(
                "the OpenXR runtime chooses the refresh rate itself (it lacks XR_FB_display_refresh_rate)"
            );
            return;
        }
        if let Err(refused) = self.request_nearest_rate(wanted) {
            tracing::warn!("the OpenXR runtime refuses another refresh rate: {refused:?}");
        }
    }

    fn request_nearest_rate(&self, wanted: f32) -> Result<(), sys::Result> {
        let offered = self.session.enumerate_display_refresh_rates()?;
        let Some(nearest) = nearest(&offered, wanted) else { return Ok(()) };
        if nearest != wanted {
            tracing::warn!("the display offers {offered:?} Hz: {nearest} Hz is nearest to {wanted} Hz");
        }
        self.session.request_display_refresh_rate(nearest)
    }

    /// Sleeps until the runtime wants the next frame, and begins it.
    fn wait_frame(&mut self) -> Result<FrameTurn, XrError> {
        let state = self.waiter.wait().doing("waiting for a frame")?;
        self.stream.begin().doing("beginning a frame")?;
        let turn = FrameTurn {
            own_time_ns: state.predicted_display_time.as_nanos(),
            display_time: self.monotonic(&state)?,
            period_ns: state.predicted_display_period.as_nanos(),
            should_render: state.should_render,
        };
        self.move_about(turn.display_time)?;
        Ok(turn)
    }

    /// Does what the controllers ask for, until a frame's display time.
    fn move_about(&mut self, display_time: ClientTime) -> Result<(), XrError> {
        let asked = self.actions.asked(&self.session)?;
        self.exit_requested |= asked.leaves;
        self.wants_figures ^= asked.toggles_figures;
        self.presses.nexts += u32::from(asked.goes_to_next);
        self.presses.takes += u32::from(asked.takes);
        self.presses.halts += u32::from(asked.halts);
        self.presses.steps += u32::from(asked.steps);
        if let Some(views) = &self.last_views {
            self.locomotion.step(asked.wish, views.stage_from_head, display_time);
        }
        Ok(())
    }

    /// When the frame of `state`, which was just waited for, is seen on the client's monotonic clock.
    fn monotonic(&mut self, state: &openxr::FrameState) -> Result<ClientTime, XrError> {
        let (time, period_ns) = (state.predicted_display_time, state.predicted_display_period.as_nanos());
        let instance = &self.device.instance;
        match time::converted(instance, time) {
            Some(converted) => converted.doing("converting a time"),
            None => Ok(self.clock.convert(time.as_nanos(), monotonic_now(), period_ns)),
        }
    }

    /// Where head and eyes will be when the frame is seen. Call it as late as possible. Tracking that is lost leaves the
    /// head where it was last.
    fn locate_views(&mut self, turn: &FrameTurn) -> Result<Views, XrError> {
        let time = openxr::Time::from_nanos(turn.own_time_ns);
        let info = sys::ViewLocateInfo {
            ty: sys::ViewLocateInfo::TYPE,
            next: std::ptr::null(),
            view_configuration_type: VIEW_CONFIGURATION,
            display_time: time,
            space: self.stage.as_raw(),
        };
        let mut state = sys::ViewState {
            ty: sys::ViewState::TYPE,
            next: std::ptr::null_mut(),
            view_state_flags: sys::ViewStateFlags::EMPTY,
        };
        let blank = sys::View {
            ty: sys::View::TYPE,
            next: std::ptr::null_mut(),
            pose: openxr::Posef::IDENTITY,
            fov: openxr::Fovf::default(),
        };
        let mut views = [blank; 2];
        let mut count = 0;
        let locate = self.device.instance.fp().locate_views;
        // SAFETY: session and space are alive; the array has the two places that are announced.
        let result =
            unsafe { locate(self.session.as_raw(), &info, &mut state, 2, &mut count, views.as_mut_ptr()) };
        succeeded(result).doing("locating the eyes")?;
        let (stage_from_head, velocity) = self.locate_head(time)?;
        let valid = sys::ViewStateFlags::ORIENTATION_VALID | sys::ViewStateFlags::POSITION_VALID;
        let mut located = Views {
            stage_from_head,
            linear_velocity: velocity_of(
                velocity.linear_velocity,
                velocity.velocity_flags,
                sys::SpaceVelocityFlags::LINEAR_VALID,
            ),
            angular_velocity: velocity_of(
                velocity.angular_velocity,
                velocity.velocity_flags,
                sys::SpaceVelocityFlags::ANGULAR_VALID,
            ),
            stage_from_eye: views.map(|view| pose_of(view.pose)),
            fov: views.map(|view| fov_of(view.fov)),
            stage_from_hand: self.actions.locate_hands(&self.stage, time)?,
            jumps: self.jumps.until(turn.own_time_ns),
        };
        if count != 2 || !state.view_state_flags.contains(valid) || !located.is_valid() {
            let Views { jumps, stage_from_hand, .. } = located;
            located = Views {
                jumps,
                stage_from_hand,
                ..self.last_views.unwrap_or_else(|| located.without_tracking())
            };
        }
        self.last_views = Some(located);
        Ok(self.locomotion.apply(&located))
    }

    /// The head in the stage, and how it moves. `openxr::Space::relate` would hand over a velocity whose flags are whatever
    /// lay on the stack, at which the core validation layer ends the program.
    fn locate_head(&self, time: openxr::Time) -> Result<(Pose, sys::SpaceVelocity), XrError> {
        let mut velocity = sys::SpaceVelocity {
            ty: sys::SpaceVelocity::TYPE,
            next: std::ptr::null_mut(),
            velocity_flags: sys::SpaceVelocityFlags::EMPTY,
            linear_velocity: openxr::Vector3f::default(),
            angular_velocity: openxr::Vector3f::default(),
        };
        let mut location = sys::SpaceLocation {
            ty: sys::SpaceLocation::TYPE,
            next: (&raw mut velocity).cast(),
            location_flags: sys::SpaceLocationFlags::EMPTY,
            pose: openxr::Posef::IDENTITY,
        };
        let locate = self.device.instance.fp().locate_space;
        // SAFETY: both spaces are alive and of one session; the two structs say what they are and live through the call.
        let result = unsafe { locate(self.head.as_raw(), self.stage.as_raw(), time, &mut location) };
        succeeded(result).doing("locating the head")?;
        Ok((pose_of(location.pose), velocity))
    }

    /// Ends a frame that shows nothing.
    fn end_empty_frame(&mut self, turn: FrameTurn) -> Result<(), XrError> {
        let time = openxr::Time::from_nanos(turn.own_time_ns);
        self.stream.end(time, self.blend_mode, &[]).doing("ending a frame")
    }

    /// Ends a frame: the last released image of `swapchain` is shown as seen from where the eyes were located last.
    fn end_frame(&mut self, turn: FrameTurn, swapchain: &Swapchain) -> Result<(), XrError> {
        self.drawn_views = self.last_views;
        self.end_same_frame(turn, swapchain)
    }

    /// Ends a frame for which no image was released: the runtime turns the one before to where the head is by now.
    fn end_same_frame(&mut self, turn: FrameTurn, swapchain: &Swapchain) -> Result<(), XrError> {
        // In the room, wherever that is in the world.
        let Some(views) = &self.drawn_views else { return self.end_empty_frame(turn) };
        let [width, height] = swapchain.extent_pixels.map(|side| side as i32);
        let rect = openxr::Rect2Di {
            offset: openxr::Offset2Di { x: 0, y: 0 },
            extent: openxr::Extent2Di { width, height },
        };
        let view = |eye: usize| {
            let image = openxr::SwapchainSubImage::new()
                .swapchain(&swapchain.handle)
                .image_array_index(eye as u32)
                .image_rect(rect);
            openxr::CompositionLayerProjectionView::new()
                .pose(posef_of(views.stage_from_eye[eye]))
                .fov(fovf_of(views.fov[eye]))
                .sub_image(image)
        };
        let projected = [view(0), view(1)];
        let layer = openxr::CompositionLayerProjection::new().space(&self.stage).views(&projected);
        let time = openxr::Time::from_nanos(turn.own_time_ns);
        self.stream.end(time, self.blend_mode, &[&layer]).doing("ending a frame")
    }
}

fn open_session(
    instance: &openxr::Instance,
    system: openxr::SystemId,
    gpu: &Arc<Gpu>,
) -> Result<
    (openxr::Session<openxr::Vulkan>, openxr::FrameWaiter, openxr::FrameStream<openxr::Vulkan>),
    XrError,
> {
    let info = openxr::vulkan::SessionCreateInfo {
        instance: gpu.instance().handle().as_raw() as usize as *const _,
        physical_device: gpu.physical_device().as_raw() as usize as *const _,
        device: gpu.device().handle().as_raw() as usize as *const _,
        queue_family_index: gpu.queue_family(),
        queue_index: 0,
    };
    // SAFETY: the handles are alive and stay so: the guard keeps the device until the session is gone. The queue is
    // used on the thread that makes the frame calls, and nowhere else while they run.
    let session =
        unsafe { instance.create_session_with_guard::<openxr::Vulkan>(system, &info, Box::new(gpu.clone())) };
    session.doing("creating the OpenXR session")
}

/// The room with its floor; where the runtime knows none, one that lies at an assumed height below the eyes.
fn open_stage(session: &openxr::Session<openxr::Vulkan>) -> Result<openxr::Space, XrError> {
    let known = session.enumerate_reference_spaces().doing("listing spaces")?;
    let space = if known.contains(&openxr::ReferenceSpaceType::STAGE) {
        session.create_reference_space(openxr::ReferenceSpaceType::STAGE, openxr::Posef::IDENTITY)
    } else {
        let floor =
            Pose { position: Vec3::new(0.0, -ASSUMED_EYE_HEIGHT_M, 0.0), orientation: Quat::IDENTITY };
        session.create_reference_space(openxr::ReferenceSpaceType::LOCAL, posef_of(floor))
    };
    space.doing("creating the stage's space")
}

impl Swapchain {
    fn open(
        instance: &openxr::Instance,
        system: openxr::SystemId,
        session: &openxr::Session<openxr::Vulkan>,
        foveation: Option<Foveation>,
    ) -> Result<Self, XrError> {
        let views = instance.enumerate_view_configuration_views(system, VIEW_CONFIGURATION);
        let views = views.doing("asking for the size of the views")?;
        let side = |of: fn(&openxr::ViewConfigurationView) -> u32| views.iter().map(of).max().unwrap_or(1);
        let extent_pixels =
            [side(|v| v.recommended_image_rect_width), side(|v| v.recommended_image_rect_height)];
        let offered = session.enumerate_swapchain_formats().doing("listing swapchain formats")?;
        let format =
            REQUIRED.eye_formats.into_iter().find(|format| offered.contains(&(format.as_raw() as u32)));
        let format = format.ok_or(XrError::NoFormat)?;
        let info = openxr::SwapchainCreateInfo {
            create_flags: openxr::SwapchainCreateFlags::EMPTY,
            usage_flags: openxr::SwapchainUsageFlags::COLOR_ATTACHMENT,
            format: format.as_raw() as u32,
            sample_count: 1,
            width: extent_pixels[0],
            height: extent_pixels[1],
            face_count: 1,
            array_size: 2,
            mip_count: 1,
        };
        let foveated = foveation.and_then(|foveation| {
            let made = foveation::open(session, &info, foveation);
            made.inspect_err(|error| tracing::warn!("fixed foveation is off: {error}")).ok()
        });
        let (handle, images, maps) = match foveated {
            Some((handle, images, maps)) => (handle, images, Some(maps)),
            None => {
                let handle = session.create_swapchain(&info).doing("creating the swapchain")?;
                let images = handle.enumerate_images().doing("listing the swapchain's images")?;
                (handle, images.into_iter().map(vk::Image::from_raw).collect(), None)
            }
        };
        Ok(Self { handle, images, maps, format, extent_pixels, is_acquired: false })
    }

    /// Takes the next image to draw to, waiting until the compositor has done with it.
    fn acquire(&mut self) -> Result<usize, XrError> {
        let index = self.handle.acquire_image().doing("acquiring an image")? as usize;
        self.is_acquired = true;
        self.handle.wait_image(openxr::Duration::INFINITE).doing("waiting for an image")?;
        Ok(index)
    }

    /// Gives the image, drawn to by submitted work, to the compositor.
    fn release(&mut self) -> Result<(), XrError> {
        self.is_acquired = false;
        self.handle.release_image().doing("releasing an image")
    }
}

impl Drop for Swapchain {
    fn drop(&mut self) {
        if self.is_acquired {
            // Only on the way out of a failed frame: what remains of the session is ended by who sees the error.
            let _ = self.handle.release_image();
        }
    }
}

fn nearest(rates_hz: &[f32], wanted: f32) -> Option<f32> {
    let apart = |hz: &f32| (hz - wanted).abs();
    rates_hz.iter().copied().filter(|hz| hz.is_finite()).min_by(|a, b| apart(a).total_cmp(&apart(b)))
}

fn succeeded(result: sys::Result) -> Result<(), sys::Result> {
    if result.into_raw() >= 0 { Ok(()) } else { Err(result) }
}

fn pose_of(pose: openxr::Posef) -> Pose {
    let openxr::Posef { position: p, orientation: o } = pose;
    let orientation = Quat::from_xyzw(o.x, o.y, o.z, o.w);
    Pose { position: Vec3::new(p.x, p.y, p.z), orientation }
}

fn posef_of(pose: Pose) -> openxr::Posef {
    let (p, o) = (pose.position, pose.orientation);
    openxr::Posef {
        position: openxr::Vector3f { x: p.x, y: p.y, z: p.z },
        orientation: openxr::Quaternionf { x: o.x, y: o.y, z: o.z, w: o.w },
    }
}

fn velocity_of(v: openxr::Vector3f, flags: sys::SpaceVelocityFlags, valid: sys::SpaceVelocityFlags) -> Vec3 {
    let velocity = Vec3::new(v.x, v.y, v.z);
    if flags.contains(valid) && velocity.is_finite() { velocity } else { Vec3::ZERO }
}

fn fov_of(fov: openxr::Fovf) -> Fov {
    Fov { left: fov.angle_left, right: fov.angle_right, up: fov.angle_up, down: fov.angle_down }
}

fn fovf_of(fov: Fov) -> openxr::Fovf {
    openxr::Fovf { angle_left: fov.left, angle_right: fov.right, angle_up: fov.up, angle_down: fov.down }
}
