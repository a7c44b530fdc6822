//! A rehearsal before anybody comes: small updates of the scene for a viewer who stands at its start. Drivers compile a pipeline
//! when it is made, or when it draws first. After the rehearsal that is done.

use crate::serve::stream::{StreamOptions, offer};
use crate::update::ViewerUpdates;
use crate::world::{ViewerId, World};
use glam::Vec3;
use shadecast_gpu::GpuError;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{Capabilities, ClientHello, HeadState, negotiate};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::time::ServerTime;
use shadecast_system::monotonic_now_ns;

/// Pixels per eye: as few as show something.
const EXTENT_PIXELS: [u32; 2] = [64, 64];
const FOV_DEGREES: f32 = 90.0;
const HALF_PUPILS_M: f32 = 0.0315;
const EYE_HEIGHT_M: f32 = 1.6;
const DISPLAY_PERIOD_NS: i64 = 13_888_889;
/// Updates: the second has blocks whose surface was shaded before, and is for one eye.
const UPDATES: i64 = 2;

/// Makes them, and says when all pipelines are in use. Gives how long the last one took, nanoseconds: updates of a viewer take no less.
pub(super) fn rehearse(
    world: &mut World,
    options: &StreamOptions,
    all_in_use: impl FnOnce(),
) -> Result<i64, GpuError> {
    let eye = |x: f32| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), ..Pose::IDENTITY },
        fov: Fov::symmetric_degrees(FOV_DEGREES),
    };
    let eyes = [eye(-HALF_PUPILS_M), eye(HALF_PUPILS_M)];
    let capabilities = Capabilities::most(eyes, EXTENT_PIXELS, DISPLAY_PERIOD_NS);
    let hello = ClientHello::new(env!("CARGO_PKG_VERSION"), capabilities);
    let offer = offer(world.scene(), AtlasExtent::MIN, options.rate_hz, 0);
    let welcome = negotiate(&hello, &offer).expect("the server's own offer suits a client that takes all");
    let mut updates =
        ViewerUpdates::new(world, ViewerId::REHEARSAL, &welcome, &hello.capabilities, options.show)?;
    let height = Pose { position: Vec3::new(0.0, EYE_HEIGHT_M, 0.0), ..Pose::IDENTITY };
    let mut took_ns = 0;
    for number in 0..UPDATES {
        let began_ns = monotonic_now_ns();
        let time = ServerTime(number * welcome.update_period_ns);
        updates.head(HeadState {
            sequence: number as u32,
            time,
            world_from_head: welcome.world_from_stage.then(height),
            linear_velocity: Vec3::ZERO,
            angular_velocity: Vec3::ZERO,
            eyes: if number == 0 { hello.capabilities.eyes } else { [hello.capabilities.eyes[0]; 2] },
            discontinuity: DiscontinuityId(0),
        });
        updates.update(world, time)?;
        took_ns = monotonic_now_ns() - began_ns;
    }
    all_in_use();
    updates.leave(world);
    Ok(took_ns)
}
