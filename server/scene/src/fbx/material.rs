//! Materials and their textures. The library brings FBX's Lambert and Phong and the physically based materials of the common
//! tools into one form; this module converts it to metallic-roughness.
//!
//! An unavailable texture (not beside the file, or in an unsupported format) costs one warning; the material keeps its factors.
//! Colours count as linear.

use super::convert;
use crate::error::Fault;
use crate::gltf::material::{check_factors, clamped};
use crate::image::{self, Pixels};
use crate::import::{Surroundings, Warnings};
use crate::limits::MAX_TEXELS;
use crate::references::Folder;
use crate::{Material, Texture, TextureSlot, Wrap};
use shadecast_model::text::printable;
use std::collections::HashMap;
use std::rc::Rc;

/// Alpha below this is not drawn where a texture carries its own transparency.
const ALPHA_CUTOFF: f32 = 0.5;

/// Converts materials as meshes ask for them, so that what no triangle uses is not decoded.
pub(super) struct Materials<'a> {
    around: &'a Surroundings,
    pub(super) materials: Vec<Material>,
    pub(super) textures: Vec<Texture>,
    /// By the material's id and the names of the mesh's texture coordinates, which textures refer to; `None` is the
    /// material of faces that have none.
    known_materials: HashMap<(Option<u32>, Vec<String>), u32>,
    known_textures: HashMap<TextureKey, u32>,
    /// By file; `None` where it could not be had.
    images: HashMap<u32, Option<Rc<Pixels>>>,
    /// Of all decoded pictures and of the textures made of them.
    held_texels: usize,
}

#[derive(PartialEq, Eq, Hash)]
struct TextureKey {
    /// The file, or those of roughness and metalness.
    files: [Option<u32>; 2],
    use_: Use,
    wrap: [bool; 2],
}

#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum Use {
    Color,
    Linear,
    MetallicRoughness { inverted: bool },
}

impl<'a> Materials<'a> {
    pub(super) fn new(around: &'a Surroundings) -> Self {
        Self {
            around,
            materials: Vec::new(),
            textures: Vec::new(),
            known_materials: HashMap::new(),
            known_textures: HashMap::new(),
            images: HashMap::new(),
            held_texels: 0,
        }
    }

    /// The index in [`Self::materials`] of a material on a mesh; of the default one for `None`.
    pub(super) fn index(
        &mut self,
        source: Option<&ufbx::Material>,
        mesh: &ufbx::Mesh,
        warnings: &mut Warnings,
    ) -> Result<u32, Fault> {
        let sets: Vec<String> = mesh.uv_sets.iter().map(|set| set.name.to_string()).collect();
        let key = (source.map(|material| material.element.element_id), sets);
        if let Some(known) = self.known_materials.get(&key) {
            return Ok(*known);
        }
        let material = match source {
            Some(source) => self.convert(source, &key.1, warnings)?,
            None => Material { name: "default".into(), ..Material::default() },
        };
        let index = self.materials.len() as u32;
        self.materials.push(material);
        self.known_materials.insert(key, index);
        Ok(index)
    }

    fn convert(
        &mut self,
        source: &ufbx::Material,
        sets: &[String],
        warnings: &mut Warnings,
    ) -> Result<Material, Fault> {
        self.around.cancel.check()?;
        let (pbr, name) = (&source.pbr, convert::name("material", &source.element));
        let base = self.slot(&pbr.base_color, Use::Color, sets, warnings);
        let emissive = self.slot(&pbr.emission_color, Use::Color, sets, warnings);
        let metallic_roughness = self.metallic_roughness(source, sets, warnings);
        // A texture takes the place of the colour (but not of the factor beside it).
        let [r, g, b] =
            color(&pbr.base_color, base.is_some(), [1.0; 3]).map(|c| c * scalar(&pbr.base_factor, 1.0));
        let emission = color(&pbr.emission_color, emissive.is_some(), [0.0; 3]);
        let material = Material {
            name,
            base_color: [r, g, b, 1.0],
            metallic: if metal_texture(source).is_some() && metallic_roughness.is_some() {
                1.0
            } else {
                scalar(&pbr.metalness, 0.0)
            },
            roughness: if rough_texture(source).is_some() && metallic_roughness.is_some() {
                1.0
            } else {
                scalar(&pbr.roughness, 1.0)
            },
            emissive: emission.map(|c| c * scalar(&pbr.emission_factor, 1.0)),
            base_color_texture: base,
            metallic_roughness_texture: metallic_roughness,
            normal_texture: self.slot(&pbr.normal_map, Use::Linear, sets, warnings),
            occlusion_texture: self.slot(&pbr.ambient_occlusion, Use::Linear, sets, warnings),
            emissive_texture: emissive,
            alpha_cutoff: alpha_cutoff(source, base.is_some(), warnings),
            double_sided: source.features.double_sided.enabled,
            unlit: source.features.unlit.enabled,
            ..Material::default()
        };
        if material.normal_texture.is_none() && enabled(&source.fbx.bump).is_some() {
            warnings.insert("bump maps are ignored; bake them into normal maps".into());
        }
        check_factors(&material)
            .map_err(|problem| Fault::new(convert::label("material", &source.element), problem))?;
        Ok(clamped(material))
    }

