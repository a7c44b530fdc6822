//! Materials and their textures. A glTF image becomes one [`Texture`] per use: coded in sRGB or linear, and with its wrap
//! modes.
//!
//! A vertex holds two sets of texture coordinates. Files may number theirs freely. The first two that a material uses become
//! sets 0 and 1 of its vertices.

use super::super::error::Fault;
use super::super::import::Surroundings;
use super::super::limits::MAX_TEXELS;
use super::super::{Material, Texture, TextureSlot, Wrap, image};
use super::accessor::Reader;
use super::extensions::{self, EMISSIVE_STRENGTH, TEXTURE_TRANSFORM, UNLIT};
use super::{Warnings, buffer, label};
use ::gltf::material::AlphaMode;
use ::gltf::texture::WrappingMode;
use serde::Deserialize;
use serde_json::{Map, Value};
use shadecast_model::text::printable;
use std::collections::HashMap;

/// The alpha at which a blended material counts as there.
const BLEND_CUTOFF: f32 = 0.5;

/// Converts materials as primitives ask for them, so that what no triangle uses is not decoded.
pub(super) struct Materials<'a> {
    pub(super) reader: Reader<'a>,
    around: &'a Surroundings,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    /// By glTF material index; `None` is glTF's default material.
    known_materials: HashMap<Option<usize>, u32>,
    known_textures: HashMap<(usize, [u8; 2], bool), u32>,
}

impl<'a> Materials<'a> {
    pub(super) fn new(reader: Reader<'a>, around: &'a Surroundings) -> Self {
        Self {
            reader,
            around,
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
        let name = source.name().map_or_else(|| default_name(source), printable);
        let element = element(source);
        let pbr = source.pbr_metallic_roughness();
        let used = References::read(source)?;
        used.note_lost_sets(warnings);
        let sets = used.sets();
        let [base_color, metallic_roughness, normal, occlusion, emissive] = used.0;
        let scale = source.normal_texture().map_or(1.0, |texture| texture.scale());
        let strength = source.occlusion_texture().map_or(1.0, |texture| texture.strength());
        let glow = emissive_strength(source, &element)?;
        let material = Material {
            name,
            base_color: pbr.base_color_factor(),
            metallic: pbr.metallic_factor(),
            roughness: pbr.roughness_factor(),
            emissive: source.emissive_factor().map(|part| part * glow),
            normal_scale: scale,
            occlusion_strength: strength,
            base_color_texture: self.texture(base_color, sets, true)?,
            metallic_roughness_texture: self.texture(metallic_roughness, sets, false)?,
            normal_texture: self.texture(normal, sets, false)?,
            occlusion_texture: self.texture(occlusion, sets, false)?,
            emissive_texture: self.texture(emissive, sets, true)?,
            alpha_cutoff: alpha_cutoff(source),
            double_sided: source.double_sided(),
            unlit: source.extension_value(UNLIT).is_some(),
        };
        if source.alpha_mode() == AlphaMode::Blend {
            self.note_blending(&element, &material, warnings);
        }
        check_factors(&material).map_err(|problem| Fault::new(element, problem))?;
        Ok(clamped(material))
    }

    /// Says what becomes of a blended material. Vertex colours are not known here; they can only take alpha away.
    fn note_blending(&self, element: &str, material: &Material, warnings: &mut Warnings) {
        let most = material
            .base_color_texture
            .map_or(u8::MAX, |slot| most_alpha(&self.textures[slot.texture as usize]));
        let becomes = if material.base_color[3] * f32::from(most) / 255.0 < BLEND_CUTOFF {
            "is blended and nowhere half opaque: it is left out"
        } else {
            "is blended: where it is at least half opaque it is drawn, elsewhere it is cut out"
        };
        warnings.insert(format!("{element} {becomes}"));
    }

    fn texture(
        &mut self,
        reference: Option<Reference>,
        sets: [u32; 2],
        srgb: bool,
    ) -> Result<Option<TextureSlot>, Fault> {
        let Some(reference) = reference else { return Ok(None) };
        let sampler = reference.texture.sampler();
        let wrap = [wrap(sampler.wrap_s()), wrap(sampler.wrap_t())];
        let image = reference.texture.source();
        let key = (image.index(), wrap.map(|mode| mode as u8), srgb);
        if let Some(index) = self.known_textures.get(&key) {
            return Ok(Some(reference.slot(*index, sets)));
        }
        let texture = self.decode(&image, wrap, srgb)?;
        let index = self.textures.len() as u32;
        self.textures.push(texture);
        self.known_textures.insert(key, index);
        Ok(Some(reference.slot(index, sets)))
    }

    /// An error where another picture of this size would be too much.
    fn check_room(&self, [width, height]: [u32; 2], element: &str) -> Result<(), Fault> {
        let texels = |[width, height]: [u32; 2]| width as usize * height as usize;
        let held: usize = self.textures.iter().map(|texture| texels(texture.extent_texels)).sum();
        if held + texels([width, height]) <= MAX_TEXELS {
            return Ok(());
        }
        let problem = format!("brings the textures over {MAX_TEXELS} texels; use fewer or smaller ones");
        Err(Fault::new(element, problem))
    }

    fn decode(&self, image: &::gltf::Image, wrap: [Wrap; 2], srgb: bool) -> Result<Texture, Fault> {
        self.around.cancel.check()?;
        let element = label("image", image.index(), image.name());
        // Decoded already for another use: the pixels are the same.
        let other = self.known_textures.iter().find(|((known, _, _), _)| *known == image.index());
        if let Some((_, index)) = other {
            let known = &self.textures[*index as usize];
            self.check_room(known.extent_texels, &element)?;
            return Ok(Texture { wrap, srgb, ..known.clone() });
        }
        let json = &self.reader.document.as_json().images[image.index()];
        let decoded = match (&json.uri, json.buffer_view) {
            (Some(uri), _) => buffer::read_uri(uri, self.around).and_then(|bytes| image::decode(&bytes)),
            (None, Some(view)) => {
                let view = self.reader.document.views().nth(view.value());
                let view = view.ok_or_else(|| Fault::new(element.clone(), "has no buffer view"))?;
                image::decode(self.reader.view_bytes(&view, &element)?)
            }
            (None, None) => Err("has no data".into()),
        };
        let pixels = decoded.map_err(|problem| Fault::new(element.clone(), problem))?;
        self.check_room(pixels.extent_texels, &element)?;
        let name = image.name().map_or(element, printable);
        Ok(Texture { name, extent_texels: pixels.extent_texels, rgba8: pixels.rgba8, srgb, wrap })
    }
}

fn element(material: &::gltf::Material) -> String {
    label("material", material.index().unwrap_or(0), material.name())
}

/// How a material refers to a texture, whichever of glTF's three kinds of reference it is.
struct Reference<'a> {
    texture: ::gltf::Texture<'a>,
    /// The n of TEXCOORD_n.
    set: u32,
    uv_transform: [[f32; 3]; 2],
}

