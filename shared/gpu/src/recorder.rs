//! Recording of commands: a recording is a value, submitted once; slots come back when their fence has signalled.

use crate::bind::BindGroup;
use crate::lanes::{Between, Lane};
use crate::pass::{Framebuffer, Part, RenderPass};
use crate::pending::Fence;
use crate::pipeline::{ComputePipeline, GraphicsPipeline};
use crate::timings::{Timing, Timings};
use crate::ycbcr::YcbcrImage;
use crate::{Buffer, Doing, Gpu, GpuError, Image};
use ash::vk;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Scopes of a recording that are timed. A wide eye has three times of four turned frusta, each with two scopes.
const MAX_TIMED_SCOPES: u32 = 64;
/// Lavapipe (Mesa 25) writes a timestamp once for each view of the last pass, also after the pass: the last one's second view needs
/// a query.
const QUERIES: u32 = MAX_TIMED_SCOPES * 2 + 1;

/// A submitted recording; completes after those that were submitted before it, except for those beside it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ticket(pub(crate) u64);

/// Command pool, buffer, fence and timestamps of one recording.
pub(crate) struct CommandSlot {
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    /// Who asks for it or waits for it holds it: it is made unsignalled again only when nobody does.
    fence: Arc<vk::Fence>,
    queries: vk::QueryPool,
    scopes: Vec<&'static str>,
    lane: Lane,
    serial: u64,
}

/// Who touches memory, for barriers: stages and kinds of access together.
#[derive(Clone, Copy, Debug)]
pub struct Access(pub vk::PipelineStageFlags, pub vk::AccessFlags);

impl Access {
    /// Nothing before.
    pub const NONE: Self = Self(vk::PipelineStageFlags::TOP_OF_PIPE, vk::AccessFlags::empty());
    /// Compute shaders write.
    pub const COMPUTE_WRITE: Self =
        Self(vk::PipelineStageFlags::COMPUTE_SHADER, vk::AccessFlags::SHADER_WRITE);
    /// Compute shaders read.
    pub const COMPUTE_READ: Self = Self(vk::PipelineStageFlags::COMPUTE_SHADER, vk::AccessFlags::SHADER_READ);
    /// Compute shaders read and write.
    pub const COMPUTE: Self = Self(
        vk::PipelineStageFlags::COMPUTE_SHADER,
        vk::AccessFlags::from_raw(
            vk::AccessFlags::SHADER_READ.as_raw() | vk::AccessFlags::SHADER_WRITE.as_raw(),
        ),
    );
    /// Vertex shaders read.
    pub const VERTEX_READ: Self = Self(vk::PipelineStageFlags::VERTEX_SHADER, vk::AccessFlags::SHADER_READ);
    /// Vertex and fragment shaders read.
    pub const GRAPHICS_READ: Self = Self(
        vk::PipelineStageFlags::from_raw(
            vk::PipelineStageFlags::VERTEX_SHADER.as_raw() | vk::PipelineStageFlags::FRAGMENT_SHADER.as_raw(),
        ),
        vk::AccessFlags::SHADER_READ,
    );
    /// Fragment shaders read.
    pub const FRAGMENT_READ: Self =
        Self(vk::PipelineStageFlags::FRAGMENT_SHADER, vk::AccessFlags::SHADER_READ);
    /// Fragment and compute shaders read.
    pub const PICTURE_READ: Self = Self(
        vk::PipelineStageFlags::from_raw(
            vk::PipelineStageFlags::FRAGMENT_SHADER.as_raw()
                | vk::PipelineStageFlags::COMPUTE_SHADER.as_raw(),
        ),
        vk::AccessFlags::SHADER_READ,
    );
    /// A pass has written colour.
    pub const COLOR_WRITE: Self =
        Self(vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT, vk::AccessFlags::COLOR_ATTACHMENT_WRITE);
    /// A pass has written depth that outlives it.
    pub const DEPTH_WRITE: Self =
        Self(vk::PipelineStageFlags::LATE_FRAGMENT_TESTS, vk::AccessFlags::DEPTH_STENCIL_ATTACHMENT_WRITE);
    /// Copies read.
    pub const COPY_READ: Self = Self(vk::PipelineStageFlags::TRANSFER, vk::AccessFlags::TRANSFER_READ);
    /// Copies write.
    pub const COPY_WRITE: Self = Self(vk::PipelineStageFlags::TRANSFER, vk::AccessFlags::TRANSFER_WRITE);
    /// The CPU reads mapped memory after the fence.
    pub const HOST_READ: Self = Self(vk::PipelineStageFlags::HOST, vk::AccessFlags::HOST_READ);
}

