//! Pipelines in use, by what they are made of: a second user gets the first one's. Drivers compile a pipeline when it is made, or
//! when it draws first; either is too late for a viewer who waits.

use crate::bind::Layout;
use crate::lock::Lock;
use crate::memory::Garbage;
use crate::pass::OfViews;
use crate::{Gpu, GpuError};
use ash::vk;
use std::collections::HashMap;
use std::sync::{Arc, Weak};

/// A pipeline with its layout.
pub(crate) struct Made {
    gpu: Arc<Gpu>,
    pub handles: OfViews<vk::Pipeline>,
    pub layout: Arc<Layout>,
}

impl Made {
    pub(crate) fn new(gpu: &Arc<Gpu>, handles: OfViews<vk::Pipeline>, layout: Arc<Layout>) -> Self {
        Self { gpu: gpu.clone(), handles, layout }
    }
}

impl Drop for Made {
    fn drop(&mut self) {
        self.handles.iter().for_each(|pipeline| self.gpu.retire(Garbage::Pipeline(pipeline)));
    }
}

/// See the module. The key says all that a pipeline is made of.
#[derive(Default)]
pub(crate) struct SharedPipelines(Lock<HashMap<String, Weak<Made>>>);

impl SharedPipelines {
    /// The pipeline of this key: one in use, or a new one.
    pub(crate) fn get(
        &self,
        key: String,
        make: impl FnOnce() -> Result<Made, GpuError>,
    ) -> Result<Arc<Made>, GpuError> {
        let in_use = self.0.lock().get(&key).and_then(Weak::upgrade);
        if let Some(in_use) = in_use {
            return Ok(in_use);
        }
        let made = Arc::new(make()?);
        let mut all = self.0.lock();
        all.retain(|_, pipeline| pipeline.strong_count() > 0);
        all.insert(key, Arc::downgrade(&made));
        Ok(made)
    }
}

/// Keeps pipelines in use.
pub struct HeldPipelines(#[expect(dead_code, reason = "held, and never read")] Vec<Arc<Made>>);

impl Gpu {
    /// Keeps all pipelines that are in use now, for those who need them after their present users.
    pub fn hold_pipelines(&self) -> HeldPipelines {
        HeldPipelines(self.pipelines.0.lock().values().filter_map(Weak::upgrade).collect())
    }
}