impl<'a> Reference<'a> {
    fn read(
        texture: ::gltf::Texture<'a>,
        set: u32,
        others: Option<&Map<String, Value>>,
        element: &str,
    ) -> Result<Self, Fault> {
        let transform: Option<Transform> = extensions::read(others, TEXTURE_TRANSFORM, element)?;
        let transform = transform.unwrap_or_default();
        let uv_transform = transform.matrix();
        if !uv_transform.iter().flatten().all(|number| number.is_finite()) {
            return Err(Fault::new(element, format!("{TEXTURE_TRANSFORM} has a number that is not finite")));
        }
        Ok(Self { texture, set: transform.tex_coord.unwrap_or(set), uv_transform })
    }

    /// Set 0 where the vertices do not hold the wanted one.
    fn slot(&self, texture: u32, sets: [u32; 2]) -> TextureSlot {
        let set = sets.iter().position(|set| *set == self.set).unwrap_or(0) as u32;
        TextureSlot { texture, set, uv_transform: self.uv_transform }
    }
}

/// `KHR_texture_transform`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Transform {
    offset: [f32; 2],
    rotation: f32,
    scale: [f32; 2],
    tex_coord: Option<u32>,
}

impl Default for Transform {
    fn default() -> Self {
        Self { offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2], tex_coord: None }
    }
}

impl Transform {
    /// The extension's `translation * rotation * scale`; it turns against the sense of u to v.
    fn matrix(&self) -> [[f32; 3]; 2] {
        let (sin, cos) = self.rotation.sin_cos();
        let ([x, y], [w, h]) = (self.offset, self.scale);
        [[cos * w, sin * h, x], [-sin * w, cos * h, y]]
    }
}

/// The textures of a material: base colour, metallic-roughness, normal, occlusion, emissive.
struct References<'a>([Option<Reference<'a>>; 5]);

