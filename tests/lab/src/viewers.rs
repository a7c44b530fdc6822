//! Several viewers of one world: a run for each, in which it is the client that ships and the others are as busy beside it.

use crate::options::{Head, RunOptions, ViewerOptions};
use crate::run::{Report, run};
use anyhow::Context;

/// Runs `options` once for each viewer; pictures and `stats.json` of the first go to `viewer-1`, and so on.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn run_each(options: &RunOptions, viewers: &[ViewerOptions]) -> anyhow::Result<Vec<Report>> {
    let measure = |index: usize| {
        let mut others = viewers.to_vec();
        let ViewerOptions { link, head } = others.remove(index);
        let out = options.out.join(format!("viewer-{}", index + 1));
        let head = head.map_or(Head::Walk, Head::File);
        run(&RunOptions { link, head, others, out, ..options.clone() })
            .with_context(|| format!("viewer {}", index + 1))
    };
    (0..viewers.len()).map(measure).collect()
}
