//! A picture on the CPU, the input of encoders and the output of decoders.
//!
//! One type on both sides saves repeated checks. It knows neither codecs nor the source of pictures.

use thiserror::Error;

/// A picture of 4:2:0: luma, then blue and red difference at half the resolution in both directions, in tight planes one
/// behind the other.
///
/// Full range, 0 (black) to 255 (white), 128 is no colour; BT.709 primaries, transfer and matrix (ITU-R BT.709-6, item 3); a
/// colour's place is the middle of its four texels. Rows go from the top, bytes from the left.
///
/// The default is a picture of no texels, and memory to fill: [`I420::refill`] uses it again.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct I420 {
    extent_texels: [u32; 2],
    bytes: Vec<u8>,
}

/// Why bytes are no picture.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum I420Error {
    /// A side that cannot be halved.
    #[error("a 4:2:0 picture cannot be {}x{} texels: both sides must be even", .0[0], .0[1])]
    OddSide([u32; 2]),
    /// More or fewer bytes than the planes of this extent.
    #[error("an I420 picture of {}x{} texels has {want} bytes, not {got}: planes are tight", .extent_texels[0], .extent_texels[1])]
    Length {
        /// Bytes that are there.
        got: usize,
        /// Bytes that the extent demands.
        want: u64,
        /// Width and height in texels.
        extent_texels: [u32; 2],
    },
}

impl I420 {
    /// A picture of `bytes`, which are all its planes.
    ///
    /// # Errors
    /// A side is odd, or there are more or fewer bytes than the planes have.
    pub fn new(extent_texels: [u32; 2], bytes: Vec<u8>) -> Result<Self, I420Error> {
        check(extent_texels, bytes.len())?;
        Ok(Self { extent_texels, bytes })
    }

    /// Becomes a picture of what `write` appends to nothing, in the memory that it has.
    ///
    /// # Errors
    /// As of [`I420::new`]; then it has no texels.
    pub fn refill(
        &mut self,
        extent_texels: [u32; 2],
        write: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), I420Error> {
        self.bytes.clear();
        write(&mut self.bytes);
        let checked = check(extent_texels, self.bytes.len());
        if checked.is_err() {
            self.bytes.clear();
        }
        self.extent_texels = if checked.is_ok() { extent_texels } else { [0; 2] };
        checked
    }

    /// Bytes of a picture of this extent, whose sides are even.
    pub fn byte_count([width, height]: [u32; 2]) -> u64 {
        let luma = u64::from(width) * u64::from(height);
        luma.saturating_add(luma / 2)
    }

    /// Width and height of luma in texels; both are even.
    pub fn extent_texels(&self) -> [u32; 2] {
        self.extent_texels
    }

    /// All planes, one behind the other.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Luma, blue difference, red difference.
    pub fn planes(&self) -> [&[u8]; 3] {
        let (y, chroma) = self.bytes.split_at(self.luma_bytes());
        let (cb, cr) = chroma.split_at(chroma.len() / 2);
        [y, cb, cr]
    }

    /// The same, to write.
    pub fn planes_mut(&mut self) -> [&mut [u8]; 3] {
        let luma = self.luma_bytes();
        let (y, chroma) = self.bytes.split_at_mut(luma);
        let (cb, cr) = chroma.split_at_mut(chroma.len() / 2);
        [y, cb, cr]
    }

    fn luma_bytes(&self) -> usize {
        self.bytes.len() / 3 * 2
    }
}

/// A picture of 4:4:4: as [`I420`], but with a blue and a red difference for each texel. No codec carries it: it is what a
/// measurement compares with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct I444 {
    extent_texels: [u32; 2],
    bytes: Vec<u8>,
}

impl I444 {
    /// A picture of `bytes`, which are all its planes; `None` where there are more or fewer than these have.
    pub fn new(extent_texels: [u32; 2], bytes: Vec<u8>) -> Option<Self> {
        let [width, height] = extent_texels.map(u64::from);
        (3 * width * height == bytes.len() as u64).then_some(Self { extent_texels, bytes })
    }

    /// Width and height of each plane in texels.
    pub fn extent_texels(&self) -> [u32; 2] {
        self.extent_texels
    }

    /// Luma, blue difference, red difference.
    pub fn planes(&self) -> [&[u8]; 3] {
        let third = self.bytes.len() / 3;
        [0, 1, 2].map(|plane| &self.bytes[plane * third..(plane + 1) * third])
    }
}

fn check(extent_texels: [u32; 2], got: usize) -> Result<(), I420Error> {
    if extent_texels.iter().any(|side| side % 2 != 0) {
        return Err(I420Error::OddSide(extent_texels));
    }
    let want = I420::byte_count(extent_texels);
    if got as u64 == want { Ok(()) } else { Err(I420Error::Length { got, want, extent_texels }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_lie_tight_one_behind_the_other() {
        let mut picture = I420::new([4, 2], (0..12).collect()).expect("twelve bytes");
        assert_eq!(picture.planes(), [&[0, 1, 2, 3, 4, 5, 6, 7][..], &[8, 9], &[10, 11]]);
        picture.planes_mut()[2].fill(7);
        assert_eq!(picture.bytes()[9..], [9, 7, 7]);
        assert_eq!(I420::default().planes(), [&[0u8; 0][..]; 3]);
    }

    #[test]
    fn planes_of_full_chroma_are_alike() {
        let picture = I444::new([2, 1], (0..6).collect()).expect("six bytes");
        assert_eq!(picture.planes(), [&[0, 1], &[2, 3], &[4, 5]]);
        assert_eq!(I444::new([2, 1], vec![0; 5]), None);
    }

    #[test]
    fn odd_sides_and_other_lengths_are_no_pictures() {
        assert_eq!(I420::new([3, 2], vec![0; 9]), Err(I420Error::OddSide([3, 2])));
        for got in [0, 11, 13] {
            let extent_texels = [4, 2];
            let refused = Err(I420Error::Length { got, want: 12, extent_texels });
            assert_eq!(I420::new(extent_texels, vec![0; got]), refused);
        }
        assert!(I420::new([u32::MAX - 1; 2], Vec::new()).is_err());
    }

    #[test]
    fn memory_is_used_again_and_a_failure_leaves_no_half_picture() {
        let mut picture = I420::new([4, 4], vec![9; 24]).expect("a picture");
        let memory = picture.bytes().as_ptr();
        picture.refill([4, 2], |bytes| bytes.extend([1; 12])).expect("a picture");
        assert_eq!((picture.extent_texels(), picture.bytes()), ([4, 2], &[1; 12][..]));
        assert_eq!(picture.bytes().as_ptr(), memory);
        assert!(picture.refill([4, 2], |bytes| bytes.push(1)).is_err());
        assert_eq!(picture, I420::default());
    }
}