impl<'a> References<'a> {
    fn read(material: &::gltf::Material<'a>) -> Result<Self, Fault> {
        let element = element(material);
        let pbr = material.pbr_metallic_roughness();
        let plain = |info: Option<::gltf::texture::Info<'a>>| {
            info.map(|t| Reference::read(t.texture(), t.tex_coord(), t.extensions(), &element)).transpose()
        };
        let normal = material.normal_texture();
        let occlusion = material.occlusion_texture();
        Ok(Self([
            plain(pbr.base_color_texture())?,
            plain(pbr.metallic_roughness_texture())?,
            normal
                .map(|t| Reference::read(t.texture(), t.tex_coord(), t.extensions(), &element))
                .transpose()?,
            occlusion
                .map(|t| Reference::read(t.texture(), t.tex_coord(), t.extensions(), &element))
                .transpose()?,
            plain(material.emissive_texture())?,
        ]))
    }

    /// All sets that are used, ascending.
    fn used_sets(&self) -> Vec<u32> {
        let mut used: Vec<u32> = self.0.iter().flatten().map(|reference| reference.set).collect();
        used.sort_unstable();
        used.dedup();
        used
    }

    /// Which of the file's sets become a vertex's first and second: 0 and 1, unless a material uses others.
    fn sets(&self) -> [u32; 2] {
        match self.used_sets()[..] {
            [] | [0] | [1] | [0, 1] => [0, 1],
            [only] => [only, only],
            [first, second, ..] => [first, second],
        }
    }

    fn note_lost_sets(&self, warnings: &mut Warnings) {
        if self.used_sets().len() > 2 {
            warnings.insert("of more than two sets of texture coordinates the first two are used".into());
        }
    }
}

/// What the vertices of a primitive must know of its material.
pub(super) struct Coordinates {
    /// The n of TEXCOORD_n that become a vertex's first and second coordinates.
    pub(super) sets: [u32; 2],
    /// Whether any texture uses the second.
    pub(super) uses_second: bool,
    /// How the normal map looks up; its texture's number means nothing yet.
    pub(super) normal_map: Option<TextureSlot>,
}

impl Coordinates {
    pub(super) fn of(material: &::gltf::Material) -> Result<Self, Fault> {
        let used = References::read(material)?;
        let sets = used.sets();
        let uses_second = sets[0] != sets[1] && used.used_sets().contains(&sets[1]);
        let normal_map = used.0[2].as_ref().map(|reference| reference.slot(0, sets));
        Ok(Self { sets, uses_second, normal_map })
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Strength {
    emissive_strength: f32,
}

impl Default for Strength {
    fn default() -> Self {
        Self { emissive_strength: 1.0 }
    }
}

fn emissive_strength(material: &::gltf::Material, element: &str) -> Result<f32, Fault> {
    let strength: Option<Strength> = extensions::read(material.extensions(), EMISSIVE_STRENGTH, element)?;
    Ok(strength.unwrap_or_default().emissive_strength)
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

/// Alpha below which nothing is drawn. Nothing is blended: what is blended in the file is there or not.
fn alpha_cutoff(source: &::gltf::Material) -> Option<f32> {
    match source.alpha_mode() {
        AlphaMode::Opaque => None,
        AlphaMode::Mask => Some(source.alpha_cutoff().unwrap_or(0.5)),
        AlphaMode::Blend => Some(BLEND_CUTOFF),
    }
}

fn most_alpha(texture: &Texture) -> u8 {
    texture.rgba8.chunks_exact(4).map(|texel| texel[3]).max().unwrap_or(u8::MAX)
}

pub(crate) fn check_factors(material: &Material) -> Result<(), String> {
    let mut numbers =
        vec![material.metallic, material.roughness, material.normal_scale, material.occlusion_strength];
    numbers.extend(material.base_color.iter().chain(&material.emissive).chain(&material.alpha_cutoff));
    if numbers.iter().all(|number| number.is_finite()) {
        return Ok(());
    }
    Err("has a factor that is not a finite number".into())
}

/// Factors into the ranges that glTF allows; exporters write 1.0000001.
pub(crate) fn clamped(mut material: Material) -> Material {
    material.base_color = material.base_color.map(|factor| factor.clamp(0.0, 1.0));
    material.emissive = material.emissive.map(|factor| factor.max(0.0));
    material.metallic = material.metallic.clamp(0.0, 1.0);
    material.roughness = material.roughness.clamp(0.0, 1.0);
    material.occlusion_strength = material.occlusion_strength.clamp(0.0, 1.0);
    material
}