    /// The texture of a map, where it has one that can be had.
    fn slot(
        &mut self,
        map: &ufbx::MaterialMap,
        use_: Use,
        sets: &[String],
        warnings: &mut Warnings,
    ) -> Option<TextureSlot> {
        let source = file_texture(enabled(map)?, warnings)?;
        let key = TextureKey { files: [Some(source.file_index), None], use_, wrap: clamps(source) };
        if let Some(known) = self.known_textures.get(&key) {
            return Some(slot(*known, source, sets, warnings));
        }
        let pixels = self.pixels(source, warnings)?;
        self.note_room(pixels.extent_texels, source, warnings)?;
        let texture = Texture {
            name: convert::name("texture", &source.element),
            extent_texels: pixels.extent_texels,
            rgba8: pixels.rgba8.clone(),
            srgb: use_ == Use::Color,
            wrap: wrap(source),
        };
        Some(slot(self.push(texture, key), source, sets, warnings))
    }

    /// `None`, and a warning, where there is no room for one more texture.
    fn note_room(
        &mut self,
        extent_texels: [u32; 2],
        source: &ufbx::Texture,
        warnings: &mut Warnings,
    ) -> Option<()> {
        let room = self.take_room(extent_texels);
        room.map_err(|problem| warnings.insert(left_out(source, &problem))).ok()
    }

    fn push(&mut self, texture: Texture, key: TextureKey) -> u32 {
        let index = self.textures.len() as u32;
        self.textures.push(texture);
        self.known_textures.insert(key, index);
        index
    }

    /// One texture of the two that FBX has: roughness in g, metalness in b. Where both name one file, it is taken to
    /// hold them in these channels; grey pictures have them in any.
    fn metallic_roughness(
        &mut self,
        source: &ufbx::Material,
        sets: &[String],
        warnings: &mut Warnings,
    ) -> Option<TextureSlot> {
        let rough = rough_texture(source).and_then(|(texture, _)| file_texture(texture, warnings));
        let metal = metal_texture(source).and_then(|texture| file_texture(texture, warnings));
        let inverted = rough_texture(source).is_some_and(|(_, inverted)| inverted);
        let leading = rough.or(metal)?;
        let key = TextureKey {
            files: [rough, metal].map(|texture| texture.map(|texture| texture.file_index)),
            use_: Use::MetallicRoughness { inverted },
            wrap: clamps(leading),
        };
        if let Some(known) = self.known_textures.get(&key) {
            return Some(slot(*known, leading, sets, warnings));
        }
        let mut pixels_of =
            |texture: Option<&ufbx::Texture>| texture.map(|texture| self.pixels(texture, warnings));
        let (rough, metal) = (pixels_of(rough), pixels_of(metal));
        // Where one of two cannot be had, the factors of both are the better picture.
        if matches!(rough, Some(None)) || matches!(metal, Some(None)) {
            return None;
        }
        let (extent_texels, rgba8) =
            combine(rough.flatten().as_deref(), metal.flatten().as_deref(), inverted);
        self.note_room(extent_texels, leading, warnings)?;
        let name = convert::name("texture", &leading.element);
        let texture = Texture { name, extent_texels, rgba8, srgb: false, wrap: wrap(leading) };
        Some(slot(self.push(texture, key), leading, sets, warnings))
    }

