//! The mock runtime behind the system's real OpenXR loader, used by a small application.
//!
//! The loader reads the environment at `xrCreateInstance`, and the runtime has one instance: the tests take turns.

mod support;

use std::collections::BTreeMap;
use std::path::Path;

use ash::vk;
use openxr as xr;
use shadecast_mock_runtime::clock::{period_begin_ns, period_ns};
use shadecast_mock_runtime::config::{
    ClockKind, EventKind, FovDegrees, MockConfig, ScriptedEvent, ScriptedHand, ScriptedInput,
};
use shadecast_mock_runtime::head_path::HeadPath;
use shadecast_mock_runtime::record::{FrameRecord, PoseRecord, Side, read_frames, read_summary};
use shadecast_test_support::headset::Run;
use support::{App, STEREO, converts_time, create_instance, load, picture, rect, validation_messages, view};
use xr::sys::{Handle as _, Result as Code};

const SIZE: [u32; 2] = [48, 32];
const WHOLE: [i32; 4] = [0, 0, SIZE[0] as i32, SIZE[1] as i32];

/// One metre to the right and a quarter turn to the left in one second.
const WALK: &str = "t_s,x,y,z,qx,qy,qz,qw\n0,0,1.7,0,0,0,0,1\n1,1,1.7,0,0,0.70710678,0,0.70710678\n";

fn virtual_config() -> MockConfig {
    MockConfig { extent_pixels: SIZE, clock: ClockKind::Virtual, capture_every: 5, ..MockConfig::default() }
}

fn with_walk(run: &Run, config: &MockConfig) {
    let path = run.folder().join("walk.csv");
    std::fs::write(&path, WALK).expect("write the head path");
    let config = MockConfig { head_path: Some(path), capture_dir: Some(run.captures()), ..config.clone() };
    config.write(&run.config_path()).expect("write the configuration");
}

/// A texel that tells frame, eye and place apart.
fn pattern(frame: u64, eye: u32, x: u32, y: u32) -> [u8; 4] {
    [(x * 5) as u8, (y * 7) as u8, (frame as u32 * 2 + eye * 128) as u8, 200]
}

fn rgb_of(size: [u32; 2], texel: impl Fn(u32, u32) -> [u8; 4]) -> Vec<u8> {
    let places = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
    places.flat_map(|(x, y)| <[u8; 3]>::try_from(&texel(x, y)[..3]).expect("3 of 4")).collect()
}

/// Draws and submits one frame of a multiview swapchain, as the client does; nothing where it is not seen.
fn multiview_frame(app: &mut App, swapchain: &mut xr::Swapchain<xr::Vulkan>, frame: u64) -> xr::FrameState {
    let state = app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    let time = state.predicted_display_time;
    if !state.should_render {
        app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end");
        return state;
    }
    let images = swapchain.enumerate_images().expect("images");
    let image = images[swapchain.acquire_image().expect("acquire") as usize];
    swapchain.wait_image(xr::Duration::INFINITE).expect("wait for the image");
    for eye in 0..2 {
        app.gpu.paint(image, eye, SIZE, |x, y| pattern(frame, eye, x, y));
    }
    swapchain.release_image().expect("release");
    let (_, views) = app.session.locate_views(STEREO, time, &app.stage).expect("views");
    let [x, y, width, height] = WHOLE;
    let parts = [0, 1].map(|eye| view(swapchain, eye as u32, rect(x, y, width, height), &views[eye]));
    let layer = xr::CompositionLayerProjection::new().space(&app.stage).views(&parts);
    app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&layer]).expect("end");
    state
}

/// Runs 20 frames; gives every file of the capture folder.
fn twenty_frames(config: &MockConfig) -> (Run, BTreeMap<String, Vec<u8>>) {
    let run = Run::new(config);
    with_walk(&run, config);
    let mut app = App::begun();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    for frame in 0..20 {
        let state = multiview_frame(&mut app, &mut swapchain, frame);
        assert_eq!(state.should_render, frame > 0, "frame {frame}");
    }
    app.session.request_exit().expect("running");
    app.states();
    app.end();
    drop(swapchain);
    drop(app);
    let files = std::fs::read_dir(run.captures()).expect("captures").map(|entry| {
        let path = entry.expect("entry").path();
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        (name, std::fs::read(&path).expect("read"))
    });
    let files = files.collect();
    (run, files)
}

#[track_caller]
fn assert_near(a: PoseRecord, b: PoseRecord) {
    let differences = a.position.iter().zip(b.position).chain(a.orientation.iter().zip(b.orientation));
    for (a_part, b_part) in differences {
        assert!((a_part - b_part).abs() < 1e-5, "{a:?} is not {b:?}");
    }
}

#[test]
fn twenty_frames_come_out_as_they_were_drawn() {
    let before = validation_messages();
    let (run, files) = twenty_frames(&virtual_config());
    for frame in [5, 10, 15] {
        for (eye, side) in Side::BOTH.into_iter().enumerate() {
            let (size, pixels) = picture(&run.captures(), frame, side);
            assert_eq!(size, SIZE);
            assert!(
                pixels == rgb_of(SIZE, |x, y| pattern(frame, eye as u32, x, y)),
                "frame {frame} {side:?}"
            );
        }
    }
    assert_eq!(files.len(), 3 * 2 + 2, "three pairs of pictures, log, summary: {:?}", files.keys());
    let summary = read_summary(&run.captures()).expect("summary");
    assert_eq!((summary.frames, summary.errors, summary.missed_frames), (20, 0, 0));
    assert_eq!((summary.captured_frames, summary.empty_frames, summary.discarded_frames), (3, 1, 0));
    assert!((summary.seconds - 19.0 / 72.0).abs() < 1e-9, "{}", summary.seconds);
    assert_eq!(validation_messages(), before, "validation messages");
}

#[test]
fn the_log_holds_times_poses_and_fields_of_view_of_every_frame() {
    let fov = FovDegrees { left: 50.0, right: 40.0, up: 44.0, down: 48.0 };
    let (run, _) =
        twenty_frames(&MockConfig { fov_degrees: fov, virtual_start_ns: 7_000, ..virtual_config() });
    let frames = read_frames(&run.captures()).expect("log");
    let path = HeadPath::parse(WALK, "walk").expect("valid");
    assert_eq!(frames.len(), 20);
    for (index, frame) in (0u64..).zip(&frames) {
        assert_eq!(frame.frame, index);
        assert_eq!(frame.wait_time_ns, period_begin_ns(7_000, 72.0, index));
        assert_eq!(frame.predicted_display_time_ns, period_begin_ns(7_000, 72.0, index + 1));
        let head = path.pose_at((frame.predicted_display_time_ns - 7_000) as f64 * 1e-9);
        assert_near(frame.head_pose, head.into());
        assert_eq!((frame.empty, frame.captured), (index == 0, index > 0 && index % 5 == 0));
        check_views(frame, fov);
    }
}

/// Eyes 63 mm apart on the head's x axis, each with its own field of view.
fn check_views(frame: &FrameRecord, fov: FovDegrees) {
    if frame.empty {
        assert!(frame.views.is_empty());
        return;
    }
    let head = shadecast_protocol::pose::Pose::from(frame.head_pose);
    for (view, (x, fov)) in frame.views.iter().zip([(-0.0315, fov.left_eye()), (0.0315, fov.right_eye())]) {
        let eye = PoseRecord {
            position: (head.position + head.orientation * glam::Vec3::new(x, 0.0, 0.0)).to_array(),
            orientation: head.orientation.to_array(),
        };
        assert_near(view.pose, eye);
        assert_near(view.stage_pose, eye);
        assert_eq!(view.frustum(), fov);
    }
}

#[test]
fn two_runs_on_the_virtual_clock_give_identical_files() {
    let (first_run, first) = twenty_frames(&virtual_config());
    drop(first_run);
    let (_second_run, second) = twenty_frames(&virtual_config());
    assert_eq!(first.keys().collect::<Vec<_>>(), second.keys().collect::<Vec<_>>());
    for (name, bytes) in &first {
        assert!(bytes == &second[name], "{name} differs between the runs");
    }
}

#[test]
fn two_plain_swapchains_with_partial_rects_are_captured_too() {
    let before = validation_messages();
    let run = Run::new(&MockConfig { capture_every: 1, ..virtual_config() });
    let mut app = App::begun();
    app.empty_frame();
    let mut chains = [0, 1].map(|_| app.swapchain(vk::Format::B8G8R8A8_SRGB, SIZE, 1));
    let state = app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    for (eye, chain) in chains.iter_mut().enumerate() {
        let images = chain.enumerate_images().expect("images");
        assert_eq!(images.len(), 3);
        let image = images[chain.acquire_image().expect("acquire") as usize];
        chain.wait_image(xr::Duration::INFINITE).expect("wait for the image");
        app.gpu.paint(image, 0, SIZE, |x, y| pattern(1, eye as u32, x, y));
        chain.release_image().expect("release");
    }
    let time = state.predicted_display_time;
    let (_, views) = app.session.locate_views(STEREO, time, &app.stage).expect("views");
    let parts = [0, 1].map(|eye| view(&chains[eye], 0, rect(4, 2, 16, 8), &views[eye]));
    let layer = xr::CompositionLayerProjection::new().space(&app.stage).views(&parts);
    app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&layer]).expect("end");
    drop(chains);
    drop(app);
    for (eye, side) in Side::BOTH.into_iter().enumerate() {
        let (size, pixels) = picture(&run.captures(), 1, side);
        assert_eq!(size, [16, 8]);
        let expected = rgb_of(size, |x, y| {
            let [b, g, r, a] = pattern(1, eye as u32, x + 4, y + 2);
            [r, g, b, a]
        });
        assert!(pixels == expected, "{side:?}");
    }
    assert_eq!(validation_messages(), before, "validation messages");
}

#[test]
fn the_system_is_a_stereo_headset_of_the_configured_size() {
    let _run = Run::new(&virtual_config());
    let app = App::new();
    let (instance, system) = (&app.instance, app.system);
    assert_eq!(instance.properties().expect("properties").runtime_name, "Shadecast mock runtime");
    assert_eq!(instance.enumerate_view_configurations(system).expect("views"), [STEREO]);
    let views = instance.enumerate_view_configuration_views(system, STEREO).expect("views");
    assert_eq!(views.len(), 2);
    for view in views {
        assert_eq!([view.recommended_image_rect_width, view.recommended_image_rect_height], SIZE);
    }
    let modes = instance.enumerate_environment_blend_modes(system, STEREO).expect("modes");
    assert_eq!(modes, [xr::EnvironmentBlendMode::OPAQUE]);
    let formats = app.session.enumerate_swapchain_formats().expect("formats");
    let wanted =
        [vk::Format::R8G8B8A8_SRGB, vk::Format::B8G8R8A8_SRGB, vk::Format::D32_SFLOAT, vk::Format::D16_UNORM];
    let wanted = wanted.map(|format| format.as_raw() as u32);
    assert_eq!(formats, wanted);
    assert_eq!(app.session.enumerate_reference_spaces().expect("spaces").len(), 3);
    let hand = instance.system(xr::FormFactor::HANDHELD_DISPLAY);
    assert_eq!(hand.expect_err("a headset"), Code::ERROR_FORM_FACTOR_UNSUPPORTED);
    let text = instance.result_to_string(Code::ERROR_CALL_ORDER_INVALID).expect("text");
    assert_eq!(text, "XR_ERROR_CALL_ORDER_INVALID");
}

