//! Whole-system tests: processes, sockets, codec, GPU stages against their CPU twins.

use glam::{Vec3, Vec4};
use shadecast_gpu::{Access, Buffer, Gpu, Memory};
use shadecast_server::animation::packing::{unpack_frame, unpack_position};
use shadecast_server::skinning::gpu::Animation;
use shadecast_server::time::RingPlace;
use shadecast_shaders::constants::CHUNK_VERTICES;
use shadecast_shaders::generated::BoxGpu;
use std::sync::Arc;

/// What was skinned, as the device has it.
pub struct SavedVertices {
    boxes: Vec<BoxGpu>,
    positions: Vec<Vec<[u32; 2]>>,
    frames: Vec<Vec<[u32; 2]>>,
}

impl SavedVertices {
    /// All that an animation keeps; what was submitted is done.
    pub fn read(gpu: &Arc<Gpu>, animation: &Animation) -> Self {
        let all = |chunks: &[Buffer]| chunks.iter().map(|chunk| read(gpu, chunk)).collect();
        Self {
            boxes: read(gpu, animation.boxes()),
            positions: all(animation.saved_vertices()),
            frames: all(animation.tangents()),
        }
    }

    /// A vertex of an instance, in a place that it has.
    pub fn position(&self, animation: &Animation, instance: usize, place: RingPlace, vertex: usize) -> Vec3 {
        let base = animation.position_base(instance, place).expect("it is there");
        unpack_position(&self.boxes[instance], of(&self.positions, base, vertex))
    }

    /// Normal and tangent of a vertex.
    pub fn frame(&self, animation: &Animation, instance: usize, vertex: usize) -> (Vec3, Vec4) {
        let base = animation.tangent_base(instance).expect("it is there");
        unpack_frame(of(&self.frames, base, vertex))
    }
}

fn of(chunks: &[Vec<[u32; 2]>], base: u32, vertex: usize) -> [u32; 2] {
    chunks[(base / CHUNK_VERTICES) as usize][(base % CHUNK_VERTICES) as usize + vertex]
}

/// What a buffer holds; what was submitted is done.
pub fn read<T: bytemuck::Pod>(gpu: &Arc<Gpu>, buffer: &Buffer) -> Vec<T> {
    let target = Buffer::new(gpu, "read-back", buffer.size(), Memory::Readback).expect("memory");
    let mut recorder = gpu.record().expect("a device");
    recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
    recorder.copy_buffer(buffer, 0, &target, 0, buffer.size());
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    gpu.wait(recorder.submit().expect("a device")).expect("a device");
    target.values::<T>().to_vec()
}
