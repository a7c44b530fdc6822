//! Materials and the textures that they use. A glTF image becomes one [`Texture`] per way of use: coded in sRGB or
//! linear, and with which wrap modes.

use super::super::error::Fault;
use super::super::{Material, Texture, TextureSlot, Wrap, image};
use super::accessor::Reader;
use super::{Warnings, container, label};
use ::gltf::material::AlphaMode;
use ::gltf::texture::WrappingMode;
use std::collections::HashMap;
use std::path::Path;

/// Converts materials as primitives ask for them, so that what no triangle uses is not decoded.
pub(super) struct Materials<'a> {
    pub(super) reader: Reader<'a>,
    pub(super) folder: Option<&'a Path>,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    /// By glTF material index; `None` is glTF's default material.
    known_materials: HashMap<Option<usize>, u32>,
    known_textures: HashMap<(usize, [u8; 2], bool), u32>,
}

impl<'a> Materials<'a> {
    pub(super) fn new(reader: Reader<'a>, folder: Option<&'a Path>) -> Self {
        Self {
            reader,
            folder,
            materials: Vec::new(),
            textures: Vec::new(),
            known_materials: HashMap::new(),
            known_textures: HashMap::new(),
        }
    }

    /// The index of a material in [`Self::materials`].
    pub(super) fn index(&mut self, source: &::gltf::Material, warnings: &mut Warnings) -> Result<u32, Fault> {
        if let Some(index) = self.known_materials.get(&source.index()) {
            return Ok(*index);
        }
        let material = self.convert(source, warnings)?;
        let index = self.materials.len() as u32;
        self.materials.push(material);
        self.known_materials.insert(source.index(), index);
        Ok(index)
    }

    fn convert(&mut self, source: &::gltf::Material, warnings: &mut Warnings) -> Result<Material, Fault> {
        let name = source.name().map_or_else(|| default_name(source), str::to_owned);
        let element = label("material", source.index().unwrap_or(0), source.name());
        let pbr = source.pbr_metallic_roughness();
        let (normal, occlusion) = (source.normal_texture(), source.occlusion_texture());
        let material = Material {
            name,
            base_color: pbr.base_color_factor(),
            metallic: pbr.metallic_factor(),
            roughness: pbr.roughness_factor(),
            emissive: source.emissive_factor(),
            normal_scale: normal.as_ref().map_or(1.0, ::gltf::material::NormalTexture::scale),
            occlusion_strength: occlusion.as_ref().map_or(1.0, ::gltf::material::OcclusionTexture::strength),
            base_color_texture: self.texture(pbr.base_color_texture().map(|t| t.texture()), true)?,
            metallic_roughness_texture: self
                .texture(pbr.metallic_roughness_texture().map(|t| t.texture()), false)?,
            normal_texture: self.texture(normal.map(|t| t.texture()), false)?,
            occlusion_texture: self.texture(occlusion.map(|t| t.texture()), false)?,
            emissive_texture: self.texture(source.emissive_texture().map(|t| t.texture()), true)?,
            alpha_cutoff: alpha_cutoff(source, warnings),
            double_sided: source.double_sided(),
            unlit: false,
        };
        check_factors(&material).map_err(|problem| Fault::new(element, problem))?;
        Ok(clamped(material))
    }

    fn texture(&mut self, source: Option<::gltf::Texture>, srgb: bool) -> Result<Option<TextureSlot>, Fault> {
        let Some(source) = source else { return Ok(None) };
        let sampler = source.sampler();
        let wrap = [wrap(sampler.wrap_s()), wrap(sampler.wrap_t())];
        let image = source.source();
        let key = (image.index(), wrap.map(|mode| mode as u8), srgb);
        if let Some(index) = self.known_textures.get(&key) {
            return Ok(Some((*index).into()));
        }
        let texture = self.decode(&image, wrap, srgb)?;
        let index = self.textures.len() as u32;
        self.textures.push(texture);
        self.known_textures.insert(key, index);
        Ok(Some(index.into()))
    }

    fn decode(&self, image: &::gltf::Image, wrap: [Wrap; 2], srgb: bool) -> Result<Texture, Fault> {
        let element = label("image", image.index(), image.name());
        // Decoded already for another use: the pixels are the same.
        let other = self.known_textures.iter().find(|((known, _, _), _)| *known == image.index());
        if let Some((_, index)) = other {
            return Ok(Texture { wrap, srgb, ..self.textures[*index as usize].clone() });
        }
        let json = &self.reader.document.as_json().images[image.index()];
        let decoded = match (&json.uri, json.buffer_view) {
            (Some(uri), _) => image::decode(&container::resolve_uri(uri, self.folder, &element)?),
            (None, Some(view)) => {
                let view = self.reader.document.views().nth(view.value());
                let view = view.ok_or_else(|| Fault::new(element.clone(), "has no buffer view"))?;
                image::decode(self.reader.view_bytes(&view, &element)?)
            }
            (None, None) => Err("has no data".into()),
        };
        let pixels = decoded.map_err(|problem| Fault::new(element.clone(), problem))?;
        let name = image.name().map_or(element, str::to_owned);
        Ok(Texture { name, extent_texels: pixels.extent_texels, rgba8: pixels.rgba8, srgb, wrap })
    }
}

fn default_name(source: &::gltf::Material) -> String {
    source.index().map_or_else(|| "default".into(), |index| format!("material {index}"))
}

fn wrap(mode: WrappingMode) -> Wrap {
    match mode {
        WrappingMode::Repeat => Wrap::Repeat,
        WrappingMode::MirroredRepeat => Wrap::Mirror,
        WrappingMode::ClampToEdge => Wrap::Clamp,
    }
}

fn alpha_cutoff(source: &::gltf::Material, warnings: &mut Warnings) -> Option<f32> {
    match source.alpha_mode() {
        AlphaMode::Opaque => None,
        AlphaMode::Mask => Some(source.alpha_cutoff().unwrap_or(0.5)),
        AlphaMode::Blend => {
            warnings.insert("blended materials are drawn opaque".into());
            None
        }
    }
}

fn check_factors(material: &Material) -> Result<(), String> {
    let mut numbers =
        vec![material.metallic, material.roughness, material.normal_scale, material.occlusion_strength];
    numbers.extend(material.base_color.iter().chain(&material.emissive).chain(&material.alpha_cutoff));
    if numbers.iter().all(|number| number.is_finite()) {
        return Ok(());
    }
    Err("has a factor that is not a finite number".into())
}

/// Factors into the ranges that glTF allows; exporters write 1.0000001.
fn clamped(mut material: Material) -> Material {
    material.base_color = material.base_color.map(|factor| factor.clamp(0.0, 1.0));
    material.emissive = material.emissive.map(|factor| factor.max(0.0));
    material.metallic = material.metallic.clamp(0.0, 1.0);
    material.roughness = material.roughness.clamp(0.0, 1.0);
    material.occlusion_strength = material.occlusion_strength.clamp(0.0, 1.0);
    material
}
