//! Typed numbers from buffers, with every bound checked first. (The `gltf` crate's iterators index without checks.)

use super::super::error::Fault;
use super::super::limits::MAX_ELEMENTS;
use super::buffer::Buffer;
use super::compression::Decoded;
use ::gltf::accessor::{DataType, Dimensions};
use ::gltf::json::accessor::ComponentType;

/// The buffers of a document.
#[derive(Clone, Copy)]
pub(super) struct Reader<'a> {
    pub(super) document: &'a ::gltf::Document,
    pub(super) buffers: &'a [Buffer],
    /// Bytes in all buffers, decompressed ones included.
    pub(super) data_bytes: usize,
    /// What compressed buffer views hold.
    pub(super) decoded: &'a Decoded,
}

/// Where `count` elements of `size` bytes lie, checked to be inside `bytes`.
struct Elements<'a> {
    bytes: &'a [u8],
    stride: usize,
    size: usize,
}

impl<'a> Elements<'a> {
    fn get(&self, index: usize) -> &'a [u8] {
        &self.bytes[index * self.stride..][..self.size]
    }
}

impl<'a> Reader<'a> {
    /// Finite numbers, integers converted as `normalized` says (glTF 2.0 section 3.6.2.2). `element` is for messages.
    pub(super) fn floats<const N: usize>(
        &self,
        accessor: &::gltf::Accessor,
        shape: Dimensions,
        element: &str,
    ) -> Result<Vec<[f32; N]>, Fault> {
        let (kind, normalized) = (accessor.data_type(), accessor.normalized());
        let values = self.read(accessor, shape, element, |bytes| float_component(kind, normalized, bytes))?;
        check_finite(&values, element)?;
        Ok(values)
    }

    /// RGBA from 0 to 1; alpha is 1 where the colours have three components. Integers are normalised, as the
    /// specification asks for, whether the accessor says so or not.
    pub(super) fn colors(&self, accessor: &::gltf::Accessor, element: &str) -> Result<Vec<[f32; 4]>, Fault> {
        let kind = accessor.data_type();
        let convert = |bytes: &[u8]| float_component(kind, true, bytes);
        let values = match accessor.dimensions() {
            Dimensions::Vec3 => {
                let rgb = self.read::<3, f32>(accessor, Dimensions::Vec3, element, convert)?;
                rgb.into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect()
            }
            _ => self.read::<4, f32>(accessor, Dimensions::Vec4, element, convert)?,
        };
        check_finite(&values, element)?;
        Ok(values.into_iter().map(|color| color.map(|part| part.clamp(0.0, 1.0))).collect())
    }

    /// Unsigned integers.
    pub(super) fn integers<const N: usize>(
        &self,
        accessor: &::gltf::Accessor,
        shape: Dimensions,
        element: &str,
    ) -> Result<Vec<[u32; N]>, Fault> {
        let kind = accessor.data_type();
        if !matches!(kind, DataType::U8 | DataType::U16 | DataType::U32) {
            return Err(Fault::new(
                element,
                format!("has components of type {kind:?}, not unsigned integers"),
            ));
        }
        self.read(accessor, shape, element, |bytes| integer_component(kind, bytes))
    }