#[test]
fn unknown_functions_are_unsupported_and_null() {
    let _run = Run::new(&virtual_config());
    let entry = load();
    let instance = create_instance(&entry).expect("instance");
    for name in [c"xrNoSuchFunction", c"xrGetVisibilityMaskKHR", c"xrCreateHandTrackerEXT"] {
        let nonsense = get_unsupported as unsafe extern "system" fn();
        let mut function = Some(nonsense);
        // SAFETY: a valid instance, a zero-terminated name, and a place for the answer.
        let code =
            unsafe { (entry.fp().get_instance_proc_addr)(instance.as_raw(), name.as_ptr(), &mut function) };
        assert_eq!((code, function), (Code::ERROR_FUNCTION_UNSUPPORTED, None), "{name:?}");
    }
}

/// Stands where a null pointer is expected.
unsafe extern "system" fn get_unsupported() {}

#[test]
fn levels_of_performance_are_those_of_the_specification() {
    let run = Run::new(&virtual_config());
    let app = App::new();
    let performance = app.instance.exts().ext_performance_settings.expect("it was asked for");
    let ask = |domain, level| {
        let [domain, level] = [domain, level].map(i32::from);
        let domain = xr::sys::PerfSettingsDomainEXT::from_raw(domain);
        let level = xr::sys::PerfSettingsLevelEXT::from_raw(level);
        // SAFETY: the session is alive, and the others are numbers.
        unsafe { (performance.perf_settings_set_performance_level)(app.session.as_raw(), domain, level) }
    };
    assert_eq!([ask(1, 75), ask(2, 25), ask(2, 50)], [Code::SUCCESS; 3]);
    assert_eq!([ask(0, 50), ask(3, 50), ask(1, 51), ask(1, -1)], [Code::ERROR_VALIDATION_FAILURE; 4]);
    drop(app);
    let summary = read_summary(&run.captures()).expect("a summary");
    assert_eq!((summary.performance_levels, summary.errors), ([75, 50], 4));
}

#[test]
fn foveation_is_what_the_specification_says() {
    let run = Run::new(&MockConfig { foveation: true, ..virtual_config() });
    let app = App::foveated();
    let exts = app.instance.exts();
    let (profiles, states) =
        (exts.fb_foveation.expect("enabled"), exts.fb_swapchain_update_state.expect("enabled"));
    let profile = |level: i32| {
        let level = xr::FoveationLevelProfile {
            level: xr::sys::FoveationLevelFB::from_raw(level),
            vertical_offset: 0.0,
            dynamic: xr::sys::FoveationDynamicFB::DISABLED,
        };
        app.session.create_foveation_profile(Some(level))
    };
    assert_eq!(profile(4).map(|_| ()), Err(Code::ERROR_VALIDATION_FAILURE));
    let high = profile(3).expect("a level that there is");
    // Without maps there is no state to update.
    let plain = app.swapchain(vk::Format::R8G8B8A8_SRGB, [64, 64], 2);
    let mut state = xr::sys::SwapchainStateFoveationFB {
        ty: xr::sys::SwapchainStateFoveationFB::TYPE,
        next: std::ptr::null_mut(),
        flags: xr::sys::SwapchainStateFoveationFlagsFB::EMPTY,
        profile: high.as_raw(),
    };
    // SAFETY: the swapchain is alive, and the struct says what it is.
    let update = |swapchain: &xr::Swapchain<xr::Vulkan>, state: &xr::sys::SwapchainStateFoveationFB| unsafe {
        (states.update_swapchain)(swapchain.as_raw(), std::ptr::from_ref(state).cast())
    };
    assert_eq!(update(&plain, &state), Code::ERROR_VALIDATION_FAILURE);
    state.profile = xr::sys::FoveationProfileFB::from_raw(12);
    assert_eq!(update(&plain, &state), Code::ERROR_HANDLE_INVALID);
    // SAFETY: no such profile: it is refused.
    assert_eq!(unsafe { (profiles.destroy_foveation_profile)(state.profile) }, Code::ERROR_HANDLE_INVALID);
    drop((high, plain));
    drop(app);
    let summary = read_summary(&run.captures()).expect("a summary");
    assert_eq!((summary.foveation_level, summary.errors), (0, 4));
}

/// A swapchain with density maps.
fn foveated_swapchain(app: &App) -> xr::Swapchain<xr::Vulkan> {
    let foveation = xr::sys::SwapchainCreateInfoFoveationFB {
        ty: xr::sys::SwapchainCreateInfoFoveationFB::TYPE,
        next: std::ptr::null_mut(),
        flags: xr::sys::SwapchainCreateFoveationFlagsFB::FRAGMENT_DENSITY_MAP,
    };
    let info = xr::sys::SwapchainCreateInfo {
        ty: xr::sys::SwapchainCreateInfo::TYPE,
        next: std::ptr::from_ref(&foveation).cast(),
        create_flags: xr::SwapchainCreateFlags::EMPTY,
        usage_flags: xr::SwapchainUsageFlags::COLOR_ATTACHMENT,
        format: i64::from(vk::Format::R8G8B8A8_SRGB.as_raw()),
        sample_count: 1,
        width: SIZE[0],
        height: SIZE[1],
        face_count: 1,
        array_size: 2,
        mip_count: 1,
    };
    let mut swapchain = xr::sys::Swapchain::NULL;
    // SAFETY: a valid session, and structures and a place that live through the call.
    unsafe {
        let made = (app.instance.fp().create_swapchain)(app.session.as_raw(), &info, &mut swapchain);
        assert_eq!(made, Code::SUCCESS);
        xr::Swapchain::from_raw(app.session.clone(), swapchain)
    }
}

#[test]
fn a_swapchain_tells_its_foveation_profile_while_there_is_one() {
    let run = Run::new(&MockConfig { foveation: true, ..virtual_config() });
    let app = App::foveated();
    let states = app.instance.exts().fb_swapchain_update_state.expect("enabled");
    let profile = app.session.create_foveation_profile(None).expect("a profile");
    let swapchain = foveated_swapchain(&app);
    let mut state = xr::sys::SwapchainStateFoveationFB {
        ty: xr::sys::SwapchainStateFoveationFB::TYPE,
        next: std::ptr::null_mut(),
        flags: xr::sys::SwapchainStateFoveationFlagsFB::EMPTY,
        profile: profile.as_raw(),
    };
    let raw = swapchain.as_raw();
    // SAFETY: the swapchain is alive, and the struct says what it is.
    let updated = unsafe { (states.update_swapchain)(raw, std::ptr::from_ref(&state).cast()) };
    assert_eq!(updated, Code::SUCCESS);
    let mut told = || {
        // SAFETY: as above.
        let code = unsafe { (states.get_swapchain_state)(raw, std::ptr::from_mut(&mut state).cast()) };
        assert_eq!(code, Code::SUCCESS);
        state.profile
    };
    assert_eq!(told(), profile.as_raw());
    drop(profile);
    assert_eq!(told(), xr::sys::FoveationProfileFB::NULL, "there is no handle of a destroyed one");
    drop((swapchain, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 0);
}

#[test]
fn calls_out_of_order_are_refused_and_counted() {
    let run = Run::new(&virtual_config());
    let mut app = App::new();
    let order = Code::ERROR_CALL_ORDER_INVALID;
    assert_eq!(app.waiter.wait().expect_err("not begun"), Code::ERROR_SESSION_NOT_RUNNING);
    app.session.begin(STEREO).expect("READY");
    assert_eq!(app.session.begin(STEREO).expect_err("running"), Code::ERROR_SESSION_RUNNING);
    assert_eq!(app.session.end().expect_err("not STOPPING"), Code::ERROR_SESSION_NOT_STOPPING);
    assert_eq!(app.stream.begin().expect_err("begin before wait"), order);
    let opaque = xr::EnvironmentBlendMode::OPAQUE;
    let early = app.stream.end(xr::Time::from_nanos(1), opaque, &[]);
    assert_eq!(early.expect_err("end before begin"), order);
    let state = app.waiter.wait().expect("wait");
    let early = app.stream.end(state.predicted_display_time, opaque, &[]);
    assert_eq!(early.expect_err("end before begin"), order);
    app.stream.begin().expect("begin");
    assert_eq!(app.stream.begin().expect_err("begin twice"), order);
    let never = app.stream.end(xr::Time::from_nanos(0), opaque, &[]);
    assert_eq!(never.expect_err("no time"), Code::ERROR_TIME_INVALID);
    let late = xr::Time::from_nanos(state.predicted_display_time.as_nanos() + 1);
    app.stream.end(late, opaque, &[]).expect("end after a refused end, for another time");
    let swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    swapchain_order(&app, &swapchain);
    drop(swapchain);
    drop(app);
    let summary = read_summary(&run.captures()).expect("summary");
    assert_eq!((summary.errors, summary.other_display_times), (8 + 3, 1), "{summary:?}");
}

fn swapchain_order(app: &App, swapchain: &xr::Swapchain<xr::Vulkan>) {
    let (fp, handle) = (app.instance.fp(), swapchain.as_raw());
    let order = Code::ERROR_CALL_ORDER_INVALID;
    let wait_info = xr::sys::SwapchainImageWaitInfo {
        ty: xr::sys::SwapchainImageWaitInfo::TYPE,
        next: std::ptr::null(),
        timeout: xr::Duration::INFINITE,
    };
    let mut index = 0;
    // SAFETY: a valid swapchain, and valid or null structures.
    unsafe {
        assert_eq!((fp.wait_swapchain_image)(handle, &wait_info), order, "wait before acquire");
        assert_eq!((fp.release_swapchain_image)(handle, std::ptr::null()), order, "release before acquire");
        for _ in 0..3 {
            assert_eq!((fp.acquire_swapchain_image)(handle, std::ptr::null(), &mut index), Code::SUCCESS);
        }
        assert_eq!(
            (fp.acquire_swapchain_image)(handle, std::ptr::null(), &mut index),
            order,
            "no image left"
        );
    }
}

/// What converts times on this system.
const TIME_EXTENSION: &str = if cfg!(windows) {
    "XR_KHR_win32_convert_performance_counter_time"
} else {
    "XR_KHR_convert_timespec_time"
};

#[test]
fn an_extension_that_is_hidden_is_not_listed_and_is_refused() {
    let hidden_extensions = vec![TIME_EXTENSION.to_owned()];
    let _run = Run::new(&MockConfig { hidden_extensions, ..virtual_config() });
    let entry = load();
    let mut listed = entry.enumerate_extensions().expect("extensions");
    assert!(listed.khr_vulkan_enable2 && !*converts_time(&mut listed));
    let refused = create_instance(&entry).err();
    assert_eq!(
        refused,
        Some(Code::ERROR_EXTENSION_NOT_PRESENT),
        "it asks for all that the runtime usually has"
    );
}

#[test]
fn no_layer_shows_a_depth_swapchain() {
    type Usage = xr::SwapchainUsageFlags;
    let run = Run::new(&virtual_config());
    let mut app = App::begun();
    app.empty_frame();
    let create = |format: vk::Format, usage_flags| {
        app.session.create_swapchain(&xr::SwapchainCreateInfo {
            create_flags: xr::SwapchainCreateFlags::EMPTY,
            usage_flags,
            format: format.as_raw() as u32,
            sample_count: 1,
            width: SIZE[0],
            height: SIZE[1],
            face_count: 1,
            array_size: 2,
            mip_count: 1,
        })
    };
    let unsupported = Some(Code::ERROR_FEATURE_UNSUPPORTED);
    for (format, usage) in [
        (vk::Format::D32_SFLOAT, Usage::COLOR_ATTACHMENT),
        (vk::Format::D16_UNORM, Usage::DEPTH_STENCIL_ATTACHMENT | Usage::UNORDERED_ACCESS),
        (vk::Format::R8G8B8A8_SRGB, Usage::DEPTH_STENCIL_ATTACHMENT),
    ] {
        assert_eq!(create(format, usage).err(), unsupported, "{format:?} as {usage:?}");
    }
    let usage = Usage::DEPTH_STENCIL_ATTACHMENT | Usage::SAMPLED;
    let chains = [vk::Format::D32_SFLOAT, vk::Format::D16_UNORM].map(|format| create(format, usage));
    let state = app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    let time = state.predicted_display_time;
    let (_, views) = app.session.locate_views(STEREO, time, &app.stage).expect("views");
    let [x, y, width, height] = WHOLE;
    for chain in chains {
        let mut chain = chain.expect("a depth swapchain");
        for _ in 0..4 {
            chain.acquire_image().expect("acquire");
            chain.wait_image(xr::Duration::INFINITE).expect("wait");
            chain.release_image().expect("release");
        }
        let parts = [0, 1].map(|eye| view(&chain, eye as u32, rect(x, y, width, height), &views[eye]));
        let layer = xr::CompositionLayerProjection::new().space(&app.stage).views(&parts);
        let refused = app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&layer]);
        assert_eq!(refused.expect_err("depths are no colours"), Code::ERROR_LAYER_INVALID);
    }
    app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end");
    drop(app);
    assert_eq!(validation_messages(), 0);
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 3 + 2);
}