/// A recording in progress. Dropping it unsubmitted gives the slot back unused.
pub struct Recorder {
    gpu: Arc<Gpu>,
    slot: Option<CommandSlot>,
    /// The open pass draws the first view alone.
    first_alone: bool,
}

impl CommandSlot {
    fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let device = &gpu.device();
        // SAFETY: the device is alive; the buffer comes from the pool just made.
        unsafe {
            let info = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.queue_family);
            let pool = device.create_command_pool(&info, None).doing("creating a command pool")?;
            let info = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            let commands = device.allocate_command_buffers(&info).doing("allocating a command buffer")?[0];
            let fence =
                device.create_fence(&vk::FenceCreateInfo::default(), None).doing("creating a fence")?;
            let info =
                vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(QUERIES);
            let queries = device.create_query_pool(&info, None).doing("creating a query pool")?;
            let scopes = Vec::with_capacity(MAX_TIMED_SCOPES as usize);
            Ok(Self { pool, commands, fence: Arc::new(fence), queries, scopes, lane: Lane::Main, serial: 0 })
        }
    }

    pub(crate) fn destroy(self, device: &ash::Device) {
        // SAFETY: called with the device idle.
        unsafe {
            device.destroy_query_pool(self.queries, None);
            device.destroy_fence(*self.fence, None);
            device.destroy_command_pool(self.pool, None);
        }
    }

    fn read_timings(&self, gpu: &Gpu) {
        if self.scopes.is_empty() {
            return;
        }
        let mut stamps = [0u64; MAX_TIMED_SCOPES as usize * 2];
        let count = self.scopes.len() * 2;
        // SAFETY: the recording wrote these queries and has finished.
        let read = unsafe {
            gpu.device().get_query_pool_results(
                self.queries,
                0,
                &mut stamps[..count],
                vk::QueryResultFlags::TYPE_64,
            )
        };
        if read.is_err() {
            return;
        }
        let period_ns = f64::from(gpu.properties.limits.timestamp_period);
        let ns = |ticks: u64| (ticks as f64 * period_ns) as i64;
        let timing = |(scope, pair): (&&'static str, &[u64])| Timing {
            scope,
            began_ns: ns(pair[0]),
            took_ns: ns(ticks_between([pair[0], pair[1]], gpu.timestamp_bits)),
        };
        let mut timings = gpu.timings.lock();
        timings.keep(self.serial, self.scopes.iter().zip(stamps.chunks_exact(2)).map(timing));
    }
}

/// Ticks from one timestamp to the next, of which so many bits count: 36 to 64. They begin anew after the largest.
fn ticks_between([began, ended]: [u64; 2], bits: u32) -> u64 {
    ended.wrapping_sub(began) & (u64::MAX >> (64 - bits.clamp(1, 64)))
}

impl Gpu {
    /// Starts a recording.
    pub fn record(self: &Arc<Self>) -> Result<Recorder, GpuError> {
        self.reclaim()?;
        let mut slot = match self.idle_slot() {
            Some(slot) => slot,
            None => CommandSlot::new(self)?,
        };
        slot.scopes.clear();
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the slot is idle: new, or its fence has signalled and is nobody else's.
        unsafe {
            self.device().reset_fences(&[*slot.fence]).doing("resetting a fence")?;
            let reset = self.device().reset_command_pool(slot.pool, vk::CommandPoolResetFlags::empty());
            reset.doing("resetting a command pool")?;
            self.device().begin_command_buffer(slot.commands, &info).doing("beginning a recording")?;
            self.device().cmd_reset_query_pool(slot.commands, slot.queries, 0, QUERIES);
        }
        Ok(Recorder { gpu: self.clone(), slot: Some(slot), first_alone: false })
    }

    /// One whose fence nobody holds any more. Those that lie idle are given to nobody.
    fn idle_slot(&self) -> Option<CommandSlot> {
        let mut idle = self.idle_slots.lock();
        let place = idle.iter().position(|slot| Arc::strong_count(&slot.fence) == 1)?;
        Some(idle.swap_remove(place))
    }

