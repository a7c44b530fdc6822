//! Submissions at the end of a frame: the rules for layers, and the first projection layer in our terms.

use openxr_sys as xr;
use shadecast_protocol::pose::{Fov, Pose};
use xr::Handle as _;

use crate::fault::{CallResult, Fault};
use crate::ffi;
use crate::frame::Frame;
use crate::instance::MAX_LAYERS;
use crate::runtime::{Core, Session};
use crate::space::{self, pose_from_xr};
use crate::swapchain::Swapchain;

/// A projection layer that keeps all rules.
pub(crate) struct Submitted {
    /// Takes the layer's space to the stage at the display time.
    pub(crate) stage_from_layer: Pose,
    pub(crate) views: [SubmittedView; 2],
}

impl Submitted {
    /// Which releases it shows: the same twice is the same picture.
    pub(crate) fn releases(&self) -> [(u64, u64); 2] {
        self.views.each_ref().map(|view| (view.swapchain, view.release))
    }
}

/// One view of it.
pub(crate) struct SubmittedView {
    /// Pose of the eye in the layer's space.
    pub(crate) layer_from_eye: Pose,
    pub(crate) fov: Fov,
    pub(crate) swapchain: u64,
    /// Index of the swapchain's image: the one that was released last.
    pub(crate) image: u32,
    /// The number of that release.
    pub(crate) release: u64,
    pub(crate) array_index: u32,
    pub(crate) offset: [i32; 2],
    pub(crate) extent: [u32; 2],
}

/// Checks a frame's end; gives its first projection layer.
pub(crate) fn check(
    core: &Core,
    session: &Session,
    info: &xr::FrameEndInfo,
    frame: &Frame,
) -> CallResult<Option<Submitted>> {
    space::check_time(info.display_time)?;
    if info.environment_blend_mode != xr::EnvironmentBlendMode::OPAQUE {
        let message = format!("{:?}; the mock runtime has OPAQUE only", info.environment_blend_mode);
        return Err(Fault::application(xr::Result::ERROR_ENVIRONMENT_BLEND_MODE_UNSUPPORTED, message));
    }
    if info.layer_count > MAX_LAYERS {
        let message = format!("{} layers; the system has {MAX_LAYERS}", info.layer_count);
        return Err(Fault::application(xr::Result::ERROR_LAYER_LIMIT_EXCEEDED, message));
    }
    // SAFETY: the layers are an array of the length that the application says.
    let layers = unsafe { ffi::array(info.layers, info.layer_count, "layers") }?;
    let mut first = None;
    for layer in layers {
        let projection = check_layer(core, session, *layer, frame)?;
        first = first.or(projection);
    }
    Ok(first)
}

fn invalid_layer(message: impl Into<String>) -> Fault {
    Fault::application(xr::Result::ERROR_LAYER_INVALID, message)
}

fn check_layer(
    core: &Core,
    session: &Session,
    layer: *const xr::CompositionLayerBaseHeader,
    frame: &Frame,
) -> CallResult<Option<Submitted>> {
    // SAFETY: null or a layer of the application's, all of which begin with this header.
    let header = unsafe { layer.as_ref() }.ok_or_else(|| invalid_layer("a layer is null"))?;
    match header.ty {
        xr::StructureType::COMPOSITION_LAYER_PROJECTION => {
            // SAFETY: the structure says that it is a projection layer.
            let layer = unsafe { ffi::input(layer.cast(), "layer") }?;
            check_projection(core, session, layer, frame).map(Some)
        }
        xr::StructureType::COMPOSITION_LAYER_QUAD => {
            // SAFETY: the structure says that it is a quad layer.
            let layer = unsafe { ffi::input(layer.cast(), "layer") }?;
            check_quad(session, layer).map(|()| None)
        }
        other => {
            let message = format!("a layer has type {}", crate::names::structure(other));
            Err(invalid_layer(message + "; the mock runtime has projection and quad layers"))
        }
    }
}

fn check_projection(
    core: &Core,
    session: &Session,
    layer: &xr::CompositionLayerProjection,
    frame: &Frame,
) -> CallResult<Submitted> {
    let space = session.spaces.get(&layer.space.into_raw()).ok_or_else(|| Fault::handle("space"))?;
    // SAFETY: the views are an array of the length that the application says.
    let views = unsafe { ffi::array(layer.views, layer.view_count, "views") }?;
    let [left, right] = views else {
        return Err(Fault::usage(format!("the projection layer has {} views, stereo needs 2", views.len())));
    };
    let stage_from_layer =
        space::stage_from_space(core, space, frame.display_time_ns).unwrap_or(Pose::IDENTITY);
    Ok(Submitted { stage_from_layer, views: [check_view(session, left)?, check_view(session, right)?] })
}

