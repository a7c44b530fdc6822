//! Arrays as one block of bytes in binary formats. Large arrays are copied, not decoded number by number: `#[serde(with =
//! "crate::bulk")]` on a `Vec` of plain data.
//!
//! The bytes have this machine's order. [`cache`](crate::cache), the one place that stores them, refuses those of the other
//! byte order.

use bytemuck::Pod;
use serde::de::{Deserializer, Error, Visitor};
use serde::ser::Serializer;
use std::fmt;
use std::marker::PhantomData;

/// Writes the items as they lie in memory.
pub fn serialize<T: Pod, S: Serializer>(items: &[T], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytemuck::cast_slice(items))
}

/// Reads what [`serialize`] wrote.
pub fn deserialize<'de, T: Pod, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    deserializer.deserialize_bytes(Block(PhantomData))
}

struct Block<T>(PhantomData<T>);

impl<T: Pod> Visitor<'_> for Block<T> {
    type Value = Vec<T>;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "a multiple of {} bytes", size_of::<T>())
    }

    fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Vec<T>, E> {
        if !bytes.len().is_multiple_of(size_of::<T>()) {
            return Err(E::invalid_length(bytes.len(), &self));
        }
        let mut items = vec![T::zeroed(); bytes.len() / size_of::<T>()];
        bytemuck::cast_slice_mut(&mut items).copy_from_slice(bytes);
        Ok(items)
    }
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};
    use serde::{Deserialize, Serialize};

    #[derive(Serialize, Deserialize, PartialEq, Debug)]
    struct Arrays {
        before: u8,
        #[serde(with = "crate::bulk")]
        places: Vec<Vec3>,
        #[serde(with = "crate::bulk")]
        turns: Vec<Quat>,
        #[serde(with = "crate::bulk")]
        none: Vec<u64>,
    }

    #[test]
    fn arrays_come_back_bit_for_bit_wherever_they_start() {
        let places = vec![Vec3::new(f32::NAN, -0.0, 1e-40), Vec3::X];
        for before in [0, 1] {
            let turns = vec![Quat::from_rotation_y(0.3)];
            let arrays = Arrays { before, places: places.clone(), turns, none: Vec::new() };
            let bytes = postcard::to_stdvec(&arrays).expect("serialises");
            let back: Arrays = postcard::from_bytes(&bytes).expect("same type");
            assert_eq!(bytemuck::bytes_of(&back.places[0]), bytemuck::bytes_of(&places[0]));
            assert_eq!((back.before, back.places[1], back.turns), (before, places[1], arrays.turns));
        }
    }

    #[test]
    fn a_block_of_another_size_is_refused() {
        let bytes = postcard::to_stdvec(&serde_bytes_like(&[1, 2, 3])).expect("serialises");
        #[derive(Deserialize)]
        struct Words(#[serde(with = "crate::bulk")] Vec<u32>);
        assert!(postcard::from_bytes::<Words>(&bytes).map(|words| words.0).is_err());
    }

    fn serde_bytes_like(bytes: &[u8]) -> impl Serialize + '_ {
        #[derive(Serialize)]
        struct Bytes<'a>(#[serde(serialize_with = "crate::bulk::serialize")] &'a [u8]);
        Bytes(bytes)
    }
}