    /// Waits until the recording behind `ticket` has finished, and with it all before it on its queue.
    pub fn wait(&self, ticket: Ticket) -> Result<(), GpuError> {
        while self.wait_for_fence(ticket, u64::MAX)? {
            self.reclaim()?;
        }
        Ok(())
    }

    /// The same, at most so long; false where the recording had finished before.
    pub fn wait_at_most(&self, ticket: Ticket, at_most: Duration) -> Result<bool, GpuError> {
        self.wait_for_fence(ticket, at_most.as_nanos() as u64)
    }

    /// False where the recording is known to be done, and nothing was waited for.
    fn wait_for_fence(&self, ticket: Ticket, at_most_ns: u64) -> Result<bool, GpuError> {
        let fence = match self.pending.fence_of(ticket.0) {
            Fence::Done => return Ok(false),
            // Another thread takes it back just now.
            Fence::Signalled => return Ok(true),
            Fence::Submitted(fence) => fence,
        };
        // SAFETY: the fence belongs to a submitted recording, and is not reset while it is held here.
        match unsafe { self.device().wait_for_fences(&[*fence], true, at_most_ns) } {
            Err(vk::Result::TIMEOUT) => Ok(true),
            waited => waited.doing("waiting for the GPU").map(|()| true),
        }
    }

    /// Waits as [`Self::wait`] does. Gives how long the scopes of the recording behind `ticket` took: once, and only while
    /// it is among the newest.
    pub fn wait_timed(&self, ticket: Ticket) -> Result<Timings, GpuError> {
        let mut timings = Timings::default();
        self.wait_timed_into(ticket, &mut timings)?;
        Ok(timings)
    }

    /// The same, added to timings of other recordings.
    pub fn wait_timed_into(&self, ticket: Ticket, timings: &mut Timings) -> Result<(), GpuError> {
        self.wait(ticket)?;
        self.timings.lock().take(ticket.0, timings);
        Ok(())
    }

    /// Whether the recording behind `ticket` has finished.
    pub fn is_done(&self, ticket: Ticket) -> Result<bool, GpuError> {
        self.reclaim()?;
        Ok(self.pending.is_done(ticket.0))
    }

    /// Takes back the slots whose fence has signalled, and destroys what only they and those before them used, where that is left to
    /// nobody else.
    fn reclaim(&self) -> Result<(), GpuError> {
        let mut serial = 0;
        while let Some((next, fence)) = self.pending.next_submitted(serial) {
            serial = next;
            // SAFETY: the fence belongs to a submitted recording, and is not reset while it is held here.
            let signalled = unsafe { self.device().get_fence_status(*fence) };
            if signalled.doing("asking for a fence")? {
                self.take_back(serial);
            }
        }
        self.pending.note_completed();
        if !self.leaves_retired.load(Ordering::Relaxed) {
            self.destroy_retired();
        }
        Ok(())
    }

    /// Takes back the slot of a recording that has finished, unless another thread does.
    fn take_back(&self, serial: u64) {
        let Some(slot) = self.pending.take(serial) else { return };
        slot.read_timings(self);
        self.lanes.note(slot.lane, slot.serial);
        self.idle_slots.lock().push(slot);
        self.pending.forget(serial);
    }
}

impl Recorder {
    fn slot(&self) -> &CommandSlot {
        self.slot.as_ref().expect("present until submitted")
    }

    /// The command buffer, for commands that have no method here.
    pub fn commands(&self) -> vk::CommandBuffer {
        self.slot().commands
    }

    /// Ends the recording and submits it.
    pub fn submit(self) -> Result<Ticket, GpuError> {
        self.submit_with(Lane::Main, Between::default())
    }

    /// Ends the recording and submits it to the device's other queue, if there is one: it runs beside what others submit with
    /// [`Self::submit`], and sees what those wrote that are known to have finished by now. They see of it what is known likewise.
    pub fn submit_beside(self) -> Result<Ticket, GpuError> {
        self.submit_with(Lane::Beside, Between::default())
    }

    /// Ends the recording and submits it: colour is written after `before`, and `after` follows all of it.
    #[cfg(feature = "window")]
    pub(crate) fn submit_between(
        self,
        before: vk::Semaphore,
        after: vk::Semaphore,
    ) -> Result<Ticket, GpuError> {
        self.submit_with(Lane::Main, Between { before: Some(before), after: Some(after) })
    }

