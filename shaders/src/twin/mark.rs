//! Twin of `mark.comp`.

use crate::constants::FIRST_ID;

/// Visible patches among `patches`, from ID buffers that hold patch numbers from [`FIRST_ID`] on, and 0 for background.
pub fn mark(id_buffers: &[u32], patches: usize) -> Vec<u32> {
    let mut visible = vec![0; patches];
    for number in id_buffers.iter().filter_map(|id| id.checked_sub(FIRST_ID)) {
        visible[number as usize] = 1;
    }
    visible
}
