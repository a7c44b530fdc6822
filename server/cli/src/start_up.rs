//! Cache options of the command line, and the times of the steps of a start.

use clap::Args;
use shadecast_scene::cache::Cache;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Options of every command that loads a scene.
#[derive(Args)]
pub(crate) struct CacheArgs {
    /// Folder for processed assets [default: the user's cache folder]
    #[arg(long, conflicts_with = "no_cache")]
    cache_dir: Option<PathBuf>,
    /// Neither read nor write processed assets
    #[arg(long)]
    no_cache: bool,
}

impl CacheArgs {
    pub(crate) fn open(&self) -> Cache {
        match &self.cache_dir {
            _ if self.no_cache => Cache::disabled(),
            Some(folder) => Cache::new(folder),
            None => Cache::of_user(),
        }
    }
}

/// Steps of a start, each timed from the end of the previous one.
pub(crate) struct StartUp {
    begun: Instant,
    last: Instant,
    steps: Vec<(&'static str, Duration)>,
    cache: Cache,
}

impl StartUp {
    /// Begins a start.
    pub(crate) fn new(cache: Cache) -> Self {
        let begun = Instant::now();
        Self { begun, last: begun, steps: Vec::new(), cache }
    }

    /// Ends a step.
    pub(crate) fn ended(&mut self, step: &'static str) {
        let now = Instant::now();
        self.steps.push((step, now - self.last));
        self.last = now;
    }

    /// Prints the times of the finished start to standard error. Standard output may be a video.
    pub(crate) fn done(mut self, last_step: &'static str) {
        self.ended(last_step);
        let (hits, misses) = self.cache.hits_and_misses();
        let cached = if hits > 0 && misses == 0 { "cached" } else { "not cached" };
        let step = |(name, time): &(&str, Duration)| format!("{name} {:.2}", time.as_secs_f32());
        let steps: Vec<String> = self.steps.iter().map(step).collect();
        let total_s = self.begun.elapsed().as_secs_f32();
        eprintln!("ready in {total_s:.2} s ({cached}: {})", steps.join(", "));
    }
}