    fn submit_with(mut self, lane: Lane, between: Between) -> Result<Ticket, GpuError> {
        // SAFETY: the buffer is being recorded, in no pass.
        unsafe { self.gpu.device().end_command_buffer(self.commands()) }.doing("ending a recording")?;
        let slot = self.slot.take().expect("present until submitted");
        let Gpu { pending, lanes, .. } = &*self.gpu;
        // Recordings are submitted in the order of their serials.
        lanes.in_turn(|| {
            let serial = pending.begin();
            let (commands, fence) = (slot.commands, slot.fence.clone());
            let submitted = lanes.submit(self.gpu.device(), lane, serial, commands, between, *fence);
            let slot = CommandSlot { lane, serial, ..slot };
            match submitted {
                Ok(()) => pending.submitted(serial, slot, fence),
                Err(_) => {
                    self.gpu.idle_slots.lock().push(slot);
                    pending.forget(serial);
                }
            }
            submitted.map(|()| Ticket(serial))
        })
    }

    /// Times what `body` records under `name`; see [`Gpu::wait_timed`].
    pub fn scope<R>(&mut self, name: &'static str, body: impl FnOnce(&mut Self) -> R) -> R {
        let index = self.slot().scopes.len() as u32;
        let timed = index < MAX_TIMED_SCOPES && self.gpu.timestamp_bits > 0;
        if timed {
            self.slot.as_mut().expect("present until submitted").scopes.push(name);
            self.timestamp(index * 2);
        }
        let result = body(self);
        if timed {
            self.timestamp(index * 2 + 1);
        }
        result
    }

    /// Once all before it has ended: what of it still ran would be told twice.
    fn timestamp(&mut self, query: u32) {
        let (slot, stage) = (self.slot(), vk::PipelineStageFlags::BOTTOM_OF_PIPE);
        // SAFETY: the query is in range and was reset at the recording's start.
        unsafe { self.gpu.device().cmd_write_timestamp(slot.commands, stage, slot.queries, query) };
    }

    /// Dispatches an invocation for each of `items` in x, y and z; the last workgroups may have more.
    pub fn dispatch<P: bytemuck::Pod>(
        &mut self,
        pipeline: &ComputePipeline,
        group: &BindGroup,
        push: &P,
        items: [u32; 3],
    ) {
        self.dispatch_each(pipeline, group, std::iter::once((push, items)));
    }

    /// A dispatch for each push constants with its items, see [`Self::dispatch`]; nothing waits in between.
    pub fn dispatch_each<'a, P: bytemuck::Pod>(
        &mut self,
        pipeline: &ComputePipeline,
        group: &BindGroup,
        dispatches: impl Iterator<Item = (&'a P, [u32; 3])>,
    ) {
        let (device, commands, layout) = (&self.gpu.device(), self.commands(), pipeline.layout());
        // SAFETY: pipeline and set are alive and of one layout.
        unsafe {
            device.cmd_bind_pipeline(commands, vk::PipelineBindPoint::COMPUTE, pipeline.handle());
            let (sets, point) = ([group.set], vk::PipelineBindPoint::COMPUTE);
            device.cmd_bind_descriptor_sets(commands, point, layout.handle, 0, &sets, &[]);
        }
        for (push, items) in dispatches {
            self.push(layout, push);
            let [x, y, z] = pipeline.groups(items);
            // SAFETY: pipeline, set and push constants are those of the layout.
            unsafe { device.cmd_dispatch(commands, x, y, z) };
        }
    }

    fn push<P: bytemuck::Pod>(&self, layout: &crate::Layout, push: &P) {
        if layout.push_bytes == 0 {
            return;
        }
        let bytes = bytemuck::bytes_of(push);
        let used = layout.push_bytes as usize;
        assert!(bytes.len() >= used, "push constants of {} bytes, {} given", used, bytes.len());
        // SAFETY: the range and its stages are the layout's.
        unsafe {
            self.gpu.device().cmd_push_constants(
                self.commands(),
                layout.handle,
                layout.push_stages,
                0,
                &bytes[..used],
            );
        }
    }

    /// Begins a pass over the whole framebuffer with viewport and scissor set.
    pub fn begin_pass(&mut self, pass: &RenderPass, target: &Framebuffer, clears: &[vk::ClearValue]) {
        let all = Part { extent: target.extent, first_alone: false };
        self.begin_pass_of(pass, target, clears, all);
    }

