//! Twin of `mark.comp`.

/// Visible patches among `patches`, from ID buffers that hold patch number + 1 and 0 for background.
pub fn mark(id_buffers: &[u32], patches: usize) -> Vec<u32> {
    let mut visible = vec![0; patches];
    for number in id_buffers.iter().filter(|number| **number > 0) {
        visible[*number as usize - 1] = 1;
    }
    visible
}