fn check_view(session: &Session, view: &xr::CompositionLayerProjectionView) -> CallResult<SubmittedView> {
    // SAFETY: a reference is a valid pointer.
    let view = unsafe { ffi::input(view, "a projection view") }?;
    let fov = Fov {
        left: view.fov.angle_left,
        right: view.fov.angle_right,
        up: view.fov.angle_up,
        down: view.fov.angle_down,
    };
    if ![fov.left, fov.right, fov.up, fov.down].into_iter().all(is_view_angle) {
        return Err(Fault::usage(format!(
            "a view has {:?}; angles must lie between -pi/2 and pi/2",
            view.fov
        )));
    }
    let layer_from_eye = checked_pose(&view.pose, "a view's pose")?;
    let (image, release) = check_sub_image(session, &view.sub_image)?;
    let rect = view.sub_image.image_rect;
    Ok(SubmittedView {
        layer_from_eye,
        fov,
        swapchain: view.sub_image.swapchain.into_raw(),
        image,
        release,
        array_index: view.sub_image.image_array_index,
        offset: [rect.offset.x, rect.offset.y],
        extent: [rect.extent.width as u32, rect.extent.height as u32],
    })
}

/// What the specification allows, which says nothing of their order: a view whose left side is right of its right one is flipped, and
/// one without any area shows nothing.
fn is_view_angle(radians: f32) -> bool {
    radians.abs() < std::f32::consts::FRAC_PI_2
}

fn check_quad(session: &Session, layer: &xr::CompositionLayerQuad) -> CallResult<()> {
    if !session.spaces.contains_key(&layer.space.into_raw()) {
        return Err(Fault::handle("space"));
    }
    checked_pose(&layer.pose, "a quad layer's pose")?;
    check_sub_image(session, &layer.sub_image).map(|_| ())
}

/// A finite pose with a unit quaternion.
pub(crate) fn checked_pose(pose: &xr::Posef, what: &str) -> CallResult<Pose> {
    let ours = pose_from_xr(pose);
    match ours.is_valid() {
        true => Ok(ours),
        false => {
            let message = format!("{what} is {pose:?}; it must be finite, with a unit quaternion");
            Err(Fault::application(xr::Result::ERROR_POSE_INVALID, message))
        }
    }
}

/// Checks a part of a swapchain; gives the index of the image that it shows, and the number of its release.
fn check_sub_image(session: &Session, part: &xr::SwapchainSubImage) -> CallResult<(u32, u64)> {
    let swapchain =
        session.swapchains.get(&part.swapchain.into_raw()).ok_or_else(|| Fault::handle("swapchain"))?;
    if swapchain.is_depth() {
        return Err(invalid_layer("the layer's swapchain holds depths; a layer shows colours"));
    }
    check_rect(swapchain, &part.image_rect)?;
    if part.image_array_index >= swapchain.array_size {
        let message = format!(
            "imageArrayIndex {} of a swapchain with {}",
            part.image_array_index, swapchain.array_size
        );
        return Err(Fault::usage(message));
    }
    let images = &swapchain.images;
    images.last_released().map(|image| (image, images.releases())).ok_or_else(|| {
        invalid_layer("the layer's swapchain has no released image; release one before xrEndFrame")
    })
}

fn check_rect(swapchain: &Swapchain, rect: &xr::Rect2Di) -> CallResult<()> {
    let inside = |offset: i32, extent: i32, whole: u32| {
        offset >= 0 && extent > 0 && i64::from(offset) + i64::from(extent) <= i64::from(whole)
    };
    let [width, height] = swapchain.extent;
    let ok =
        inside(rect.offset.x, rect.extent.width, width) && inside(rect.offset.y, rect.extent.height, height);
    if ok {
        return Ok(());
    }
    let message = format!(
        "rect {}x{} at ({}, {}) does not lie inside the swapchain of {width}x{height}",
        rect.extent.width, rect.extent.height, rect.offset.x, rect.offset.y
    );
    Err(Fault::application(xr::Result::ERROR_SWAPCHAIN_RECT_INVALID, message))
}