    /// The same over a part.
    pub fn begin_pass_of(
        &mut self,
        pass: &RenderPass,
        target: &Framebuffer,
        clears: &[vk::ClearValue],
        Part { extent: [width, height], first_alone }: Part,
    ) {
        self.first_alone = first_alone;
        let area = vk::Rect2D { offset: vk::Offset2D::default(), extent: vk::Extent2D { width, height } };
        let info = vk::RenderPassBeginInfo::default()
            .render_pass(pass.handles.of(first_alone))
            .framebuffer(target.handles.of(first_alone))
            .render_area(area)
            .clear_values(clears);
        let viewport =
            vk::Viewport { width: width as f32, height: height as f32, max_depth: 1.0, ..Default::default() };
        // SAFETY: pass and framebuffer are alive and compatible.
        unsafe {
            let (device, commands) = (&self.gpu.device(), self.commands());
            device.cmd_begin_render_pass(commands, &info, vk::SubpassContents::INLINE);
            device.cmd_set_viewport(commands, 0, &[viewport]);
            device.cmd_set_scissor(commands, 0, &[area]);
        }
    }

    /// Fills rectangles of the first colour attachment of the pass, left, top, right and bottom in texels.
    pub fn clear_rects(&mut self, color: [f32; 4], rects: impl Iterator<Item = [u32; 4]>) {
        let rect = |[left, top, right, bottom]: [u32; 4]| vk::ClearRect {
            rect: vk::Rect2D {
                offset: vk::Offset2D { x: left as i32, y: top as i32 },
                extent: vk::Extent2D { width: right - left, height: bottom - top },
            },
            base_array_layer: 0,
            layer_count: 1,
        };
        let rects: Vec<vk::ClearRect> = rects.map(rect).collect();
        if rects.is_empty() {
            return;
        }
        let fill = vk::ClearAttachment {
            aspect_mask: vk::ImageAspectFlags::COLOR,
            color_attachment: 0,
            clear_value: vk::ClearValue { color: vk::ClearColorValue { float32: color } },
        };
        // SAFETY: the command buffer records a pass with a colour attachment, in which the rectangles lie.
        unsafe { self.gpu.device().cmd_clear_attachments(self.commands(), &[fill], &rects) };
    }

    /// Ends the pass.
    pub fn end_pass(&mut self) {
        // SAFETY: a pass is open.
        unsafe { self.gpu.device().cmd_end_render_pass(self.commands()) };
    }

    /// Binds pipeline and set for the following draws.
    pub fn bind(&mut self, pipeline: &GraphicsPipeline, group: &BindGroup) {
        let point = vk::PipelineBindPoint::GRAPHICS;
        // SAFETY: pipeline and set are alive and of one layout.
        unsafe {
            let (device, commands) = (&self.gpu.device(), self.commands());
            device.cmd_bind_pipeline(commands, point, pipeline.handle(self.first_alone));
            let sets = [group.set];
            device.cmd_bind_descriptor_sets(commands, point, pipeline.layout().handle, 0, &sets, &[]);
        }
    }

    /// Binds a pipeline without descriptors.
    pub fn bind_pipeline(&mut self, pipeline: &GraphicsPipeline) {
        // SAFETY: the pipeline is alive.
        unsafe {
            self.gpu.device().cmd_bind_pipeline(
                self.commands(),
                vk::PipelineBindPoint::GRAPHICS,
                pipeline.handle(self.first_alone),
            );
        }
    }

    /// Push constants for the following draws with `pipeline`.
    pub fn push_constants<P: bytemuck::Pod>(&mut self, pipeline: &GraphicsPipeline, push: &P) {
        self.push(pipeline.layout(), push);
    }

    /// The index buffer (32 bit) for the following draws.
    pub fn bind_indices(&mut self, buffer: &Buffer, offset_bytes: u64) {
        // SAFETY: the buffer is alive.
        unsafe {
            let (device, commands) = (&self.gpu.device(), self.commands());
            device.cmd_bind_index_buffer(commands, buffer.handle, offset_bytes, vk::IndexType::UINT32);
        }
    }

    /// The vertex buffer for the following draws.
    pub fn bind_vertices(&mut self, buffer: &Buffer, offset_bytes: u64) {
        // SAFETY: the buffer is alive.
        unsafe {
            let (device, commands) = (&self.gpu.device(), self.commands());
            device.cmd_bind_vertex_buffers(commands, 0, &[buffer.handle], &[offset_bytes]);
        }
    }