#[test]
fn a_frame_that_is_begun_and_not_ended_is_discarded() {
    let run = Run::new(&virtual_config());
    let mut app = App::begun();
    app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    let state = app.waiter.wait().expect("wait");
    // SAFETY: a valid session, and a null structure, which is allowed.
    let code = unsafe { (app.instance.fp().begin_frame)(app.session.as_raw(), std::ptr::null()) };
    assert_eq!(code, Code::FRAME_DISCARDED);
    app.stream.end(state.predicted_display_time, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end");
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    assert_eq!(frames.iter().map(|frame| frame.discarded).collect::<Vec<_>>(), [true, false]);
    assert_eq!(read_summary(&run.captures()).expect("summary").discarded_frames, 1);
}

#[test]
fn layers_that_break_a_rule_are_refused() {
    let run = Run::new(&virtual_config());
    let mut app = App::begun();
    app.empty_frame();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    let state = app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    let time = state.predicted_display_time;
    let (_, views) = app.session.locate_views(STEREO, time, &app.stage).expect("views");
    let [x, y, width, height] = WHOLE;
    let whole = rect(x, y, width, height);
    let mut submit = |swapchain: &xr::Swapchain<xr::Vulkan>, left: xr::Rect2Di, index, located: &xr::View| {
        let parts = [view(swapchain, index, left, located), view(swapchain, 1, whole, &views[1])];
        let layer = xr::CompositionLayerProjection::new().space(&app.stage).views(&parts);
        app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&layer])
    };
    let unreleased = submit(&swapchain, whole, 0, &views[0]);
    assert_eq!(unreleased.expect_err("nothing released"), Code::ERROR_LAYER_INVALID);
    release_next(&mut swapchain);
    for outside in [rect(1, 0, width, height), rect(0, -1, width, height), rect(0, 0, 0, height)] {
        let refused = submit(&swapchain, outside, 0, &views[0]);
        assert_eq!(refused.expect_err("outside"), Code::ERROR_SWAPCHAIN_RECT_INVALID, "{outside:?}");
    }
    let third = submit(&swapchain, whole, 2, &views[0]);
    assert_eq!(third.expect_err("two layers only"), Code::ERROR_VALIDATION_FAILURE);
    let mut bad = views[0];
    bad.pose.orientation.w = 0.5;
    assert_eq!(submit(&swapchain, whole, 0, &bad).expect_err("not unit"), Code::ERROR_POSE_INVALID);
    let mut bad = views[0];
    bad.fov.angle_up = f32::NAN;
    assert_eq!(submit(&swapchain, whole, 0, &bad).expect_err("NaN"), Code::ERROR_VALIDATION_FAILURE);
    submit(&swapchain, whole, 0, &views[0]).expect("a good layer after bad ones");
    drop(swapchain);
    drop(app);
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 7);
}

/// Takes the next image and gives it back, drawn to by nobody.
#[track_caller]
fn release_next(swapchain: &mut xr::Swapchain<xr::Vulkan>) {
    swapchain.acquire_image().expect("acquire");
    swapchain.wait_image(xr::Duration::INFINITE).expect("wait for the image");
    swapchain.release_image().expect("release");
}

#[test]
fn views_may_be_flipped_or_empty_and_are_under_180_degrees() {
    let run = Run::new(&MockConfig { capture_every: 0, ..virtual_config() });
    let mut app = App::begun();
    app.empty_frame();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    release_next(&mut swapchain);
    let angles = |left, right, up, down| xr::Fovf {
        angle_left: left,
        angle_right: right,
        angle_up: up,
        angle_down: down,
    };
    let flipped = angles(0.5, -0.75, -0.25, 0.5);
    let (flat, nothing) = (angles(0.25, 0.25, 0.5, -0.5), angles(0.0, 0.0, 0.0, 0.0));
    let wide = angles(-1.57, 1.57, 1.57, -1.57);
    let half = std::f32::consts::FRAC_PI_2;
    let allowed = [flipped, flat, nothing, wide];
    let wrong =
        [angles(-half, 0.5, 0.5, -0.5), angles(-0.5, 0.5, 3.0, -0.5), angles(-0.5, f32::INFINITY, 0.5, -0.5)];
    for fov in allowed.into_iter().chain(wrong) {
        let state = app.waiter.wait().expect("wait");
        app.stream.begin().expect("begin");
        let located = xr::View { pose: xr::Posef::IDENTITY, fov };
        let [x, y, width, height] = WHOLE;
        let parts = [0, 1].map(|eye| view(&swapchain, eye, rect(x, y, width, height), &located));
        let layer = xr::CompositionLayerProjection::new().space(&app.stage).views(&parts);
        let time = state.predicted_display_time;
        let ended = app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&layer]);
        let refused = wrong.contains(&fov).then_some(Code::ERROR_VALIDATION_FAILURE);
        assert_eq!(ended.err(), refused, "{fov:?}");
    }
    drop(swapchain);
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    let logged = frames.iter().filter(|frame| !frame.empty).map(|frame| frame.views[0].fov);
    let submitted = allowed.map(|fov| [fov.angle_left, fov.angle_right, fov.angle_up, fov.angle_down]);
    assert_eq!(logged.collect::<Vec<_>>(), submitted, "as they were submitted");
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 3);
}

#[test]
fn a_second_wait_blocks_until_the_first_frame_has_begun() {
    let _run = Run::new(&virtual_config());
    let App { stage, mut stream, mut waiter, session, gpu, instance, .. } = App::begun();
    let (send, receive) = std::sync::mpsc::channel();
    let thread = std::thread::spawn(move || {
        for _ in 0..2 {
            send.send(waiter.wait().expect("wait").predicted_display_time).expect("send");
        }
    });
    let first = receive.recv().expect("the first wait returns at once");
    let nothing = receive.recv_timeout(std::time::Duration::from_millis(100));
    assert!(nothing.is_err(), "the second wait returned before the first frame had begun");
    stream.begin().expect("begin");
    let second = receive.recv().expect("the second wait returns once the frame has begun");
    assert!(second.as_nanos() > first.as_nanos());
    stream.end(first, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end the first, not the second");
    thread.join().expect("the waiting thread ends");
    drop((stage, stream, session, gpu, instance));
}

#[test]
fn a_quad_layer_is_accepted_and_not_captured() {
    let run = Run::new(&MockConfig { capture_every: 1, ..virtual_config() });
    let mut app = App::begun();
    app.empty_frame();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 1);
    release_next(&mut swapchain);
    let state = app.waiter.wait().expect("wait");
    app.stream.begin().expect("begin");
    let part = xr::SwapchainSubImage::new().swapchain(&swapchain).image_rect(rect(0, 0, 8, 8));
    let quad = xr::CompositionLayerQuad::new()
        .space(&app.stage)
        .pose(xr::Posef::IDENTITY)
        .size(xr::Extent2Df { width: 1.0, height: 1.0 })
        .sub_image(part);
    let time = state.predicted_display_time;
    app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[&quad]).expect("end");
    drop(swapchain);
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    assert!(frames[1].empty && !frames[1].captured, "{:?}", frames[1]);
}

#[test]
fn a_messenger_hears_of_refused_calls() {
    static HEARD: std::sync::Mutex<Vec<String>> = std::sync::Mutex::new(Vec::new());
    unsafe extern "system" fn on_message(
        _severity: xr::sys::DebugUtilsMessageSeverityFlagsEXT,
        _types: xr::sys::DebugUtilsMessageTypeFlagsEXT,
        data: *const xr::sys::DebugUtilsMessengerCallbackDataEXT,
        _user: *mut std::ffi::c_void,
    ) -> xr::sys::Bool32 {
        // SAFETY: the runtime passes valid data with zero-terminated texts.
        let text = unsafe { std::ffi::CStr::from_ptr((*data).message) };
        HEARD.lock().expect("lock").push(text.to_string_lossy().into_owned());
        xr::sys::FALSE
    }
    let _run = Run::new(&virtual_config());
    let mut extensions = xr::ExtensionSet::default();
    extensions.ext_debug_utils = true;
    let info = xr::ApplicationInfo { application_name: "messenger test", ..Default::default() };
    let instance = load().create_instance(&info, &extensions, &[], &()).expect("instance");
    let functions = instance.exts().ext_debug_utils.as_ref().expect("enabled");
    let create_info = xr::sys::DebugUtilsMessengerCreateInfoEXT {
        ty: xr::sys::DebugUtilsMessengerCreateInfoEXT::TYPE,
        next: std::ptr::null(),
        message_severities: xr::sys::DebugUtilsMessageSeverityFlagsEXT::ERROR,
        message_types: xr::sys::DebugUtilsMessageTypeFlagsEXT::VALIDATION,
        user_callback: Some(on_message),
        user_data: std::ptr::null_mut(),
    };
    let mut messenger = xr::sys::DebugUtilsMessengerEXT::NULL;
    // SAFETY: a valid instance, create info and place for the handle.
    let code =
        unsafe { (functions.create_debug_utils_messenger)(instance.as_raw(), &create_info, &mut messenger) };
    assert_eq!(code, Code::SUCCESS);
    instance.string_to_path("no slash").expect_err("not a path");
    // SAFETY: the messenger was created above.
    assert_eq!(unsafe { (functions.destroy_debug_utils_messenger)(messenger) }, Code::SUCCESS);
    instance.string_to_path("/still wrong").expect_err("not a path");
    let heard = HEARD.lock().expect("lock").clone();
    assert_eq!(heard.len(), 1, "{heard:?}");
    assert!(heard[0].contains("XR_ERROR_PATH_FORMAT_INVALID: path \"no slash\""), "{heard:?}");
}

