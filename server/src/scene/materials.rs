//! Materials of all models with their textures, and how these are sampled; equal textures are there once.

use super::SceneGpuError;
use crate::support::upload;
use ash::vk;
use shadecast_gpu::limits::check_textures;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Image, ImageDesc, Sampler, SamplerDesc};
use shadecast_scene::identity::{ContentHash, texture_hash};
use shadecast_scene::{Cancel, Material, Model, Texture, TextureSlot, Wrap};
use shadecast_shaders::constants::{
    BASE_COLOR_SLOT, EMISSIVE_SLOT, METALLIC_ROUGHNESS_SLOT, NO_ALPHA_CUTOFF, NO_TEXTURE, NORMAL_SLOT,
    OCCLUSION_SLOT, TEXTURE_SLOTS,
};
use shadecast_shaders::generated::MaterialGpu;
use std::collections::HashMap;
use std::sync::Arc;

/// A lookup between two mip levels spreads a texel like a box of 1 and a triangle of 2, with variances of 1/12 and 1/6: as far as a box of
/// the square root of 3. From levels finer by half the binary logarithm of 3 it spreads as far as a pixel.
const TEXTURE_MIP_BIAS: f32 = -0.792_481_25;

/// The materials of all models.
pub struct Materials {
    /// `MaterialGpu`.
    pub buffer: Buffer,
    textures: Vec<Image>,
    samplers: Vec<Sampler>,
    sampler_of_texture: Vec<usize>,
}

impl Materials {
    /// Textures that shaders choose from.
    pub(crate) fn texture_count(&self) -> u32 {
        self.textures.len() as u32
    }

    /// Every texture with its sampler, in scene-wide order.
    pub fn texture_binds(&self) -> Vec<(&Image, &Sampler)> {
        self.textures.iter().zip(&self.sampler_of_texture).map(|(t, s)| (t, &self.samplers[*s])).collect()
    }
}

/// What goes into [`Materials`], collected model by model.
#[derive(Default)]
pub(super) struct MaterialArrays<'a> {
    materials: Vec<MaterialGpu>,
    textures: UniqueTextures<'a>,
}

impl<'a> MaterialArrays<'a> {
    /// Adds a model's materials; gives the place of the first.
    pub(super) fn add(&mut self, model: &'a Model) -> u32 {
        let base = self.materials.len() as u32;
        let textures = self.textures.add(&model.textures);
        self.materials.extend(model.materials.iter().map(|m| material(m, model, &textures)));
        base
    }

    /// Brings all to the device, until somebody asks to end.
    pub(super) fn upload(&self, gpu: &Arc<Gpu>, cancel: &Cancel) -> Result<Materials, SceneGpuError> {
        let textures = &self.textures.unique;
        check_textures(gpu.limits(), textures.len() as u32)?;
        let mut wraps: Vec<[Wrap; 2]> = Vec::new();
        let (mut images, mut samplers, mut sampler_of_texture) = (Vec::new(), Vec::new(), Vec::new());
        for texture in textures.iter().copied() {
            cancel.check()?;
            let known = wraps.iter().position(|w| *w == texture.wrap);
            sampler_of_texture.push(known.unwrap_or(wraps.len()));
            if known.is_none() {
                wraps.push(texture.wrap);
                samplers.push(Sampler::new(gpu, sampler(texture.wrap))?);
            }
            images.push(upload_texture(gpu, texture)?);
        }
        let buffer = upload::array(gpu, "materials", &self.materials)?;
        Ok(Materials { buffer, textures: images, samplers, sampler_of_texture })
    }
}

/// Textures of all models, equal ones once.
#[derive(Default)]
struct UniqueTextures<'a> {
    unique: Vec<&'a Texture>,
    known: HashMap<ContentHash, u32>,
}

impl<'a> UniqueTextures<'a> {
    /// The scene-wide numbers of a model's textures.
    fn add(&mut self, textures: &'a [Texture]) -> Vec<u32> {
        let mut number = |texture: &'a Texture| {
            *self.known.entry(texture_hash(texture)).or_insert_with(|| {
                self.unique.push(texture);
                self.unique.len() as u32 - 1
            })
        };
        textures.iter().map(&mut number).collect()
    }
}

/// A material's textures by slot.
type TextureSlots = [Option<TextureSlot>; SLOTS];
const SLOTS: usize = TEXTURE_SLOTS as usize;

fn texture_slots(m: &Material) -> TextureSlots {
    let mut slots = [None; SLOTS];
    slots[BASE_COLOR_SLOT as usize] = m.base_color_texture;
    slots[METALLIC_ROUGHNESS_SLOT as usize] = m.metallic_roughness_texture;
    slots[NORMAL_SLOT as usize] = m.normal_texture;
    slots[OCCLUSION_SLOT as usize] = m.occlusion_texture;
    slots[EMISSIVE_SLOT as usize] = m.emissive_texture;
    slots
}

