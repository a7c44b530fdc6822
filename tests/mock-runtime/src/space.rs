//! Spaces, and where things are in them at a time.
//!
//! STAGE is the frame of the head path until the user recentres: its floor is y = 0. VIEW is the head. LOCAL has its origin where the head
//! begins (head path time 0, at the head's height) and turns with the head's first heading, level with the floor, as
//! the specification wants it. An action space is located while its action has a source and the configuration says where the hand is
//! (`hands`); one that was made for no hand in particular follows the left one, or else the right one, of those where its action has one.

use glam::{Quat, Vec3};
use openxr_sys as xr;
use shadecast_protocol::pose::Pose;
use xr::Handle as _;

use crate::config::RECENTRE_NOTICE_NS;
use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::instance::check_view_configuration;
use crate::layers::checked_pose;
use crate::runtime::{self, Core, Event, Session};

/// A space of the application's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Space {
    kind: SpaceKind,
    /// Takes the space to its reference space.
    reference_from_space: Pose,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SpaceKind {
    Stage,
    Local,
    View,
    /// Of an action, for a hand's path or for any.
    Action(xr::Action, xr::Path),
}

/// Reach of the central difference that gives velocities, to each side, nanoseconds.
const DIFFERENCE_NS: i64 = 5_000_000;

/// Moves the origins of STAGE and LOCAL, and announces it.
pub(crate) fn recentre(core: &mut Core, session: u64, [x_mm, z_mm]: [i32; 2], yaw_degrees: i32) {
    let change_time_ns = core.now_ns() + RECENTRE_NOTICE_NS;
    let previous_from_new = Pose {
        position: Vec3::new(x_mm as f32, 0.0, z_mm as f32) * 0.001,
        orientation: Quat::from_rotation_y((yaw_degrees as f32).to_radians()),
    };
    let path_from_new = path_from_stage(core, change_time_ns).then(previous_from_new);
    core.path_from_stage.push((change_time_ns, path_from_new));
    let spaces = [xr::ReferenceSpaceType::LOCAL, xr::ReferenceSpaceType::STAGE];
    core.events.extend(spaces.map(|space| Event::SpaceChange {
        session,
        space,
        change_time_ns,
        previous_from_new,
    }));
}

/// Where the stage is in the frame of the head path.
fn path_from_stage(core: &Core, time_ns: i64) -> Pose {
    let mut changes = core.path_from_stage.iter().rev();
    changes.find(|(since_ns, _)| *since_ns <= time_ns).map_or(Pose::IDENTITY, |(_, pose)| *pose)
}

/// OpenXR's pose in our terms.
pub(crate) fn pose_from_xr(pose: &xr::Posef) -> Pose {
    let (p, q) = (pose.position, pose.orientation);
    Pose { position: Vec3::new(p.x, p.y, p.z), orientation: Quat::from_xyzw(q.x, q.y, q.z, q.w) }
}

/// Our pose in OpenXR's terms.
pub(crate) fn pose_to_xr(pose: Pose) -> xr::Posef {
    let q = pose.orientation;
    xr::Posef {
        orientation: xr::Quaternionf { x: q.x, y: q.y, z: q.z, w: q.w },
        position: vector_to_xr(pose.position),
    }
}

fn vector_to_xr(v: Vec3) -> xr::Vector3f {
    xr::Vector3f { x: v.x, y: v.y, z: v.z }
}

/// Where the head is in the stage.
pub(crate) fn stage_from_head(core: &Core, time_ns: i64) -> Pose {
    head_in_stage_of(core, time_ns, time_ns)
}

/// Where the head is at `time_ns` in the stage as it is at `stage_ns`.
fn head_in_stage_of(core: &Core, time_ns: i64, stage_ns: i64) -> Pose {
    let path_from_head = core.head_path.pose_at(core.path_time_s(time_ns));
    path_from_stage(core, stage_ns).inverse().then(path_from_head)
}

/// Where LOCAL is in the stage: at the head's first pose, with its heading only.
fn stage_from_local(core: &Core) -> Pose {
    let start = core.head_path.pose_at(0.0);
    let ahead = start.orientation * Vec3::NEG_Z;
    // Straight up or down has no heading; atan2(0, 0) is 0, which keeps the stage's.
    let heading = f32::atan2(-ahead.x, -ahead.z);
    Pose { position: start.position, orientation: Quat::from_rotation_y(heading) }
}