fn event(frame: u64, kind: EventKind) -> ScriptedEvent {
    ScriptedEvent { frame, kind }
}

#[test]
fn scripted_focus_changes_and_the_stop_arrive_at_their_frames() {
    type State = xr::SessionState;
    let events =
        vec![event(3, EventKind::FocusLoss), event(5, EventKind::FocusGain), event(7, EventKind::Stop)];
    let _run = Run::new(&MockConfig { events, ..virtual_config() });
    let mut app = App::begun();
    for frame in 0..8 {
        let expected: &[State] = match frame {
            0 => &[State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED],
            3 => &[State::VISIBLE],
            5 => &[State::FOCUSED],
            7 => &[State::VISIBLE, State::SYNCHRONIZED, State::STOPPING],
            _ => &[],
        };
        let state = app.empty_frame();
        assert_eq!(app.states(), expected, "frame {frame}");
        assert_eq!(state.should_render, (1..7).contains(&frame), "frame {frame}");
    }
    app.end();
    assert_eq!(app.waiter.wait().expect_err("ended"), Code::ERROR_SESSION_NOT_RUNNING);
}

#[test]
fn a_hidden_session_runs_without_rendering() {
    type State = xr::SessionState;
    let events = vec![event(3, EventKind::Hide), event(6, EventKind::Show)];
    let _run = Run::new(&MockConfig { events, ..virtual_config() });
    let mut app = App::begun();
    for frame in 0..9 {
        let expected: &[State] = match frame {
            0 => &[State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED],
            3 => &[State::VISIBLE, State::SYNCHRONIZED],
            6 => &[State::VISIBLE, State::FOCUSED],
            _ => &[],
        };
        let state = app.empty_frame();
        assert_eq!(app.states(), expected, "frame {frame}");
        assert_eq!(state.should_render, frame > 0 && !(3..6).contains(&frame), "frame {frame}");
    }
}

#[test]
fn a_paused_session_rests_and_then_is_ready_again() {
    type State = xr::SessionState;
    let events = vec![event(2, EventKind::Pause { ms: 125 })];
    let _run = Run::new(&MockConfig { events, ..virtual_config() });
    let mut app = App::begun();
    let mut last = 0;
    for _ in 0..3 {
        last = app.empty_frame().predicted_display_time.as_nanos();
    }
    let states = app.states();
    assert_eq!(states[states.len() - 3..], [State::VISIBLE, State::SYNCHRONIZED, State::STOPPING]);
    app.session.end().expect("STOPPING");
    assert_eq!(app.states(), [State::IDLE]);
    let looks = (1..100).find(|_| app.states() == [State::READY]).expect("READY again");
    assert_eq!(looks, 9, "125 ms are nine periods, and one passes with each look that finds nothing");
    app.session.begin(STEREO).expect("READY");
    let first = app.empty_frame();
    assert!(!first.should_render);
    assert_eq!(app.states(), [State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED]);
    let passed_ns = first.predicted_display_time.as_nanos() - last;
    let periods = (passed_ns + period_ns(72.0) / 2) / period_ns(72.0); // a period is no whole number of nanoseconds
    assert_eq!(periods, 10, "the clock went on");
    assert!(app.empty_frame().should_render);
}

#[test]
fn recentring_moves_the_stages_origin_at_its_time() {
    let kind = EventKind::Recentre { x_mm: 2000, z_mm: -500, yaw_degrees: 0 };
    let _run = Run::new(&MockConfig { events: vec![event(3, kind)], ..virtual_config() });
    let mut app = App::begun();
    for _ in 0..4 {
        app.empty_frame();
    }
    let mut storage = xr::EventDataBuffer::new();
    let mut changes = Vec::new();
    while let Some(event) = app.instance.poll_event(&mut storage).expect("poll") {
        if let xr::Event::ReferenceSpaceChangePending(change) = event {
            let origin = change.pose_in_previous_space().position;
            assert_eq!([origin.x, origin.y, origin.z], [2.0, 0.0, -0.5]);
            changes.push((change.reference_space_type(), change.change_time().as_nanos()));
        }
    }
    let types: Vec<_> = changes.iter().map(|(ty, _)| *ty).collect();
    assert_eq!(types, [xr::ReferenceSpaceType::LOCAL, xr::ReferenceSpaceType::STAGE]);
    let change_ns = changes[1].1;
    let head = app
        .session
        .create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY)
        .expect("the head");
    let at = |ns: i64| head.locate(&app.stage, xr::Time::from_nanos(ns)).expect("located").pose.position;
    let (before, after) = (at(change_ns - 1), at(change_ns));
    assert!((after.x - before.x + 2.0).abs() < 1e-3 && (after.z - before.z - 0.5).abs() < 1e-3);
}

#[test]
fn the_session_is_asked_to_stop_after_the_configured_time() {
    let _run = Run::new(&MockConfig { seconds: 0.125, ..virtual_config() });
    let mut app = App::begun();
    let mut frames = 0;
    while !app.states().contains(&xr::SessionState::STOPPING) {
        app.empty_frame();
        frames += 1;
        assert!(frames < 100, "never stopped");
    }
    assert_eq!(frames, 9 + 1, "0.125 s are nine periods; the tenth frame starts at 0.125 s");
    app.end();
}

#[test]
fn a_lost_instance_can_be_made_again_and_the_world_goes_on() {
    let events = vec![event(4, EventKind::InstanceLoss)];
    let run = Run::new(&MockConfig { events, refresh_hz: 10.0, ..virtual_config() });
    let mut app = App::begun();
    let mut before = 0;
    let announced = loop {
        before += 1;
        app.empty_frame();
        let mut storage = xr::EventDataBuffer::new();
        let mut loss = None;
        while let Some(event) = app.instance.poll_event(&mut storage).expect("poll") {
            if let xr::Event::InstanceLossPending(event) = event {
                loss = Some(event.loss_time());
            }
        }
        if let Some(loss) = loss {
            break loss;
        }
    };
    assert_eq!(before, 5, "announced in frame 4");
    while let Ok(state) = app.waiter.wait() {
        before += 1;
        assert!(state.predicted_display_time.as_nanos() <= announced.as_nanos() + period_ns(10.0));
        if app.stream.begin().is_err() {
            break;
        }
        let _ = app.stream.end(state.predicted_display_time, xr::EnvironmentBlendMode::OPAQUE, &[]);
    }
    let lost = app.waiter.wait().expect_err("lost");
    assert_eq!(lost, Code::ERROR_INSTANCE_LOST);
    drop(app);
    let mut app = App::begun();
    for _ in 0..20 {
        app.empty_frame();
    }
    let states = app.states();
    assert_eq!(states.last(), Some(&xr::SessionState::FOCUSED), "no second loss: {states:?}");
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    let indices: Vec<u64> = frames.iter().map(|frame| frame.frame).collect();
    assert!(indices.is_sorted() && indices.last() == Some(&(before + 19)), "{indices:?}");
    assert!(frames.is_sorted_by_key(|frame| frame.predicted_display_time_ns));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 0);
}

#[test]
fn rate_events_need_the_enabled_extension() {
    let kind = EventKind::RefreshRate { hz: 90 };
    let config = MockConfig { events: vec![event(2, kind)], other_rates_hz: vec![90.0], ..virtual_config() };
    for is_enabled in [false, true] {
        let _run = Run::new(&config);
        let app = App::with(|extensions| extensions.fb_display_refresh_rate = is_enabled);
        let mut app = app.beginning();
        let periods = [(); 4].map(|()| app.empty_frame().predicted_display_period.as_nanos());
        assert_eq!(periods[1..3], [period_ns(72.0), period_ns(90.0)], "it changes for all");
        let mut storage = xr::EventDataBuffer::new();
        let mut told = Vec::new();
        while let Some(event) = app.instance.poll_event(&mut storage).expect("poll") {
            match event {
                xr::Event::SessionStateChanged(_) => {}
                xr::Event::DisplayRefreshRateChangedFB(change) => told.push(change.to_display_refresh_rate()),
                _ => panic!("nothing else happens"),
            }
        }
        assert_eq!(told, if is_enabled { vec![90.0] } else { vec![] });
    }
}

/// Asserts that each kind of call of a lost session says so, that its children and the instance are still there, and that nothing of
/// that counts as a mistake.
#[track_caller]
fn assert_lost(app: &mut App, swapchain: &mut xr::Swapchain<xr::Vulkan>) {
    let lost = Some(Code::ERROR_SESSION_LOST);
    let time = xr::Time::from_nanos(1_000_000_000);
    assert_eq!(app.waiter.wait().err(), lost);
    assert_eq!(app.stream.begin().err(), lost);
    assert_eq!(app.stream.end(time, xr::EnvironmentBlendMode::OPAQUE, &[]).err(), lost);
    assert_eq!(app.session.locate_views(STEREO, time, &app.stage).err(), lost);
    assert_eq!(app.stage.locate(&app.stage, time).err(), lost);
    assert_eq!(app.session.enumerate_swapchain_formats().err(), lost);
    assert_eq!(swapchain.acquire_image().err(), lost);
    assert_eq!(app.session.sync_actions(&[]).err(), lost);
    assert_eq!([app.session.request_exit().err(), app.session.end().err()], [lost; 2]);
    let view = app.session.create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY);
    assert_eq!(view.err(), lost);
    assert_eq!(app.states(), [], "events go on, and there are none");
    assert!(app.instance.properties().is_ok());
    assert!(app.instance.enumerate_view_configurations(app.system).is_ok());
}

/// Destroys what a lost session has; gives what it is answered who tries that again.
fn destroyed_again(app: &App, space: xr::Space, swapchain: xr::Swapchain<xr::Vulkan>) -> [Code; 2] {
    let (functions, handles) = (app.instance.fp(), (space.as_raw(), swapchain.as_raw()));
    drop((space, swapchain));
    // SAFETY: handles may be anything; the runtime refuses those that it does not know.
    unsafe { [(functions.destroy_space)(handles.0), (functions.destroy_swapchain)(handles.1)] }
}