    /// The bytes of a buffer view.
    pub(super) fn view_bytes(&self, view: &::gltf::buffer::View, element: &str) -> Result<&'a [u8], Fault> {
        if let Some(bytes) = self.decoded.get(&view.index()) {
            return Ok(bytes);
        }
        let buffer =
            self.buffers.get(view.buffer().index()).map(|buffer| buffer.as_slice()).unwrap_or_default();
        let end = view.offset().checked_add(view.length());
        end.and_then(|end| buffer.get(view.offset()..end)).ok_or_else(|| {
            let (offset, length) = (view.offset(), view.length());
            let place = format!("buffer view {} (offset {offset}, {length} bytes)", view.index());
            Fault::new(element, format!("{place} is outside its buffer of {} bytes", buffer.len()))
        })
    }

    fn read<const N: usize, T: Copy + Default>(
        &self,
        accessor: &::gltf::Accessor,
        shape: Dimensions,
        element: &str,
        convert: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<[T; N]>, Fault> {
        self.check_shape(accessor, shape, element)?;
        let component = accessor.data_type().size();
        let size = N * component;
        let decode = |bytes: &[u8]| {
            let mut value = [T::default(); N];
            for (slot, part) in value.iter_mut().zip(bytes.chunks_exact(component)) {
                *slot = convert(part);
            }
            value
        };
        let mut values = match accessor.view() {
            Some(view) => {
                let elements = self.elements(&view, accessor.offset(), size, accessor.count(), element)?;
                (0..accessor.count()).map(|index| decode(elements.get(index))).collect()
            }
            None => vec![[T::default(); N]; accessor.count()],
        };
        if let Some(sparse) = accessor.sparse() {
            self.overlay(&sparse, size, element, &mut values, decode)?;
        }
        Ok(values)
    }

    fn check_shape(
        &self,
        accessor: &::gltf::Accessor,
        shape: Dimensions,
        element: &str,
    ) -> Result<(), Fault> {
        let found = accessor.dimensions();
        if found != shape {
            return Err(Fault::new(element, format!("has elements of type {found:?}, not {shape:?}")));
        }
        if accessor.count() > MAX_ELEMENTS {
            let problem = format!("has {} elements; at most {MAX_ELEMENTS} are supported", accessor.count());
            return Err(Fault::new(element, problem));
        }
        // Zeros for nothing: a few bytes of JSON must not claim gigabytes.
        if accessor.view().is_none() && accessor.count() > self.data_bytes {
            let (count, bytes) = (accessor.count(), self.data_bytes);
            let problem = format!("has {count} elements without data, more than the file's {bytes} bytes");
            return Err(Fault::new(element, problem));
        }
        Ok(())
    }

    fn elements(
        &self,
        view: &::gltf::buffer::View,
        offset: usize,
        size: usize,
        count: usize,
        element: &str,
    ) -> Result<Elements<'a>, Fault> {
        let bytes = self.view_bytes(view, element)?;
        let stride = view.stride().unwrap_or(size);
        let needed = match count {
            0 => Some(0),
            _ => (count - 1).checked_mul(stride).and_then(|n| n.checked_add(size)?.checked_add(offset)),
        };
        if needed.is_none_or(|needed| needed > bytes.len()) {
            let problem = format!(
                "{count} elements of {size} bytes every {stride} from offset {offset} do not fit buffer view {} of {} bytes",
                view.index(),
                bytes.len()
            );
            return Err(Fault::new(element, problem));
        }
        Ok(Elements { bytes: bytes.get(offset..).unwrap_or_default(), stride, size })
    }

    /// Replaces the values that a sparse accessor lists.
    fn overlay<V>(
        &self,
        sparse: &::gltf::accessor::sparse::Sparse,
        size: usize,
        element: &str,
        values: &mut [V],
        decode: impl Fn(&[u8]) -> V,
    ) -> Result<(), Fault> {
        let count = sparse.count();
        let list = sparse.indices();
        let kind = index_kind(&list);
        let at = self.elements(&list.view(), list.offset(), kind.size(), count, element)?;
        let with = self.elements(&sparse.values().view(), sparse.values().offset(), size, count, element)?;
        for entry in 0..count {
            let index = integer_component(kind, at.get(entry)) as usize;
            let place = values.get_mut(index).ok_or_else(|| {
                Fault::new(
                    element,
                    format!("sparse entry {entry} replaces element {index}, which does not exist"),
                )
            })?;
            *place = decode(with.get(entry));
        }
        Ok(())
    }
}

fn check_finite<const N: usize>(values: &[[f32; N]], element: &str) -> Result<(), Fault> {
    match values.iter().position(|value| value.iter().any(|number| !number.is_finite())) {
        Some(index) => Err(Fault::new(element, format!("value {index} is not a finite number"))),
        None => Ok(()),
    }
}

fn index_kind(list: &::gltf::accessor::sparse::Indices) -> ComponentType {
    use ::gltf::accessor::sparse::IndexType;
    match list.index_type() {
        IndexType::U8 => ComponentType::U8,
        IndexType::U16 => ComponentType::U16,
        IndexType::U32 => ComponentType::U32,
    }
}

fn integer_component(kind: DataType, bytes: &[u8]) -> u32 {
    match (kind, bytes) {
        (DataType::U8 | DataType::I8, [a]) => u32::from(*a),
        (DataType::U16 | DataType::I16, [a, b]) => u32::from(u16::from_le_bytes([*a, *b])),
        (_, [a, b, c, d]) => u32::from_le_bytes([*a, *b, *c, *d]),
        _ => 0,
    }
}

fn float_component(kind: DataType, normalized: bool, bytes: &[u8]) -> f32 {
    let raw = integer_component(kind, bytes);
    let (value, full) = match kind {
        DataType::F32 => return f32::from_bits(raw),
        DataType::U32 => (raw as f32, u32::MAX as f32),
        DataType::U16 => (raw as f32, 65535.0),
        DataType::U8 => (raw as f32, 255.0),
        DataType::I16 => (f32::from(raw as u16 as i16), 32767.0),
        DataType::I8 => (f32::from(raw as u8 as i8), 127.0),
    };
    if normalized { (value / full).max(-1.0) } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalised_integers_reach_exactly_one_and_minus_one() {
        assert_eq!(float_component(DataType::U8, true, &[255]), 1.0);
        assert_eq!(float_component(DataType::I8, true, &[0x81]), -1.0);
        assert_eq!(float_component(DataType::I8, true, &[0x80]), -1.0);
        assert_eq!(float_component(DataType::I16, true, &[0xff, 0x7f]), 1.0);
        assert_eq!(float_component(DataType::U16, false, &[0x00, 0x01]), 256.0);
        assert_eq!(float_component(DataType::F32, false, &1.5f32.to_le_bytes()), 1.5);
    }
}