/// Where a space is in the stage; none for an action space.
pub(crate) fn stage_from_space(core: &Core, space: &Space, time_ns: i64) -> Option<Pose> {
    space_in_stage_of(core, space, time_ns, time_ns)
}

/// Where a space is at `time_ns` in the stage as it is at `stage_ns`.
fn space_in_stage_of(core: &Core, space: &Space, time_ns: i64, stage_ns: i64) -> Option<Pose> {
    let stage_from_reference = match space.kind {
        SpaceKind::Stage => Pose::IDENTITY,
        SpaceKind::Local => stage_from_local(core),
        SpaceKind::View => head_in_stage_of(core, time_ns, stage_ns),
        SpaceKind::Action(action, path) => {
            let path_from_hand = path_from_hand(core, action, path)?;
            path_from_stage(core, stage_ns).inverse().then(path_from_hand)
        }
    };
    Some(stage_from_reference.then(space.reference_from_space))
}

/// Where the hand of an action is in the frame of the head path, where it has one. A destroyed action still leads its spaces.
fn path_from_hand(core: &Core, action: xr::Action, path: xr::Path) -> Option<Pose> {
    let hands: &[&str] = match path {
        xr::Path::NULL => &["/user/hand/left", "/user/hand/right"],
        path => &[core.paths.text(path).ok()?],
    };
    let frame = core.timeline.next_frame.saturating_sub(1);
    let of = |hand: &&str| {
        if !core.actions.is_active(action, hand) {
            return None;
        }
        let said = core.config.hands.iter().filter(|said| said.hand == **hand && said.frame <= frame);
        let said = said.max_by_key(|said| said.frame)?;
        let [yaw, pitch, roll] = said.yaw_pitch_roll_degrees.map(f32::to_radians);
        let orientation =
            Quat::from_rotation_y(yaw) * Quat::from_rotation_x(pitch) * Quat::from_rotation_z(roll);
        Some(Pose { position: Vec3::from(said.position_m?), orientation })
    };
    hands.iter().find_map(of)
}

fn base_from_space(core: &Core, base: &Space, space: &Space, time_ns: i64, stage_ns: i64) -> Option<Pose> {
    let stage_from_base = space_in_stage_of(core, base, time_ns, stage_ns)?;
    Some(stage_from_base.inverse().then(space_in_stage_of(core, space, time_ns, stage_ns)?))
}

/// Linear (m/s) and angular (rad/s) velocity of `space` relative to and expressed in `base`. Recentring is no motion.
fn velocity(core: &Core, base: &Space, space: &Space, time_ns: i64) -> Option<(Vec3, Vec3)> {
    let before = base_from_space(core, base, space, time_ns - DIFFERENCE_NS, time_ns)?;
    let after = base_from_space(core, base, space, time_ns + DIFFERENCE_NS, time_ns)?;
    let seconds = 2.0 * DIFFERENCE_NS as f32 * 1e-9;
    let linear = (after.position - before.position) / seconds;
    Some((linear, rotation_vector(after.orientation * before.orientation.conjugate()) / seconds))
}

/// Axis times angle in radians, along the shorter arc; exact for small angles too.
fn rotation_vector(rotation: Quat) -> Vec3 {
    let q = if rotation.w < 0.0 { -rotation } else { rotation };
    let axis = Vec3::new(q.x, q.y, q.z);
    let sine = axis.length();
    match sine > 0.0 {
        true => axis * (2.0 * f32::atan2(sine, q.w) / sine),
        false => Vec3::ZERO,
    }
}

pub(crate) fn check_time(time: xr::Time) -> CallResult<i64> {
    match time.as_nanos() {
        time_ns @ 1.. => Ok(time_ns),
        other => {
            Err(Fault::application(xr::Result::ERROR_TIME_INVALID, format!("time {other} is not positive")))
        }
    }
}

fn space_of(session: &Session, handle: xr::Space) -> CallResult<Space> {
    session.spaces.get(&handle.into_raw()).copied().ok_or_else(|| Fault::handle("space"))
}