#[test]
fn a_lost_session_is_announced_and_continued() {
    let events = vec![event(4, EventKind::SessionLoss)];
    let run = Run::new(&MockConfig { events, refresh_hz: 10.0, capture_every: 1, ..virtual_config() });
    let mut app = App::begun();
    let head = app.session.create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY);
    let (head, mut swapchain) = (head.expect("space"), app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2));
    for frame in 0..5 {
        assert!(!app.states().contains(&xr::SessionState::LOSS_PENDING), "frame {frame}");
        multiview_frame(&mut app, &mut swapchain, frame);
    }
    assert_eq!(app.states(), [xr::SessionState::LOSS_PENDING]);
    let mut frames = 5;
    loop {
        let state = app.waiter.wait().expect("the wait of the last frame gives it yet");
        frames += 1;
        assert!(!state.should_render && frames < 100);
        let Ok(()) = app.stream.begin() else { break };
        app.stream.end(state.predicted_display_time, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end");
    }
    assert_eq!(frames, 4 + 10 + 1, "a second is ten frames");
    assert_lost(&mut app, &mut swapchain);
    assert_eq!(
        destroyed_again(&app, head, swapchain),
        [Code::ERROR_HANDLE_INVALID; 2],
        "they were destroyed"
    );
    let mut app = app.begun_anew();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    for frame in frames..frames + 20 {
        let state = multiview_frame(&mut app, &mut swapchain, frame);
        assert_eq!(state.should_render, frame > frames, "frame {frame}");
    }
    assert_eq!(app.states().last(), Some(&xr::SessionState::FOCUSED), "no second loss");
    drop((swapchain, app));
    let log = read_frames(&run.captures()).expect("log");
    let numbers: Vec<u64> = log.iter().map(|frame| frame.frame).collect();
    let (before, after) = (0..frames - 1, frames..frames + 20);
    assert_eq!(numbers, before.chain(after).collect::<Vec<_>>(), "the log goes on");
    assert!(log.is_sorted_by_key(|frame| frame.predicted_display_time_ns), "the clock goes on");
    assert_eq!(log.iter().filter(|frame| frame.captured).count(), 3 + 19);
    let summary = read_summary(&run.captures()).expect("summary");
    assert_eq!((summary.errors, summary.frames), (2, frames + 20), "the counts go on");
}

#[test]
fn a_session_may_be_lost_without_a_word() {
    let run =
        Run::new(&MockConfig { events: vec![event(2, EventKind::SuddenSessionLoss)], ..virtual_config() });
    let mut app = App::begun();
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    for _ in 0..2 {
        app.empty_frame();
    }
    type State = xr::SessionState;
    assert_eq!(app.states(), [State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED]);
    assert!(app.waiter.wait().expect("the wait of that frame").should_render);
    assert_lost(&mut app, &mut swapchain);
    drop(swapchain);
    let mut app = app.begun_anew();
    app.empty_frame();
    assert!(app.empty_frame().should_render);
    drop(app);
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 0);
}

#[test]
fn spaces_and_velocities_follow_the_head_path() {
    let run = Run::new(&virtual_config());
    with_walk(&run, &virtual_config());
    let mut app = App::begun();
    let state = app.empty_frame();
    let start_ns = MockConfig::default().virtual_start_ns;
    let space = |ty, pose| app.session.create_reference_space(ty, pose).expect("space");
    let head = space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY);
    let local = space(xr::ReferenceSpaceType::LOCAL, xr::Posef::IDENTITY);
    let mut ahead = xr::Posef::IDENTITY;
    ahead.position.z = -2.0;
    let ahead = space(xr::ReferenceSpaceType::VIEW, ahead);
    assert_eq!(state.predicted_display_time.as_nanos(), period_begin_ns(start_ns, 72.0, 1));
    let half = xr::Time::from_nanos(start_ns + 500_000_000);
    let mut velocity = blank_velocity();
    let (code, place) = relate(&head, &app.stage, half, &mut velocity);
    assert_eq!(code, Code::SUCCESS);
    let tracked = xr::SpaceLocationFlags::POSITION_TRACKED | xr::SpaceLocationFlags::ORIENTATION_TRACKED;
    assert!(place.location_flags.contains(tracked));
    assert_vector(place.pose.position, [0.5, 1.7, 0.0]);
    assert_vector(velocity.linear_velocity, [1.0, 0.0, 0.0]);
    assert_vector(velocity.angular_velocity, [0.0, std::f32::consts::FRAC_PI_2, 0.0]);
    let in_local = head.locate(&local, half).expect("located");
    assert_vector(in_local.pose.position, [0.5, 0.0, 0.0]);
    let in_head = ahead.locate(&head, half).expect("located");
    assert_vector(in_head.pose.position, [0.0, 0.0, -2.0]);
    let diagonal = 2.0 * std::f32::consts::FRAC_1_SQRT_2;
    let in_stage = ahead.locate(&app.stage, half).expect("located");
    assert_vector(in_stage.pose.position, [0.5 - diagonal, 1.7, -diagonal]);
    let (_, views) = app.session.locate_views(STEREO, half, &head).expect("views");
    assert_vector(views[0].pose.position, [-0.0315, 0.0, 0.0]);
    assert_vector(views[1].pose.position, [0.0315, 0.0, 0.0]);
    let zero = head.locate(&app.stage, xr::Time::from_nanos(0));
    assert_eq!(zero.err(), Some(Code::ERROR_TIME_INVALID));
}

fn blank_velocity() -> xr::sys::SpaceVelocity {
    xr::sys::SpaceVelocity {
        ty: xr::sys::SpaceVelocity::TYPE,
        next: std::ptr::null_mut(),
        velocity_flags: xr::SpaceVelocityFlags::EMPTY,
        linear_velocity: xr::Vector3f::default(),
        angular_velocity: xr::Vector3f::default(),
    }
}

/// `openxr::Space::relate` hands over a velocity that nobody has set.
fn relate(
    space: &xr::Space,
    base: &xr::Space,
    time: xr::Time,
    velocity: &mut xr::sys::SpaceVelocity,
) -> (Code, xr::sys::SpaceLocation) {
    let mut location = xr::sys::SpaceLocation {
        ty: xr::sys::SpaceLocation::TYPE,
        next: std::ptr::from_mut(velocity).cast(),
        location_flags: xr::SpaceLocationFlags::EMPTY,
        pose: xr::Posef::IDENTITY,
    };
    let locate = space.instance().fp().locate_space;
    // SAFETY: both spaces are alive; the structs say what they are and live through the call.
    let code = unsafe { locate(space.as_raw(), base.as_raw(), time, &mut location) };
    (code, location)
}

/// As the core validation layer of today's SDKs does it.
#[test]
fn an_unset_velocity_is_refused() {
    let run = Run::new(&virtual_config());
    let mut app = App::begun();
    let time = app.empty_frame().predicted_display_time;
    let head = app.session.create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY);
    let head = head.expect("space");
    let left_over = xr::SpaceVelocityFlags::from_raw(0x5dc0_0001);
    let mut velocity = xr::sys::SpaceVelocity { velocity_flags: left_over, ..blank_velocity() };
    assert_eq!(relate(&head, &app.stage, time, &mut velocity).0, Code::ERROR_VALIDATION_FAILURE);
    let mut velocity = blank_velocity();
    for again in [false, true] {
        assert_eq!(relate(&head, &app.stage, time, &mut velocity).0, Code::SUCCESS, "again: {again}");
        assert!(velocity.velocity_flags.contains(xr::SpaceVelocityFlags::LINEAR_VALID));
    }
    drop((head, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 1);
}

#[track_caller]
fn assert_vector(found: xr::Vector3f, expected: [f32; 3]) {
    let far = [found.x, found.y, found.z].iter().zip(expected).any(|(a, b)| (a - b).abs() > 1e-3);
    assert!(!far, "{found:?} is not {expected:?}");
}

#[test]
fn a_layer_in_local_space_is_logged_in_the_stage_too() {
    let run = Run::new(&virtual_config());
    with_walk(&run, &virtual_config());
    let mut app = App::begun();
    let local = app
        .session
        .create_reference_space(xr::ReferenceSpaceType::LOCAL, xr::Posef::IDENTITY)
        .expect("local");
    app.stage = local;
    let mut swapchain = app.swapchain(vk::Format::R8G8B8A8_SRGB, SIZE, 2);
    for frame in 0..3 {
        multiview_frame(&mut app, &mut swapchain, frame);
    }
    drop(swapchain);
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    for view in &frames[2].views {
        assert!((view.stage_pose.position[1] - view.pose.position[1] - 1.7).abs() < 1e-5, "{view:?}");
    }
}

#[test]
fn times_convert_to_the_monotonic_clock_and_back_unchanged() {
    let _run = Run::new(&virtual_config());
    let app = App::new();
    let mut back = xr::Time::from_nanos(0);
    let (handle, time) = (app.instance.as_raw(), xr::Time::from_nanos(12_345_678_900));
    #[cfg(unix)]
    // SAFETY: a valid instance and places for the answers.
    unsafe {
        let functions = app.instance.exts().khr_convert_timespec_time.as_ref().expect("enabled");
        let mut timespec = std::mem::zeroed();
        assert_eq!((functions.convert_time_to_timespec_time)(handle, time, &mut timespec), Code::SUCCESS);
        assert_eq!((timespec.tv_sec, timespec.tv_nsec), (12, 345_678_900));
        assert_eq!((functions.convert_timespec_time_to_time)(handle, &timespec, &mut back), Code::SUCCESS);
    }
    #[cfg(windows)]
    // SAFETY: a valid instance and places for the answers.
    unsafe {
        let functions =
            app.instance.exts().khr_win32_convert_performance_counter_time.as_ref().expect("enabled");
        let mut counter = 0;
        let convert = functions.convert_time_to_win32_performance_counter;
        assert_eq!(convert(handle, time, &mut counter), Code::SUCCESS);
        let convert = functions.convert_win32_performance_counter_to_time;
        assert_eq!(convert(handle, &counter, &mut back), Code::SUCCESS);
    }
    assert_eq!(back, time);
}

#[test]
fn the_real_clock_paces_frames_ahead_of_the_monotonic_clock() {
    let run = Run::new(&MockConfig { clock: ClockKind::Real, refresh_hz: 200.0, ..virtual_config() });
    let mut app = App::begun();
    let mut last_ns = 0;
    for _ in 0..10 {
        let before_ns = app.instance.now().expect("now").as_nanos();
        let state = app.empty_frame();
        let display_ns = state.predicted_display_time.as_nanos();
        assert!(display_ns > before_ns, "shown after it was waited for");
        assert!(display_ns > last_ns, "shown after the frame before");
        assert_eq!(state.predicted_display_period.as_nanos(), 5_000_000);
        last_ns = display_ns;
    }
    drop(app);
    let frames = read_frames(&run.captures()).expect("log");
    let summary = read_summary(&run.captures()).expect("summary");
    let first_ns = frames[0].predicted_display_time_ns;
    let periods = (last_ns - first_ns) / 5_000_000;
    assert_eq!(periods as u64, 9 + summary.missed_frames, "every period has a frame or was missed");
    assert_eq!((last_ns - first_ns) % 5_000_000, 0, "display times lie on the grid");
}

