//! Twin of `spread.comp`: a ring around the visible patches.

use crate::constants::SPREAD;
use shadecast_protocol::limits::PATCH_MAX_VERTICES;
use std::collections::HashSet;

/// Adds to `visible` the patches that share a vertex with a visible one. `vertices`: of each patch.
pub fn spread(vertices: &[[u32; PATCH_MAX_VERTICES as usize]], visible: &mut [u32]) {
    let of_visible = vertices.iter().zip(&*visible).filter(|(_, visible)| **visible != 0);
    let reached: HashSet<u32> = of_visible.flat_map(|(vertices, _)| *vertices).collect();
    for (vertices, visible) in vertices.iter().zip(visible) {
        if *visible == 0 && vertices.iter().any(|vertex| reached.contains(vertex)) {
            *visible = SPREAD;
        }
    }
}