    /// Draws `vertices` vertices to the pixels of a corner of the target, width and height from its first pixel on; none where one is 0.
    /// Later draws of the pass keep to these pixels too.
    pub fn draw_within(&mut self, [width, height]: [u32; 2], vertices: u32) {
        if width == 0 || height == 0 {
            return;
        }
        let area = vk::Rect2D { offset: vk::Offset2D::default(), extent: vk::Extent2D { width, height } };
        // SAFETY: pipeline and sets are bound; the scissor is dynamic state.
        unsafe { self.gpu.device().cmd_set_scissor(self.commands(), 0, &[area]) };
        self.draw(vertices, 1);
    }

    /// Draws `vertices` vertices of `instances` instances.
    pub fn draw(&mut self, vertices: u32, instances: u32) {
        // SAFETY: pipeline and sets are bound.
        unsafe { self.gpu.device().cmd_draw(self.commands(), vertices, instances, 0, 0) };
    }

    /// Draws `count` indices from `first` on.
    pub fn draw_indexed(&mut self, first: u32, count: u32) {
        // SAFETY: pipeline, sets and index buffer are bound.
        unsafe { self.gpu.device().cmd_draw_indexed(self.commands(), count, 1, first, 0, 0) };
    }

    /// Orders memory accesses.
    pub fn barrier(&mut self, before: Access, after: Access) {
        let barrier = vk::MemoryBarrier::default().src_access_mask(before.1).dst_access_mask(after.1);
        // SAFETY: stages and accesses fit together by `Access`'s constants.
        unsafe {
            let flags = vk::DependencyFlags::empty();
            let commands = self.commands();
            self.gpu.device().cmd_pipeline_barrier(commands, before.0, after.0, flags, &[barrier], &[], &[]);
        }
    }

    /// Moves an image to another layout.
    pub fn transition(
        &mut self,
        image: &Image,
        layouts: [vk::ImageLayout; 2],
        before: Access,
        after: Access,
    ) {
        self.transition_range(image, image.whole(), layouts, before, after);
    }

    /// Takes over a picture that something else than this device has written, so that fragment and compute shaders can read it.
    pub fn take_over(&mut self, picture: &YcbcrImage) {
        let barrier = vk::ImageMemoryBarrier::default()
            .image(picture.image.handle)
            .subresource_range(picture.image.whole())
            // What a platform has written to its memory stays there: a layout is this device's affair.
            .old_layout(vk::ImageLayout::UNDEFINED)
            .new_layout(vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL)
            .dst_access_mask(Access::PICTURE_READ.1)
            .src_queue_family_index(vk::QUEUE_FAMILY_FOREIGN_EXT)
            .dst_queue_family_index(self.gpu.queue_family);
        let (before, after) = (Access::NONE.0, Access::PICTURE_READ.0);
        // SAFETY: the image is alive, and belongs to nobody else until it is given back.
        unsafe {
            let (commands, flags) = (self.commands(), vk::DependencyFlags::empty());
            self.gpu.device().cmd_pipeline_barrier(commands, before, after, flags, &[], &[], &[barrier]);
        }
    }