entry! {
    enumerate_reference_spaces: EnumerateReferenceSpaces = "xrEnumerateReferenceSpaces"(
        session: value xr::Session,
        capacity: value u32,
        count: raw_out u32,
        spaces: raw_out xr::ReferenceSpaceType,
    ) {
        runtime::lock().session(session)?;
        let types = [xr::ReferenceSpaceType::VIEW, xr::ReferenceSpaceType::LOCAL, xr::ReferenceSpaceType::STAGE];
        // SAFETY: count and spaces are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, spaces), &types, |slot, ty| *slot = *ty) }
    }
}

entry! {
    create_reference_space: CreateReferenceSpace = "xrCreateReferenceSpace"(
        session: value xr::Session,
        create_info: input xr::ReferenceSpaceCreateInfo,
        space: slot xr::Space,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let (_, session) = runtime.session(session)?;
        let kind = match create_info.reference_space_type {
            xr::ReferenceSpaceType::VIEW => SpaceKind::View,
            xr::ReferenceSpaceType::LOCAL => SpaceKind::Local,
            xr::ReferenceSpaceType::STAGE => SpaceKind::Stage,
            other => {
                let message = format!("{other:?}; the mock runtime has VIEW, LOCAL and STAGE");
                return Err(Fault::application(xr::Result::ERROR_REFERENCE_SPACE_UNSUPPORTED, message));
            }
        };
        let reference_from_space = checked_pose(&create_info.pose_in_reference_space, "poseInReferenceSpace")?;
        session.spaces.insert(handle, Space { kind, reference_from_space });
        *space = xr::Space::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    create_action_space: CreateActionSpace = "xrCreateActionSpace"(
        session: value xr::Session,
        create_info: input xr::ActionSpaceCreateInfo,
        space: slot xr::Space,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let (core, session) = runtime.session(session)?;
        core.actions.check_type(create_info.action, xr::ActionType::POSE_INPUT)?;
        core.actions.check_subaction_path(create_info.action, create_info.subaction_path)?;
        let reference_from_space = checked_pose(&create_info.pose_in_action_space, "poseInActionSpace")?;
        let kind = SpaceKind::Action(create_info.action, create_info.subaction_path);
        session.spaces.insert(handle, Space { kind, reference_from_space });
        *space = xr::Space::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_space: DestroySpace = "xrDestroySpace"(space: value xr::Space) {
        let mut runtime = runtime::lock();
        let session = runtime.instance.as_mut().and_then(|instance| instance.session.as_mut());
        let removed = session.and_then(|session| session.spaces.remove(&space.into_raw()));
        removed.map(|_| xr::Result::SUCCESS).ok_or_else(|| Fault::handle("space"))
    }
}

entry! {
    get_reference_space_bounds_rect: GetReferenceSpaceBoundsRect = "xrGetReferenceSpaceBoundsRect"(
        session: value xr::Session,
        reference_space_type: value xr::ReferenceSpaceType,
        bounds: slot xr::Extent2Df,
    ) {
        runtime::lock().session(session)?;
        let known = [xr::ReferenceSpaceType::VIEW, xr::ReferenceSpaceType::LOCAL, xr::ReferenceSpaceType::STAGE];
        if !known.contains(&reference_space_type) {
            let message = format!("{reference_space_type:?}; the mock runtime has VIEW, LOCAL and STAGE");
            return Err(Fault::application(xr::Result::ERROR_REFERENCE_SPACE_UNSUPPORTED, message));
        }
        *bounds = xr::Extent2Df { width: 0.0, height: 0.0 };
        Ok(xr::Result::SPACE_BOUNDS_UNAVAILABLE)
    }
}

entry! {
    locate_space: LocateSpace = "xrLocateSpace"(
        space: value xr::Space,
        base_space: value xr::Space,
        time: value xr::Time,
        location: output xr::SpaceLocation,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session_of_space(space)?;
        let time_ns = check_time(time)?;
        let (space, base) = (space_of(session, space)?, space_of(session, base_space)?);
        let pose = base_from_space(core, &base, &space, time_ns, time_ns);
        location.location_flags = match pose {
            Some(_) => xr::SpaceLocationFlags::ORIENTATION_VALID
                | xr::SpaceLocationFlags::POSITION_VALID
                | xr::SpaceLocationFlags::ORIENTATION_TRACKED
                | xr::SpaceLocationFlags::POSITION_TRACKED,
            None => xr::SpaceLocationFlags::EMPTY,
        };
        location.pose = pose_to_xr(pose.unwrap_or(Pose::IDENTITY));
        // SAFETY: the chain of a structure that the application wants filled in.
        if let Some(out) = unsafe { ffi::chained_output::<xr::SpaceVelocity>(location.next) } {
            check_flags(out)?;
            write_velocity(out, velocity(core, &base, &space, time_ns));
        }
        Ok(xr::Result::SUCCESS)
    }
}

/// Flags that come in are those of the call before, or what lay in memory that nobody set. Of the latter there are some that do not
/// exist, and the core validation layer, which looks at them on the way in, ends the program where it does not know one.
fn check_flags(velocity: &xr::SpaceVelocity) -> CallResult<()> {
    let known = xr::SpaceVelocityFlags::LINEAR_VALID | xr::SpaceVelocityFlags::ANGULAR_VALID;
    let flags = velocity.velocity_flags.into_raw();
    if flags & !known.into_raw() == 0 {
        return Ok(());
    }
    Err(Fault::usage(format!(
        "velocityFlags are {flags:#x} before the call, as of memory that nobody has set: hand over an XrSpaceVelocity set to zero"
    )))
}

fn write_velocity(out: &mut xr::SpaceVelocity, velocity: Option<(Vec3, Vec3)>) {
    out.velocity_flags = match velocity {
        Some(_) => xr::SpaceVelocityFlags::LINEAR_VALID | xr::SpaceVelocityFlags::ANGULAR_VALID,
        None => xr::SpaceVelocityFlags::EMPTY,
    };
    let (linear, angular) = velocity.unwrap_or_default();
    out.linear_velocity = vector_to_xr(linear);
    out.angular_velocity = vector_to_xr(angular);
}

entry! {
    locate_views: LocateViews = "xrLocateViews"(
        session: value xr::Session,
        view_locate_info: input xr::ViewLocateInfo,
        view_state: output xr::ViewState,
        capacity: value u32,
        count: raw_out u32,
        views: raw_out xr::View,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        check_view_configuration(view_locate_info.view_configuration_type)?;
        let time_ns = check_time(view_locate_info.display_time)?;
        let base = space_of(session, view_locate_info.space)?;
        let stage_from_base = stage_from_space(core, &base, time_ns);
        view_state.view_state_flags = match stage_from_base {
            Some(_) => xr::ViewStateFlags::ORIENTATION_VALID
                | xr::ViewStateFlags::POSITION_VALID
                | xr::ViewStateFlags::ORIENTATION_TRACKED
                | xr::ViewStateFlags::POSITION_TRACKED,
            None => xr::ViewStateFlags::EMPTY,
        };
        let base_from_stage = stage_from_base.unwrap_or(Pose::IDENTITY).inverse();
        let base_from_head = base_from_stage.then(stage_from_head(core, time_ns));
        let eyes = eyes(core).map(|(head_from_eye, fov)| (pose_to_xr(base_from_head.then(head_from_eye)), fov));
        // SAFETY: count and views are the caller's, of the capacity it says.
        unsafe {
            ffi::enumerate_structures((capacity, count, views), "views", &eyes, |view, (pose, fov)| {
                view.pose = *pose;
                view.fov = *fov;
            })
        }
    }
}

/// The two eyes in the head, left first.
fn eyes(core: &Core) -> [(Pose, xr::Fovf); 2] {
    let fovs = [core.config.fov_degrees.left_eye(), core.config.fov_degrees.right_eye()];
    let half_m = core.config.ipd_m * 0.5;
    [(-half_m, fovs[0]), (half_m, fovs[1])].map(|(x, fov)| {
        let head_from_eye = Pose { position: Vec3::new(x, 0.0, 0.0), orientation: Quat::IDENTITY };
        let fov =
            xr::Fovf { angle_left: fov.left, angle_right: fov.right, angle_up: fov.up, angle_down: fov.down };
        (head_from_eye, fov)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_vector_is_axis_times_angle_down_to_tiny_angles() {
        for angle in [0.0f32, 1e-5, 0.3, 3.0] {
            let vector = rotation_vector(Quat::from_axis_angle(Vec3::Y, angle));
            assert!((vector - Vec3::Y * angle).length() <= 1e-6 + angle * 1e-5, "{angle}: {vector}");
        }
        let backwards = rotation_vector(-Quat::from_rotation_x(0.2));
        assert!((backwards - Vec3::X * 0.2).length() < 1e-6, "{backwards}");
    }
}
