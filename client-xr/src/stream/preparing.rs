//! Arrivals of one connection until their hand-over: vertices, skeletons, patches and pictures, and their GPU memory. All
//! costly work on arrivals is here, on the intake's thread.

use super::bundle::Bundler;
use crate::decode::Picture;
use crate::draw::draw_list::NewestList;
use crate::draw::stages::atlas_draw::{BUNDLES, PictureWays};
use crate::draw::stages::batch::{BATCHES, Batch};
use crate::handover::{Bundle, Loan};
use crate::motion::Motion;
use shadecast_gpu::GpuError;
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::Welcome;
use shadecast_protocol::time::ClientTime;
use shadecast_shaders::generated::CornerGpu;

/// A decoded picture, and when it came.
#[derive(Debug)]
pub(crate) struct ArrivedPicture {
    /// When its last byte came.
    pub(crate) arrived: ClientTime,
    pub(crate) picture: Picture,
}

/// See the module.
#[allow(clippy::vec_box, reason = "boxes are handed over as they are")]
pub(crate) struct Preparing {
    /// Which connection it is of.
    pub(crate) serial: u64,
    pub(crate) motion: Motion,
    bundler: Bundler<ArrivedPicture>,
    list: NewestList,
    /// Of which patches the list is.
    listed: Option<u64>,
    /// The bundle made last.
    made: Option<UpdateId>,
    /// Memory that waits to be filled.
    batches: Vec<Box<Batch>>,
    bundles: Vec<Box<Bundle>>,
}

impl Preparing {
    /// Of a connection under these terms; `blends`: of a client that does.
    pub(crate) fn new(terms: &Welcome, serial: u64, blends: bool) -> Self {
        Self {
            serial,
            motion: Motion::new(terms.vertex_slots, terms.motion.into()),
            bundler: Bundler::new(terms.patch_slots, terms.atlas_extent_texels),
            list: NewestList::new(terms.patch_slots, BUNDLES, blends),
            listed: None,
            made: None,
            batches: Vec::with_capacity(BATCHES),
            bundles: Vec::with_capacity(BUNDLES),
        }
    }

    /// Memory that can be filled.
    pub(crate) fn take_back(&mut self, loan: Loan) {
        match loan {
            Loan::Batch(batch) => self.batches.push(batch),
            Loan::Bundle(mut bundle) => {
                // The decoder may want it.
                bundle.memory.on_device = None;
                self.bundles.push(bundle);
            }
        }
    }

    /// Takes in the next delta: its vertices and samples count at once, its patches with a picture.
    pub(crate) fn take_delta(&mut self, mut delta: ReceivedDelta) {
        self.motion.take_delta(&mut delta);
        if delta.is_update {
            self.bundler.add_delta(delta.geometry);
        }
    }

    /// Takes in a decoded picture. Gives back one that will not be shown.
    pub(crate) fn take_picture(&mut self, update: UpdateId, picture: ArrivedPicture) -> Option<Picture> {
        self.bundler.add_picture(update, picture).map(|unused| unused.picture)
    }

    /// Bytes that wait: for the GPU's vertex memory, and for pictures.
    pub(crate) fn waiting_bytes(&self) -> usize {
        self.motion.waiting_bytes() + self.bundler.waiting_bytes()
    }

    /// What has arrived, as far as a batch reaches; `None` where nothing has, or no batch is free.
    pub(crate) fn next_batch(&mut self) -> Option<Loan> {
        let mut batch = self.batches.pop_if(|_| self.motion.has_news())?;
        batch.fill(&mut self.motion);
        Some(Loan::Batch(batch))
    }

    /// Whether the next bundle can follow the last at once: that one was made for blocks that settle with it.
    pub(crate) fn is_behind(&mut self) -> bool {
        let complete = self.motion.complete().filter(|_| !self.bundles.is_empty());
        complete.is_some_and(|complete| self.bundler.has_complete(complete))
    }

    /// The first update whose blocks could not settle since this was asked last.
    pub(crate) fn take_unsettled(&mut self) -> Option<UpdateId> {
        self.bundler.take_unsettled()
    }

    /// Whether there is a picture, and no memory for its bundle.
    pub(crate) fn wants_bundle(&self) -> bool {
        self.bundles.is_empty() && self.bundler.has_pictures()
    }

    /// The newest complete bundle, if there is a newer one and memory for it: its picture, its patches' draw list, the blocks that
    /// settle with it. One with such comes before newer ones. All that it draws is in batches before it. Pictures that are not needed any more go to `recycle`.
    ///
    /// # Errors
    /// The device cannot draw pictures as the decoder now gives them.
    pub(crate) fn next_bundle(
        &mut self,
        ways: &mut PictureWays,
        mut recycle: impl FnMut(Picture),
    ) -> Result<Option<Loan>, GpuError> {
        let Some(complete) = self.motion.complete().filter(|_| !self.bundles.is_empty()) else {
            return Ok(None);
        };
        let newest = self.bundler.take_newest_complete(complete, |dropped| recycle(dropped.picture));
        let Some((update, ArrivedPicture { arrived, picture })) = newest else { return Ok(None) };
        let Some(mut bundle) = self.bundles.pop() else { return Ok(None) };
        match picture {
            Picture::OnDevice(picture) => {
                let ways = ways.of(&picture.image)?;
                bundle.memory.on_device = Some((picture, ways));
            }
            Picture::Planes(planes) => {
                bundle.memory.planes.write(planes.planes());
                recycle(Picture::Planes(planes));
            }
            Picture::FullChroma(planes) => {
                bundle.memory.planes.write(planes.planes());
                recycle(Picture::FullChroma(planes));
            }
        }
        bundle.memory.settled.write(self.bundler.settled().iter().copied());
        let coverage = self.bundler.revision().coverage;
        if bundle.coverage.replace(coverage) != Some(coverage) {
            bundle.memory.coverage.write(0, bytemuck::cast_slice(self.bundler.coverage().words()));
        }
        self.update_list();
        self.write_list(&mut bundle);
        bundle.state = self.motion.state();
        (bundle.update, bundle.picture_arrived) = (update, arrived);
        bundle.before = self.made.replace(update);
        bundle.shaded = self.bundler.shaded();
        Ok(Some(Loan::Bundle(bundle)))
    }

    /// The newest list, by what has changed of patches, and by the samples that have come for those that wait for some.
    fn update_list(&mut self) {
        let patches = Some(self.bundler.revision().patches);
        if std::mem::replace(&mut self.listed, patches) != patches
            || self.list.list().waits()
            || self.list.has_fresh()
        {
            let (changed, patches) = self.bundler.take_changed();
            self.list.update(patches, changed.as_slice(), &mut self.motion);
        }
    }

    /// What the patches draw, as far as this memory differs from it.
    fn write_list(&mut self, bundle: &mut Bundle) {
        let Bundle { memory, list, drawn, .. } = bundle;
        let corners: &mut [CornerGpu] = bytemuck::cast_slice_mut(memory.corners.bytes_mut());
        let indices: &mut [u32] = bytemuck::cast_slice_mut(memory.indices.bytes_mut());
        self.list.copy_to(memory.index, (corners, indices));
        list.copy(self.list.list());
        drawn.clear();
        drawn.extend_from_slice(self.motion.drawn());
    }
}