fn material(m: &Material, model: &Model, textures: &[u32]) -> MaterialGpu {
    let index = |slot: Option<TextureSlot>| slot.map_or(NO_TEXTURE, |s| textures[s.texture as usize] as i32);
    let all = texture_slots(m);
    let texels = |set: u32| {
        let of_set = all.iter().flatten().filter(|slot| slot.set == set);
        of_set.map(|slot| texels_per_unit(slot, &model.textures)).fold(0.0, f32::max)
    };
    let [r, g, b] = m.emissive;
    MaterialGpu {
        base_color: m.base_color,
        emissive_metallic: [r, g, b, m.metallic],
        roughness: m.roughness,
        normal_scale: m.normal_scale,
        occlusion_strength: m.occlusion_strength,
        alpha_cutoff: m.alpha_cutoff.unwrap_or(NO_ALPHA_CUTOFF),
        base_color_texture: index(m.base_color_texture),
        metallic_roughness_texture: index(m.metallic_roughness_texture),
        normal_texture: index(m.normal_texture),
        occlusion_texture: index(m.occlusion_texture),
        emissive_texture: index(m.emissive_texture),
        double_sided: u32::from(m.double_sided),
        texture_extent_texels: texels(0),
        texture_extent1_texels: texels(1),
        uv_rows: uv_rows(all),
        unlit: u32::from(m.unlit),
        reserved: [0; 3],
    }
}

/// Largest number of texels that one unit of the vertices' texture coordinates can cover.
fn texels_per_unit(slot: &TextureSlot, textures: &[Texture]) -> f32 {
    let [width, height] = textures[slot.texture as usize].extent_texels;
    let [[a, b, _], [c, d, _]] = slot.uv_transform;
    // The larger singular value of the 2x2 part.
    let (p, q, r) = (a * a + c * c, b * b + d * d, a * b + c * d);
    let stretch = ((p + q) / 2.0 + ((p - q) / 2.0).hypot(r)).sqrt();
    width.max(height) as f32 * stretch
}

/// By slot the rows of its matrix; the first row's w is its set.
fn uv_rows(slots: TextureSlots) -> [[f32; 4]; 2 * SLOTS] {
    let mut rows = [[0.0; 4]; 2 * SLOTS];
    for (at, slot) in slots.into_iter().enumerate() {
        let slot = slot.unwrap_or_else(|| 0.into());
        let [[a, b, x], [c, d, y]] = slot.uv_transform;
        rows[2 * at] = [a, b, x, slot.set as f32];
        rows[2 * at + 1] = [c, d, y, 0.0];
    }
    rows
}

fn sampler(wrap: [Wrap; 2]) -> SamplerDesc {
    let mode = |wrap| match wrap {
        Wrap::Repeat => vk::SamplerAddressMode::REPEAT,
        Wrap::Mirror => vk::SamplerAddressMode::MIRRORED_REPEAT,
        Wrap::Clamp => vk::SamplerAddressMode::CLAMP_TO_EDGE,
    };
    SamplerDesc {
        filter: vk::Filter::LINEAR,
        wrap: wrap.map(mode),
        mips: true,
        mip_bias: TEXTURE_MIP_BIAS,
        anisotropy: 8.0,
    }
}

/// Uploads an image with a full mip chain, made on the CPU in linear light.
fn upload_texture(gpu: &Arc<Gpu>, texture: &Texture) -> Result<Image, GpuError> {
    let levels = shadecast_scene::mips::chain(texture);
    let image = Image::new(
        gpu,
        ImageDesc {
            mips: levels.len() as u32,
            ..ImageDesc::new(
                "texture",
                texture.extent_texels,
                if texture.srgb { vk::Format::R8G8B8A8_SRGB } else { vk::Format::R8G8B8A8_UNORM },
                vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST,
            )
        },
    )?;
    let staging = Buffer::upload(gpu, "texture staging", &levels.concat())?;
    let mut recorder = gpu.record()?;
    let layouts = [
        vk::ImageLayout::UNDEFINED,
        vk::ImageLayout::TRANSFER_DST_OPTIMAL,
        vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
    ];
    recorder.transition(&image, [layouts[0], layouts[1]], Access::NONE, Access::COPY_WRITE);
    let mut offset = 0;
    for (mip, level) in levels.iter().enumerate() {
        recorder.write_image(&image, mip as u32, &staging, offset);
        offset += level.len() as u64;
    }
    recorder.transition(&image, [layouts[1], layouts[2]], Access::COPY_WRITE, Access::GRAPHICS_READ);
    gpu.wait(recorder.submit()?)?;
    Ok(image)
}