    /// Moves a part of an image to another layout.
    pub fn transition_range(
        &mut self,
        image: &Image,
        range: vk::ImageSubresourceRange,
        layouts: [vk::ImageLayout; 2],
        before: Access,
        after: Access,
    ) {
        let barrier = vk::ImageMemoryBarrier::default()
            .image(image.handle)
            .subresource_range(range)
            .old_layout(layouts[0])
            .new_layout(layouts[1])
            .src_access_mask(before.1)
            .dst_access_mask(after.1)
            .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED);
        // SAFETY: the image is alive and in the first layout.
        unsafe {
            let flags = vk::DependencyFlags::empty();
            let commands = self.commands();
            self.gpu.device().cmd_pipeline_barrier(commands, before.0, after.0, flags, &[], &[], &[barrier]);
        }
    }

    /// Copies bytes.
    pub fn copy_buffer(&mut self, from: &Buffer, from_offset: u64, to: &Buffer, to_offset: u64, size: u64) {
        if size == 0 {
            return;
        }
        let region = vk::BufferCopy { src_offset: from_offset, dst_offset: to_offset, size };
        // SAFETY: both buffers are alive; ranges are checked by the validation layers in tests.
        unsafe { self.gpu.device().cmd_copy_buffer(self.commands(), from.handle, to.handle, &[region]) };
    }

    /// Fills a buffer with a word.
    pub fn fill(&mut self, buffer: &Buffer, word: u32) {
        // SAFETY: the buffer is alive; its size is a multiple of 16.
        unsafe {
            self.gpu.device().cmd_fill_buffer(self.commands(), buffer.handle, 0, vk::WHOLE_SIZE, word);
        }
    }

    /// Clears a colour image (in TRANSFER_DST_OPTIMAL).
    pub fn clear_image(&mut self, image: &Image, color: [f32; 4]) {
        let value = vk::ClearColorValue { float32: color };
        let layout = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
        let ranges = [image.whole()];
        // SAFETY: the image is alive, of a float or normalised format, and in the layout named above.
        unsafe {
            self.gpu.device().cmd_clear_color_image(self.commands(), image.handle, layout, &value, &ranges);
        }
    }

    /// Copies the finest level of one layer of an image (in TRANSFER_SRC_OPTIMAL) to a buffer, rows tight.
    pub fn read_image(&mut self, image: &Image, layer: u32, buffer: &Buffer, offset_bytes: u64) {
        self.read_level(image, [layer, 0], buffer, offset_bytes);
    }

    /// The same of a layer and a mip level.
    pub fn read_level(&mut self, image: &Image, [layer, mip]: [u32; 2], buffer: &Buffer, offset_bytes: u64) {
        let extent = image.desc().extent.map(|side| (side >> mip).max(1));
        let region = region(image, extent, layer, mip, offset_bytes);
        // SAFETY: both are alive and the image is in the layout named above.
        unsafe {
            self.gpu.device().cmd_copy_image_to_buffer(
                self.commands(),
                image.handle,
                vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
                buffer.handle,
                &[region],
            );
        }
    }

    /// Copies tight rows from a buffer to one mip level of an image (in TRANSFER_DST_OPTIMAL).
    pub fn write_image(&mut self, image: &Image, mip: u32, buffer: &Buffer, offset_bytes: u64) {
        let extent = image.desc().extent.map(|side| (side >> mip).max(1));
        self.write_region(image, buffer, region(image, extent, 0, mip, offset_bytes));
    }

    /// Copies buffer bytes into plane 0, 1 or 2 of a picture of planes, of which the latter have half the extent; it is in
    /// TRANSFER_DST_OPTIMAL.
    pub fn write_plane(&mut self, picture: &YcbcrImage, plane: u32, buffer: &Buffer, offset_bytes: u64) {
        let image = &picture.image;
        let extent = image.desc().extent.map(|side| if plane == 0 { side } else { side / 2 });
        let mut region = region(image, extent, 0, 0, offset_bytes);
        region.image_subresource.aspect_mask =
            vk::ImageAspectFlags::from_raw(vk::ImageAspectFlags::PLANE_0.as_raw() << plane);
        self.write_region(image, buffer, region);
    }

    fn write_region(&mut self, image: &Image, buffer: &Buffer, region: vk::BufferImageCopy) {
        // SAFETY: both are alive and the image is in the layout named above.
        unsafe {
            self.gpu.device().cmd_copy_buffer_to_image(
                self.commands(),
                buffer.handle,
                image.handle,
                vk::ImageLayout::TRANSFER_DST_OPTIMAL,
                &[region],
            );
        }
    }
}

fn region(image: &Image, extent: [u32; 2], layer: u32, mip: u32, offset: u64) -> vk::BufferImageCopy {
    vk::BufferImageCopy {
        buffer_offset: offset,
        image_subresource: vk::ImageSubresourceLayers {
            aspect_mask: image.whole().aspect_mask,
            mip_level: mip,
            base_array_layer: layer,
            layer_count: 1,
        },
        image_extent: vk::Extent3D { width: extent[0], height: extent[1], depth: 1 },
        ..Default::default()
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Some(slot) = self.slot.take() {
            // The buffer is reset when the slot is used again.
            self.gpu.idle_slots.lock().push(slot);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_that_begins_anew_between_two_timestamps_costs_nothing() {
        assert_eq!(ticks_between([10, 25], 64), 15);
        assert_eq!(ticks_between([(1 << 36) - 5, 10], 36), 15);
        assert_eq!(ticks_between([u64::MAX - 4, 10], 64), 15);
    }
}