    /// The decoded file of a texture; each is read, and complained about, once.
    fn pixels(&mut self, source: &ufbx::Texture, warnings: &mut Warnings) -> Option<Rc<Pixels>> {
        if let Some(known) = self.images.get(&source.file_index) {
            return known.clone();
        }
        let pixels = match self.decode(source) {
            Ok(pixels) => Some(Rc::new(pixels)),
            Err(problem) => {
                warnings.insert(left_out(source, &problem));
                None
            }
        };
        self.images.insert(source.file_index, pixels.clone());
        pixels
    }

    fn decode(&mut self, source: &ufbx::Texture) -> Result<Pixels, String> {
        let pixels = image::decode(&read(source, self.around.folder.as_ref())?)?;
        self.take_room(pixels.extent_texels)?;
        Ok(pixels)
    }

    /// A few bytes can use one picture in many ways, each of which is a texture of its own.
    fn take_room(&mut self, [width, height]: [u32; 2]) -> Result<(), String> {
        let held = self.held_texels + width as usize * height as usize;
        if held > 2 * MAX_TEXELS {
            return Err(format!("brings the textures over {MAX_TEXELS} texels; use fewer or smaller ones"));
        }
        self.held_texels = held;
        Ok(())
    }
}

fn left_out(source: &ufbx::Texture, problem: &str) -> String {
    let element = convert::label("texture", &source.element);
    format!("{element}: {problem}; the material is drawn without it")
}

fn enabled(map: &ufbx::MaterialMap) -> Option<&ufbx::Texture> {
    map.texture.as_deref().filter(|_| map.texture_enabled && !map.feature_disabled)
}

/// The texture, and whether it holds glossiness, the inverse.
fn rough_texture(source: &ufbx::Material) -> Option<(&ufbx::Texture, bool)> {
    let rough = enabled(&source.pbr.roughness).map(|texture| (texture, false));
    rough.or_else(|| enabled(&source.pbr.glossiness).map(|texture| (texture, true)))
}

fn metal_texture(source: &ufbx::Material) -> Option<&ufbx::Texture> {
    enabled(&source.pbr.metalness)
}

/// The texture itself or, of one that is put together of several, the first that is a picture.
fn file_texture<'a>(texture: &'a ufbx::Texture, warnings: &mut Warnings) -> Option<&'a ufbx::Texture> {
    if texture.type_ == ufbx::TextureType::File && texture.has_file {
        return Some(texture);
    }
    warnings.insert("layered and procedural textures are reduced to their first picture".into());
    texture.file_textures.as_ref().iter().map(|texture| &**texture).find(|texture| texture.has_file)
}

/// The bytes of a texture's file: embedded, or beside the asset at its relative path or by its mere name.
fn read(source: &ufbx::Texture, folder: Option<&Folder>) -> Result<Vec<u8>, String> {
    let video = source.video.as_deref().map_or(&[][..], |video| &video.content);
    let embedded = if source.content.is_empty() { video } else { &source.content };
    if !embedded.is_empty() {
        return Ok(embedded.to_vec());
    }
    let candidates = candidates(source);
    let first = candidates.first().ok_or("names no file")?;
    let Some(folder) = folder else {
        return Err(format!("refers to the file '{}', but the asset is not in a folder", printable(first)));
    };
    let mut problem = String::new();
    for name in &candidates {
        match folder.find(name) {
            Ok(found) => return found.read(),
            // The first name is the one that the file means.
            Err(why) if problem.is_empty() => problem = why,
            Err(_) => {}
        }
    }
    Err(problem)
}

/// Names as the file has them, then their last parts alone: exporters write where a picture was on their own machine,
/// and it usually travels beside the asset. Which of them may be read is the folder's to say.
fn candidates(source: &ufbx::Texture) -> Vec<String> {
    let names = [&source.relative_filename, &source.filename, &source.absolute_filename];
    let names = names.map(|name| name.replace('\\', "/"));
    let last = |name: &String| name.rsplit('/').next().unwrap_or_default().to_owned();
    let mut found: Vec<String> = names.to_vec();
    found.extend(names.iter().map(last));
    found.retain(|name| !name.is_empty());
    found
}

