//! The general Vulkan code: device, memory, retire ring, pipelines from reflection, recorder.
