//! From the library's double precision types to ours.

use crate::import;
use glam::{Affine3A, Quat, Vec3};
use shadecast_model::text::printable;

pub(super) fn vec3(v: ufbx::Vec3) -> Vec3 {
    Vec3::new(v.x as f32, v.y as f32, v.z as f32)
}

/// A unit quaternion; `None` for what is none.
pub(super) fn rotation(q: ufbx::Quat) -> Option<Quat> {
    let quat = Quat::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32);
    let length = quat.length();
    (length.is_finite() && length > 1e-6).then(|| quat / length)
}

/// `None` where a number is not finite.
pub(super) fn affine(m: &ufbx::Matrix) -> Option<Affine3A> {
    let column = |x: f64, y: f64, z: f64| Vec3::new(x as f32, y as f32, z as f32);
    let matrix = Affine3A::from_cols(
        column(m.m00, m.m10, m.m20).into(),
        column(m.m01, m.m11, m.m21).into(),
        column(m.m02, m.m12, m.m22).into(),
        column(m.m03, m.m13, m.m23).into(),
    );
    matrix.is_finite().then_some(matrix)
}

/// `mesh 'x'` where it has a name, `mesh 3` where not.
pub(super) fn label(kind: &str, element: &ufbx::Element) -> String {
    let name = element.name.as_ref();
    import::label(kind, element.typed_id as usize, (!name.is_empty()).then_some(name))
}

/// The name, or one made up of kind and number.
pub(super) fn name(kind: &str, element: &ufbx::Element) -> String {
    match element.name.as_ref() {
        "" => format!("{kind} {}", element.typed_id),
        name => printable(name),
    }
}