#[test]
fn actions_can_be_set_up_and_are_inactive() {
    let run = Run::new(&virtual_config());
    let mut app = App::begun();
    let instance = &app.instance;
    let left = instance.string_to_path("/user/hand/left").expect("path");
    let set = instance.create_action_set("main", "Main", 0).expect("set");
    let grab = set.create_action::<bool>("grab", "Grab", &[left]).expect("action");
    let aim = set.create_action::<xr::Posef>("aim", "Aim", &[]).expect("action");
    let binding = |path: &str| instance.string_to_path(path).expect("path");
    let simple = binding("/interaction_profiles/khr/simple_controller");
    let bindings = [
        xr::Binding::new(&grab, binding("/user/hand/left/input/select/click")),
        xr::Binding::new(&aim, binding("/user/hand/left/input/aim/pose")),
    ];
    instance.suggest_interaction_profile_bindings(simple, &bindings).expect("suggest");
    let unknown =
        instance.suggest_interaction_profile_bindings(binding("/interaction_profiles/acme/glove"), &bindings);
    assert_eq!(unknown.expect_err("unknown profile"), Code::ERROR_PATH_UNSUPPORTED);
    assert_eq!(grab.state(&app.session, left).err(), Some(Code::ERROR_ACTIONSET_NOT_ATTACHED));
    app.session.attach_action_sets(&[&set]).expect("attach");
    assert_eq!(app.session.attach_action_sets(&[&set]).err(), Some(Code::ERROR_ACTIONSETS_ALREADY_ATTACHED));
    let space = aim.create_space(&app.session, xr::Path::NULL, xr::Posef::IDENTITY).expect("space");
    let state = app.empty_frame();
    app.session.sync_actions(&[xr::ActiveActionSet::new(&set)]).expect("sync");
    assert!(!grab.state(&app.session, left).expect("state").is_active);
    assert!(!aim.is_active(&app.session, xr::Path::NULL).expect("state"));
    let place = space.locate(&app.stage, state.predicted_display_time).expect("located");
    assert_eq!(place.location_flags, xr::SpaceLocationFlags::EMPTY);
    drop((space, aim, grab, set, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 2);
}

#[test]
fn controllers_follow_the_script_once_their_profile_is_known() {
    let touch = "/interaction_profiles/oculus/touch_controller";
    let input = |frame, path: &str, value| ScriptedInput { frame, path: format!("/user/hand/{path}"), value };
    let inputs = vec![
        input(3, "left/input/trigger/value", 0.25),
        input(3, "right/input/trigger/value", 0.75),
        input(4, "right/input/trigger/value", 0.0),
        input(4, "left/input/thumbstick/x", -0.5),
    ];
    let _run = Run::new(&MockConfig { controllers: Some(touch.into()), inputs, ..virtual_config() });
    let mut app = App::begun();
    let instance = app.instance.clone();
    let path = |text: &str| instance.string_to_path(text).expect("path");
    let (left, right) = (path("/user/hand/left"), path("/user/hand/right"));
    let set = instance.create_action_set("main", "Main", 0).expect("set");
    let squeeze = set.create_action::<f32>("squeeze", "Squeeze", &[left, right]).expect("action");
    let shoot = set.create_action::<bool>("shoot", "Shoot", &[]).expect("action");
    let stick = set.create_action::<xr::Vector2f>("stick", "Stick", &[]).expect("action");
    let jump = set.create_action::<bool>("jump", "Jump", &[]).expect("action");
    let triggers = ["/user/hand/left/input/trigger", "/user/hand/right/input/trigger"].map(path);
    let bindings = [
        xr::Binding::new(&squeeze, triggers[0]),
        xr::Binding::new(&squeeze, triggers[1]),
        xr::Binding::new(&shoot, triggers[1]),
        xr::Binding::new(&stick, path("/user/hand/left/input/thumbstick")),
    ];
    instance.suggest_interaction_profile_bindings(path(touch), &bindings).expect("suggest");
    app.session.attach_action_sets(&[&set]).expect("attach");
    let profile = |app: &App| app.session.current_interaction_profile(left).expect("asked");
    assert_eq!(profile(&app), xr::Path::NULL, "before the first sync");
    let mut said = Vec::new();
    for _ in 0..6 {
        app.empty_frame();
        app.session.sync_actions(&[xr::ActiveActionSet::new(&set)]).expect("sync");
        let of = |hand| squeeze.state(&app.session, hand).expect("a state");
        let [one, other, both] = [left, right, xr::Path::NULL].map(|hand| of(hand).current_state);
        let shot = shoot.state(&app.session, xr::Path::NULL).expect("a state");
        let pushed = stick.state(&app.session, xr::Path::NULL).expect("a state").current_state;
        let jumps = jump.state(&app.session, xr::Path::NULL).expect("a state");
        assert!(shot.is_active && !jumps.is_active, "what is not bound is not active");
        said.push((
            [one, other, both],
            shot.current_state,
            shot.changed_since_last_sync,
            [pushed.x, pushed.y],
        ));
    }
    let rest = ([0.0; 3], false, false, [0.0; 2]);
    let shot = ([0.25, 0.75, 0.75], true, true, [0.0; 2]);
    let changed = said.iter().position(|said| *said != rest).expect("the script begins");
    assert_eq!(said[changed], shot, "{said:?}");
    assert_eq!(said[changed + 1], ([0.25, 0.0, 0.25], false, true, [-0.5, 0.0]), "{said:?}");
    assert_eq!(said[changed + 2], ([0.25, 0.0, 0.25], false, false, [-0.5, 0.0]), "{said:?}");
    assert_eq!(instance.path_to_string(profile(&app)).as_deref(), Ok(touch));
    let mut storage = xr::EventDataBuffer::new();
    let mut news = 0;
    while let Some(event) = instance.poll_event(&mut storage).expect("poll") {
        news += u32::from(matches!(event, xr::Event::InteractionProfileChanged(_)));
    }
    assert_eq!(news, 1);
}

const TOUCH: &str = "/interaction_profiles/oculus/touch_controller";

/// Controllers whose triggers are pulled, the left one further, with their hands held.
fn held_controllers() -> MockConfig {
    let input = |path: &str, value| ScriptedInput { frame: 0, path: format!("/user/hand/{path}"), value };
    let hand = |hand: &str, x| ScriptedHand {
        frame: 0,
        hand: format!("/user/hand/{hand}"),
        position_m: Some([x, 1.5, 0.0]),
        yaw_pitch_roll_degrees: [0.0; 3],
    };
    MockConfig {
        controllers: Some(TOUCH.into()),
        inputs: vec![input("left/input/trigger/value", 0.75), input("right/input/trigger/value", 0.25)],
        hands: vec![hand("left", -0.5), hand("right", 0.5)],
        ..virtual_config()
    }
}

/// Suggests bindings of touch controllers and attaches sets, of a session in focus.
#[track_caller]
fn bind(app: &mut App, bindings: &[xr::Binding<'_>], sets: &[&xr::ActionSet]) {
    let touch = app.path(TOUCH);
    app.instance.suggest_interaction_profile_bindings(touch, bindings).expect("suggest");
    app.session.attach_action_sets(sets).expect("attach");
    app.empty_frame();
}

#[test]
fn the_profile_is_that_of_the_hands_and_of_no_other_path() {
    let run = Run::new(&held_controllers());
    let mut app = App::begun();
    let [left, right] = ["/user/hand/left", "/user/hand/right"].map(|text| app.path(text));
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    let pull = set.create_action::<f32>("pull", "Pull", &[]).expect("action");
    let unattached = app.session.current_interaction_profile(left);
    assert_eq!(unattached.err(), Some(Code::ERROR_ACTIONSET_NOT_ATTACHED));
    let trigger = app.path("/user/hand/left/input/trigger");
    bind(&mut app, &[xr::Binding::new(&pull, trigger)], &[&set]);
    app.session.sync_actions(&[xr::ActiveActionSet::new(&set)]).expect("sync");
    let profile = |path| app.session.current_interaction_profile(path);
    let touch = Ok(app.path(TOUCH));
    assert_eq!([profile(left), profile(right)], [touch; 2]);
    for nobody in ["/user/head", "/user/gamepad", "/user/treadmill"] {
        assert_eq!(profile(app.path(nobody)), Ok(xr::Path::NULL), "{nobody}");
    }
    for none in ["/user", "/user/elbow", "/user/hand/left/input", "/user/hand/left/input/trigger"] {
        assert_eq!(profile(app.path(none)), Err(Code::ERROR_PATH_UNSUPPORTED), "{none}");
    }
    assert_eq!(profile(xr::Path::NULL), Err(Code::ERROR_PATH_INVALID));
    drop((pull, set, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 1 + 4 + 1);
}

#[test]
fn a_set_is_active_below_the_paths_that_are_asked_for() {
    let run = Run::new(&held_controllers());
    let mut app = App::begun();
    let [left, right] = ["/user/hand/left", "/user/hand/right"].map(|text| app.path(text));
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    let pull = set.create_action::<f32>("pull", "Pull", &[left, right]).expect("action");
    let any = set.create_action::<f32>("any", "Any", &[]).expect("action");
    let grip = set.create_action::<xr::Posef>("grip", "Grip", &[]).expect("action");
    let mut bindings = Vec::new();
    for hand in ["left", "right"] {
        let of = |input: &str| app.path(&format!("/user/hand/{hand}/input/{input}"));
        let trigger = of("trigger/value");
        bindings.extend([xr::Binding::new(&pull, trigger), xr::Binding::new(&any, trigger)]);
        bindings.push(xr::Binding::new(&grip, of("grip/pose")));
    }
    bind(&mut app, &bindings, &[&set]);
    let held = grip.create_space(&app.session, xr::Path::NULL, xr::Posef::IDENTITY).expect("space");
    let mut said = |paths: &[xr::Path]| {
        let time = app.empty_frame().predicted_display_time;
        let asked = paths.iter().map(|path| xr::ActiveActionSet::with_subaction(&set, *path));
        app.session.sync_actions(&asked.collect::<Vec<_>>()).expect("sync");
        let of = |path| pull.state(&app.session, path).expect("a state");
        let any = any.state(&app.session, xr::Path::NULL).expect("a state");
        let place = held.locate(&app.stage, time).expect("located");
        let is_located = place.location_flags.contains(xr::SpaceLocationFlags::POSITION_VALID);
        let states = [of(left), of(right), of(xr::Path::NULL), any];
        (
            states.map(|state| state.is_active.then_some(state.current_state)),
            is_located.then_some(place.pose.position.x),
        )
    };
    let (l, r) = (Some(0.75), Some(0.25));
    for both in [&[xr::Path::NULL][..], &[left, right], &[right, xr::Path::NULL]] {
        assert_eq!(said(both), ([l, r, l, l], Some(-0.5)), "{both:?}");
    }
    assert_eq!(said(&[left]), ([l, None, l, l], Some(-0.5)));
    assert_eq!(said(&[right]), ([None, r, r, r], Some(0.5)));
    assert_eq!(said(&[]), ([None; 4], None));
    for (path, code) in [
        (app.path("/user/head"), Code::ERROR_PATH_UNSUPPORTED),
        (app.path("/user/hand/left/input"), Code::ERROR_PATH_UNSUPPORTED),
        (xr::Path::from_raw(12_345), Code::ERROR_PATH_INVALID),
    ] {
        let asked = [xr::ActiveActionSet::new(&set), xr::ActiveActionSet::with_subaction(&set, path)];
        assert_eq!(app.session.sync_actions(&asked).err(), Some(code), "{path:?}");
    }
    drop((held, pull, any, grip, set, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 3);
}

#[test]
fn a_source_is_of_the_active_set_of_the_highest_priority() {
    let _run = Run::new(&held_controllers());
    let mut app = App::begun();
    let [left, right] = ["/user/hand/left", "/user/hand/right"].map(|text| app.path(text));
    let set = |name, priority| app.instance.create_action_set(name, name, priority).expect("set");
    let (low, high, equal) = (set("low", 2), set("high", 3), set("equal", 3));
    let pull =
        |set: &xr::ActionSet| set.create_action::<f32>("pull", "Pull", &[left, right]).expect("action");
    let (under, over, beside) = (pull(&low), pull(&high), pull(&equal));
    let touch = high.create_action::<bool>("touch", "Touch", &[]).expect("action");
    let press = low.create_action::<bool>("press", "Press", &[]).expect("action");
    let path = |text: &str| app.path(text);
    let (pulled, touched) =
        (path("/user/hand/left/input/trigger/value"), path("/user/hand/left/input/trigger/touch"));
    let [other, stick] =
        [path("/user/hand/right/input/trigger/value"), path("/user/hand/left/input/thumbstick/click")];
    let bindings = [
        xr::Binding::new(&under, pulled),
        xr::Binding::new(&under, other),
        xr::Binding::new(&over, other),
        xr::Binding::new(&beside, other),
        xr::Binding::new(&touch, touched),
        xr::Binding::new(&press, stick),
    ];
    bind(&mut app, &bindings, &[&low, &high, &equal]);
    let sync = |asked: &[xr::ActiveActionSet<'_>]| app.session.sync_actions(asked).expect("sync");
    let active = |action: &xr::Action<f32>| {
        [left, right, xr::Path::NULL].map(|hand| action.state(&app.session, hand).expect("a state").is_active)
    };
    let is_active =
        |action: &xr::Action<bool>| action.state(&app.session, xr::Path::NULL).expect("a state").is_active;
    sync(&[(&low).into()]);
    assert_eq!((active(&under), is_active(&press)), ([true; 3], true), "alone it has both");
    sync(&[(&low).into(), xr::ActiveActionSet::with_subaction(&high, right)]);
    assert_eq!(active(&under), [true, false, true], "the left one is not asked for by the higher one");
    assert_eq!((active(&over), is_active(&touch)), ([false, true, true], false));
    sync(&[(&low).into(), (&high).into(), (&equal).into()]);
    assert_eq!((active(&over), active(&beside)), ([false, true, true], [false, true, true]), "both have it");
    assert_eq!(active(&under), [false; 3], "another component of the same trigger is the same source");
    assert!(is_active(&touch) && is_active(&press), "the stick is nobody else's");
    drop(over);
    sync(&[(&low).into(), (&high).into()]);
    assert_eq!(active(&under), [false; 3], "a destroyed action keeps its priority");
}

#[test]
fn an_action_is_active_where_its_binding_converts() {
    let _run = Run::new(&held_controllers());
    let mut app = App::begun();
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    let names = ["trigger/value", "x/click", "thumbstick", "thumbstick/x", "trigger", "grip/pose", "grip"];
    let paths = names.map(|name| app.path(&format!("/user/hand/left/input/{name}")));
    fn of_each<T: xr::ActionTy>(set: &xr::ActionSet, ty: &str) -> [xr::Action<T>; 7] {
        std::array::from_fn(|index| {
            let name = format!("{ty}{index}");
            set.create_action(&name, &name, &[]).expect("action")
        })
    }
    let (presses, numbers) = (of_each::<bool>(&set, "press"), of_each::<f32>(&set, "number"));
    let (pairs, poses) = (of_each::<xr::Vector2f>(&set, "pair"), of_each::<xr::Posef>(&set, "pose"));
    let mut bindings = Vec::new();
    for (index, path) in paths.into_iter().enumerate() {
        bindings.extend([xr::Binding::new(&presses[index], path), xr::Binding::new(&numbers[index], path)]);
        bindings.extend([xr::Binding::new(&pairs[index], path), xr::Binding::new(&poses[index], path)]);
    }
    bind(&mut app, &bindings, &[&set]);
    app.session.sync_actions(&[xr::ActiveActionSet::new(&set)]).expect("sync");
    let null = xr::Path::NULL;
    let press = presses.each_ref().map(|action| action.state(&app.session, null).expect("a state"));
    let number = numbers.each_ref().map(|action| action.state(&app.session, null).expect("a state"));
    let pair = pairs.each_ref().map(|action| action.state(&app.session, null).expect("a state").is_active);
    let pose = poses.each_ref().map(|action| action.is_active(&app.session, null).expect("a state"));
    let scalar = [true, true, true, true, true, false, false];
    assert_eq!(press.map(|state| state.is_active), scalar);
    assert_eq!(number.map(|state| state.is_active), scalar);
    assert_eq!(pair, names.map(|name| name == "thumbstick"));
    assert_eq!(pose, names.map(|name| name.starts_with("grip")));
    assert_eq!([press[0].current_state, press[4].current_state, press[1].current_state], [true, true, false]);
    assert_eq!([number[0].current_state, number[4].current_state], [0.75; 2]);
    let sources = numbers[5].bound_sources(&app.session).expect("sources");
    assert_eq!(sources, [], "what cannot be is not bound");
}

#[test]
fn a_space_outlives_its_action_until_the_next_sync_after_its_set() {
    let run = Run::new(&held_controllers());
    let mut app = App::begun();
    let [left, pose] = ["/user/hand/left", "/user/hand/left/input/grip/pose"].map(|text| app.path(text));
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    drop(set.create_action::<bool>("grip", "Grip", &[]).expect("action"));
    let grip = set.create_action::<xr::Posef>("grip", "Grip", &[left]).expect("the name is free again");
    bind(&mut app, &[xr::Binding::new(&grip, pose)], &[&set]);
    let space = |path| grip.create_space(&app.session, path, xr::Posef::IDENTITY);
    let held = [left, xr::Path::NULL].map(|path| space(path).expect("space"));
    let located = || {
        let time = xr::Time::from_nanos(2_000_000_000);
        let place = |space: &xr::Space| space.locate(&app.stage, time).expect("located");
        let valid = xr::SpaceLocationFlags::POSITION_VALID;
        held.each_ref().map(|space| place(space).location_flags.contains(valid))
    };
    let sync = |sets: &[xr::ActiveActionSet<'_>]| app.session.sync_actions(sets).expect("sync");
    sync(&[(&set).into()]);
    assert_eq!(located(), [true; 2]);
    let functions = app.instance.fp();
    // SAFETY: handles may be anything; the runtime refuses those that it does not know.
    let destroy = || unsafe { (functions.destroy_action)(grip.as_raw()) };
    let gone = Code::ERROR_HANDLE_INVALID;
    assert_eq!([destroy(), destroy()], [Code::SUCCESS, gone]);
    assert_eq!([grip.is_active(&app.session, left).err(), space(left).err()], [Some(gone); 2]);
    assert_eq!(located(), [true; 2], "the action is destroyed");
    sync(&[]);
    assert_eq!(located(), [false; 2], "its set is not active");
    sync(&[(&set).into()]);
    assert_eq!(located(), [true; 2], "its set is active again");
    // SAFETY: as above.
    let destroy = || unsafe { (functions.destroy_action_set)(set.as_raw()) };
    assert_eq!([destroy(), destroy()], [Code::SUCCESS, gone]);
    assert_eq!(located(), [true; 2], "the set was active at the last sync");
    assert_eq!(app.session.sync_actions(&[(&set).into()]).err(), Some(gone));
    app.instance.create_action_set("main", "Main", 0).expect("the name is free again");
    sync(&[]);
    assert_eq!(located(), [false; 2]);
    drop((held, grip, set, app));
    let by_dropping = 2;
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 5 + by_dropping);
}

#[test]
fn what_a_sessions_actions_said_is_not_said_in_the_next_one() {
    let _run = Run::new(&held_controllers());
    let mut app = App::begun();
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    let pull = set.create_action::<f32>("pull", "Pull", &[]).expect("action");
    let trigger = app.path("/user/hand/left/input/trigger/value");
    bind(&mut app, &[xr::Binding::new(&pull, trigger)], &[&set]);
    let said = |app: &App| pull.state(&app.session, xr::Path::NULL).expect("a state").is_active;
    app.session.sync_actions(&[(&set).into()]).expect("sync");
    assert!(said(&app));
    let mut app = app.begun_anew();
    app.session.attach_action_sets(&[&set]).expect("a session of its own");
    assert!(!said(&app), "there was no sync yet");
    app.empty_frame();
    app.session.sync_actions(&[(&set).into()]).expect("sync");
    assert!(said(&app));
}

#[test]
fn bound_sources_are_told_once_each_and_have_names() {
    let run = Run::new(&held_controllers());
    let mut app = App::begun();
    let set = app.instance.create_action_set("main", "Main", 0).expect("set");
    let pull = set.create_action::<f32>("pull", "Pull", &[]).expect("action");
    let buzz = set.create_action::<xr::Haptic>("buzz", "Buzz", &[]).expect("action");
    let bound = ["right/input/trigger", "left/input/squeeze/value", "left/input/trigger/value"];
    let bound = bound.map(|below| app.path(&format!("/user/hand/{below}")));
    let haptic = app.path("/user/hand/left/output/haptic");
    let pulls = [bound[0], bound[1], bound[0], bound[2], bound[1]].map(|path| xr::Binding::new(&pull, path));
    let bindings: Vec<_> = pulls.into_iter().chain([xr::Binding::new(&buzz, haptic)]).collect();
    bind(&mut app, &bindings, &[&set]);
    app.session.sync_actions(&[(&set).into()]).expect("sync");
    assert_eq!(pull.bound_sources(&app.session), Ok(bound.to_vec()));
    assert_eq!(buzz.bound_sources(&app.session), Ok(vec![haptic]));
    let name = |path| {
        let all = xr::InputSourceLocalizedNameFlags::from_raw(7);
        app.session.input_source_localized_name(path, all)
    };
    for path in bound.into_iter().chain([haptic, app.path("/user/gamepad/input/dpad_up/click")]) {
        assert!(name(path).is_ok_and(|name| !name.is_empty()));
    }
    for none in ["/user/hand/left", "/user/hand/left/input", "/user/hand/left/input/elbow", TOUCH] {
        assert_eq!(name(app.path(none)), Err(Code::ERROR_PATH_UNSUPPORTED), "{none}");
    }
    assert_eq!(name(xr::Path::NULL), Err(Code::ERROR_PATH_INVALID));
    drop((pull, buzz, set, app));
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 5);
}

#[test]
fn actions_accept_only_their_own_paths() {
    let _run = Run::new(&virtual_config());
    let app = App::begun();
    let instance = &app.instance;
    let path = |text: &str| instance.string_to_path(text).expect("path");
    let [left, right] = [path("/user/hand/left"), path("/user/hand/right")];
    let set = instance.create_action_set("main", "Main", 0).expect("set");
    let unsupported = Some(Code::ERROR_PATH_UNSUPPORTED);
    for below in ["/user/hand/left/input", "/user/elbow", "/user"] {
        assert_eq!(set.create_action::<bool>("no", "No", &[path(below)]).err(), unsupported, "{below}");
    }
    let grab = set.create_action::<bool>("grab", "Grab", &[left]).expect("action");
    let squeeze = set.create_action::<f32>("squeeze", "Squeeze", &[left, right]).expect("action");
    let stick = set.create_action::<xr::Vector2f>("stick", "Stick", &[]).expect("action");
    let aim = set.create_action::<xr::Posef>("aim", "Aim", &[right]).expect("action");
    let buzz = set.create_action::<xr::Haptic>("buzz", "Buzz", &[right]).expect("action");
    app.session.attach_action_sets(&[&set]).expect("attach");
    for all in [left, xr::Path::NULL] {
        assert!(grab.state(&app.session, all).is_ok());
    }
    assert!(squeeze.state(&app.session, right).is_ok());
    assert_eq!(grab.state(&app.session, right).err(), unsupported);
    assert_eq!(squeeze.state(&app.session, path("/user/head")).err(), unsupported);
    assert_eq!(stick.state(&app.session, left).err(), unsupported);
    assert_eq!(aim.is_active(&app.session, left).err(), unsupported);
    let vibration = xr::HapticVibration::new();
    assert!(buzz.apply_feedback(&app.session, right, &vibration).is_ok());
    assert_eq!(buzz.apply_feedback(&app.session, left, &vibration).err(), unsupported);
    assert_eq!(buzz.stop_feedback(&app.session, left).err(), unsupported);
}

#[test]
fn places_for_views_say_what_they_are() {
    let _run = Run::new(&virtual_config());
    let mut app = App::begun();
    let time = app.empty_frame().predicted_display_time;
    let functions = app.instance.fp();
    let info = xr::sys::ViewLocateInfo {
        ty: xr::sys::ViewLocateInfo::TYPE,
        next: std::ptr::null(),
        view_configuration_type: STEREO,
        display_time: time,
        space: app.stage.as_raw(),
    };
    let mut state = xr::sys::ViewState {
        ty: xr::sys::ViewState::TYPE,
        next: std::ptr::null_mut(),
        view_state_flags: xr::ViewStateFlags::EMPTY,
    };
    let view = |ty| xr::sys::View {
        ty,
        next: std::ptr::null_mut(),
        pose: xr::Posef::IDENTITY,
        fov: xr::Fovf::default(),
    };
    let configuration = |ty| xr::sys::ViewConfigurationView {
        ty,
        next: std::ptr::null_mut(),
        recommended_image_rect_width: 0,
        max_image_rect_width: 0,
        recommended_image_rect_height: 0,
        max_image_rect_height: 0,
        recommended_swapchain_sample_count: 0,
        max_swapchain_sample_count: 0,
    };
    let (right, wrong) = (xr::sys::View::TYPE, xr::sys::ViewConfigurationView::TYPE);
    let mut count = 0;
    for (second, code) in [(right, Code::SUCCESS), (wrong, Code::ERROR_VALIDATION_FAILURE)] {
        let mut views = [right, second].map(view);
        let at = views.as_mut_ptr();
        // SAFETY: a valid session, and structures and places that live through the call.
        let found =
            unsafe { (functions.locate_views)(app.session.as_raw(), &info, &mut state, 2, &mut count, at) };
        assert_eq!((found, count), (code, 2), "{second:?}");
    }
    let enumerate = functions.enumerate_view_configuration_views;
    for (second, code) in [(wrong, Code::SUCCESS), (right, Code::ERROR_VALIDATION_FAILURE)] {
        let (mut views, handle) = ([wrong, second].map(configuration), app.instance.as_raw());
        // SAFETY: a valid instance, and places that live through the call.
        let found = unsafe { enumerate(handle, app.system, STEREO, 2, &mut count, views.as_mut_ptr()) };
        assert_eq!(found, code, "{second:?}");
    }
}

#[test]
fn events_of_a_lost_session_do_not_reach_the_next() {
    let _run = Run::new(&virtual_config());
    let App { stage, stream, waiter, session, gpu, instance, system } = App::new();
    drop((stage, stream, waiter, session)); // IDLE and READY wait in the queue
    // SAFETY: the binding's handles are valid, and outlive the session.
    let next = unsafe { instance.create_session::<xr::Vulkan>(system, &gpu.binding()) }.expect("a session");
    let mut storage = xr::EventDataBuffer::new();
    let mut states = Vec::new();
    while let Some(event) = instance.poll_event(&mut storage).expect("poll") {
        let xr::Event::SessionStateChanged(change) = event else { panic!("state changes alone") };
        assert_eq!(change.session(), next.0.as_raw());
        states.push(change.state());
    }
    assert_eq!(states, [xr::SessionState::IDLE, xr::SessionState::READY]);
    drop(next);
}

/// What a session with this next structure, or none, is refused with.
fn refused_session(instance: &xr::Instance, system: xr::SystemId, next: *const std::ffi::c_void) -> Code {
    let info = xr::sys::SessionCreateInfo {
        ty: xr::sys::SessionCreateInfo::TYPE,
        next,
        create_flags: xr::sys::SessionCreateFlags::EMPTY,
        system_id: system,
    };
    let mut session = xr::sys::Session::NULL;
    // SAFETY: a valid instance, and structures and a place that live through the call.
    unsafe { (instance.fp().create_session)(instance.as_raw(), &info, &mut session) }
}

#[test]
fn a_session_without_binding_is_refused_first() {
    let run = Run::new(&virtual_config());
    let instance = create_instance(&load()).expect("instance");
    let system = instance.system(xr::FormFactor::HEAD_MOUNTED_DISPLAY).expect("system");
    let refused = || refused_session(&instance, system, std::ptr::null());
    assert_eq!(refused(), Code::ERROR_GRAPHICS_DEVICE_INVALID, "before the call");
    instance.graphics_requirements::<xr::Vulkan>(system).expect("requirements");
    assert_eq!(refused(), Code::ERROR_GRAPHICS_DEVICE_INVALID, "after the call");
    let nobody = refused_session(&instance, xr::SystemId::from_raw(77), std::ptr::null());
    assert_eq!(nobody, Code::ERROR_SYSTEM_INVALID);
    drop(instance);
    assert_eq!(read_summary(&run.captures()).expect("summary").errors, 3);
}

#[test]
fn a_device_that_the_runtime_has_not_made_is_refused() {
    let _run = Run::new(&virtual_config());
    let App { stage, stream, waiter, session, gpu, instance, system } = App::new();
    drop((stage, stream, waiter, session));
    let (good, nothing) = (gpu.binding(), std::ptr::null());
    let nobodys = std::ptr::without_provenance(64);
    for (physical_device, device) in
        [(good.physical_device, nothing), (good.physical_device, nobodys), (nothing, good.device)]
    {
        let binding = xr::vulkan::SessionCreateInfo { physical_device, device, ..gpu.binding() };
        // SAFETY: the runtime refuses before it uses a handle.
        let refused = unsafe { instance.create_session::<xr::Vulkan>(system, &binding) };
        assert_eq!(
            refused.err(),
            Some(Code::ERROR_GRAPHICS_DEVICE_INVALID),
            "{physical_device:?}, {device:?}"
        );
    }
    // SAFETY: the binding's handles are valid, and outlive the session.
    assert!(unsafe { instance.create_session::<xr::Vulkan>(system, &good) }.is_ok());
}

#[test]
fn a_session_needs_the_requirements_call_and_the_runtimes_instance() {
    let _run = Run::new(&virtual_config());
    let instance = create_instance(&load()).expect("instance");
    let system = instance.system(xr::FormFactor::HEAD_MOUNTED_DISPLAY).expect("system");
    let nothing = xr::vulkan::SessionCreateInfo {
        instance: std::ptr::null(),
        physical_device: std::ptr::null(),
        device: std::ptr::null(),
        queue_family_index: 0,
        queue_index: 0,
    };
    // SAFETY: the runtime refuses before it uses a handle.
    let missing = unsafe { instance.create_session::<xr::Vulkan>(system, &nothing) };
    assert_eq!(missing.err(), Some(Code::ERROR_GRAPHICS_REQUIREMENTS_CALL_MISSING));
    instance.graphics_requirements::<xr::Vulkan>(system).expect("requirements");
    // SAFETY: as above.
    let invalid = unsafe { instance.create_session::<xr::Vulkan>(system, &nothing) };
    assert_eq!(invalid.err(), Some(Code::ERROR_GRAPHICS_DEVICE_INVALID));
}

#[test]
fn stale_handles_are_refused() {
    let _run = Run::new(&virtual_config());
    let app = App::new();
    let stale = app
        .session
        .create_reference_space(xr::ReferenceSpaceType::VIEW, xr::Posef::IDENTITY)
        .expect("space")
        .as_raw();
    let destroy = app.instance.fp().destroy_space;
    // SAFETY: handles may be anything; the runtime refuses those that it does not know.
    unsafe {
        assert_eq!(destroy(stale), Code::ERROR_HANDLE_INVALID);
        assert_eq!(destroy(xr::sys::Space::from_raw(1)), Code::ERROR_HANDLE_INVALID);
    }
}

/// Creates an instance in a process of its own with the configuration `config`; gives what was printed.
#[track_caller]
fn refused_in_a_process(run: &Run, config: &str) -> String {
    std::fs::write(run.config_path(), config).expect("write the configuration");
    let program = std::env::current_exe().expect("this program");
    let arguments = ["--exact", "helper_that_only_creates_an_instance", "--ignored", "--nocapture"];
    let output = std::process::Command::new(program).args(arguments).output().expect("run");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stderr).expect("text")
}

#[test]
fn a_bad_configuration_is_refused_with_file_line_and_remedy() {
    let run = Run::unconfigured();
    let printed = refused_in_a_process(&run, "{\n\"refresh\": 72\n}");
    assert!(printed.contains("xrCreateInstance") && printed.contains("mock.json:2:"), "{printed}");
    std::fs::write(run.folder().join("walk.csv"), "t_s,x,y,z,qx,qy,qz,qw\n0,0,1,0,0,0,0,1\n1,2,3\n")
        .expect("write the head path");
    let printed = refused_in_a_process(&run, r#"{"head_path": "walk.csv"}"#);
    assert!(printed.contains("walk.csv:3: 3 columns where 8 are needed; write t_s,x,y,z"), "{printed}");
    let printed = refused_in_a_process(&run, r#"{"head_path": "run.csv"}"#);
    assert!(printed.contains("run.csv") && printed.contains("correct \"head_path\""), "{printed}");
}

#[test]
#[ignore = "run in a process of its own by a_bad_configuration_is_refused_with_file_line_and_remedy"]
fn helper_that_only_creates_an_instance() {
    let refused = create_instance(&load()).err();
    assert_eq!(refused, Some(Code::ERROR_INITIALIZATION_FAILED));
}

#[test]
fn the_library_exports_the_negotiation_only() {
    let library = shadecast_mock_runtime::manifest::find_library().expect("built");
    let symbols = exported(&library);
    let ours: Vec<_> =
        symbols.iter().filter(|name| name.starts_with("xr") || name.contains("shadecast")).collect();
    assert_eq!(ours, ["xrNegotiateLoaderRuntimeInterface"]);
}

/// Names of the dynamic symbols that a 64-bit little-endian ELF library defines.
fn exported(library: &Path) -> Vec<String> {
    let bytes = std::fs::read(library).expect("read the library");
    let number = |at: usize, width: usize| {
        bytes[at..at + width].iter().rev().fold(0usize, |all, byte| all << 8 | usize::from(*byte))
    };
    let (sections, entry_size, count) = (number(0x28, 8), number(0x3a, 2), number(0x3c, 2));
    let section = |index: usize| sections + index * entry_size;
    let dynamic_symbols = (0..count).map(section).find(|at| number(at + 4, 4) == 11).expect("a .dynsym");
    let strings = number(section(number(dynamic_symbols + 0x28, 4)) + 0x18, 8);
    let (start, size) = (number(dynamic_symbols + 0x18, 8), number(dynamic_symbols + 0x20, 8));
    let defined = (start..start + size).step_by(24).filter(|at| number(at + 6, 2) != 0);
    let names = defined.map(|at| {
        let name = &bytes[strings + number(at, 4)..];
        let end = name.iter().position(|byte| *byte == 0).expect("zero-terminated");
        String::from_utf8_lossy(&name[..end]).into_owned()
    });
    names.collect()
}