fn slot(texture: u32, source: &ufbx::Texture, sets: &[String], warnings: &mut Warnings) -> TextureSlot {
    let wanted = source.uv_set.as_ref();
    let set = match sets.iter().position(|set| set == wanted) {
        Some(set @ (0 | 1)) => set as u32,
        Some(_) => {
            warnings.insert("only the first two sets of texture coordinates are used".into());
            0
        }
        // "default" and names that the mesh does not have.
        None => 0,
    };
    TextureSlot { set, uv_transform: uv_transform(source), ..texture.into() }
}

/// FBX's transform of coordinates whose v runs upwards, for ours, whose v runs downwards: with `v = 1 - v_up` on both
/// sides.
fn uv_transform(source: &ufbx::Texture) -> [[f32; 3]; 2] {
    let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    if !source.has_uv_transform {
        return identity;
    }
    let m = &source.uv_to_texture;
    let rows = [[m.m00, -m.m01, m.m01 + m.m03], [-m.m10, m.m11, 1.0 - m.m11 - m.m13]];
    let rows = rows.map(|row| row.map(|number| number as f32));
    if rows.iter().flatten().all(|number| number.is_finite()) { rows } else { identity }
}

fn clamps(source: &ufbx::Texture) -> [bool; 2] {
    [source.wrap_u, source.wrap_v].map(|mode| mode == ufbx::WrapMode::Clamp)
}

fn wrap(source: &ufbx::Texture) -> [Wrap; 2] {
    clamps(source).map(|clamp| if clamp { Wrap::Clamp } else { Wrap::Repeat })
}

/// Roughness to g, metalness to b, at the larger of the two sizes.
fn combine(rough: Option<&Pixels>, metal: Option<&Pixels>, inverted: bool) -> ([u32; 2], Vec<u8>) {
    let extent =
        |axis: usize| [rough, metal].into_iter().flatten().map(|p| p.extent_texels[axis]).max().unwrap_or(1);
    let [width, height] = [extent(0), extent(1)];
    let mut rgba8 = Vec::with_capacity(4 * width as usize * height as usize);
    let sample = |pixels: Option<&Pixels>, x: u32, y: u32, channel: usize| {
        let Some(Pixels { extent_texels: [w, h], rgba8 }) = pixels else { return 255 };
        let (x, y) = (
            u64::from(x) * u64::from(*w) / u64::from(width),
            u64::from(y) * u64::from(*h) / u64::from(height),
        );
        rgba8[4 * (y * u64::from(*w) + x) as usize + channel]
    };
    for y in 0..height {
        for x in 0..width {
            let roughness = sample(rough, x, y, 1);
            rgba8.extend([
                255,
                if inverted { 255 - roughness } else { roughness },
                sample(metal, x, y, 2),
                255,
            ]);
        }
    }
    ([width, height], rgba8)
}

/// The map's colour; white under a texture, and `otherwise` where the file says nothing.
fn color(map: &ufbx::MaterialMap, textured: bool, otherwise: [f32; 3]) -> [f32; 3] {
    let v = &map.value_vec4;
    match (textured, map.has_value) {
        (true, _) => [1.0; 3],
        // Some shaders give one number for all three.
        (false, true) if map.value_components == 1 => [v.x as f32; 3],
        (false, true) => [v.x as f32, v.y as f32, v.z as f32],
        (false, false) => otherwise,
    }
}

fn scalar(map: &ufbx::MaterialMap, otherwise: f32) -> f32 {
    // Of glossiness the library gives the roughness without calling it a value.
    if map.has_value || map.value_vec4.x != 0.0 { map.value_vec4.x as f32 } else { otherwise }
}

/// Transparency that comes with the base colour's own picture is a cutout; any other is left out.
fn alpha_cutoff(source: &ufbx::Material, has_base_texture: bool, warnings: &mut Warnings) -> Option<f32> {
    let base_file = enabled(&source.pbr.base_color).map(|texture| texture.file_index);
    let see_through = [&source.pbr.opacity, &source.fbx.transparency_color, &source.fbx.transparency_factor];
    let mut files = see_through.into_iter().filter_map(enabled).map(|texture| texture.file_index).peekable();
    let textured = files.peek().is_some();
    if has_base_texture && files.any(|file| Some(file) == base_file) {
        return Some(ALPHA_CUTOFF);
    }
    if textured || (source.pbr.opacity.has_value && source.pbr.opacity.value_vec4.x < 0.999) {
        warnings.insert("blended materials are drawn opaque".into());
    }
    None
}
