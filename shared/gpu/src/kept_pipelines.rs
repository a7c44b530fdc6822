//! Compiled pipelines of earlier starts (`VkPipelineCache`), in one file for each program, device and driver.
//!
//! A file that is damaged, or of another device or driver, counts as absent. Drivers trust what they are given, so a folder that
//! other users can write to is not used. No failure in here stops a program: at worst it compiles again.

use crate::Gpu;
use ash::vk;
use shadecast_system::{PendingFile, owner};
use std::hash::Hasher;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Largest file, bytes.
const MAX_BYTES: u64 = 256 << 20;
/// What every driver's data begin with: `VkPipelineCacheHeaderVersionOne`.
const HEADER_BYTES: usize = 32;
const HEADER_VERSION: u32 = 1;
/// After the data: their checksum.
const CHECKSUM_BYTES: usize = 8;

/// The open cache, and where it is kept.
pub(crate) struct KeptPipelines {
    handle: vk::PipelineCache,
    file: PathBuf,
    /// Checksum of what the file holds; 0: nothing.
    kept: AtomicU64,
}

impl KeptPipelines {
    /// Nobody compiles any more.
    pub(crate) fn destroy(&self, device: &ash::Device) {
        // SAFETY: shutdown; no pipeline is being made.
        unsafe { device.destroy_pipeline_cache(self.handle, None) };
    }
}

impl Gpu {
    /// Takes over what an earlier start of `program` (a short word, for the file's name) kept in `folder`. Pipelines made from now
    /// on are compiled faster where they are known. The first call counts.
    pub fn load_pipelines(&self, folder: &Path, program: &str) {
        let file = folder.join(self.pipelines_file(program));
        let data = read(&file, &self.pipelines_header()).unwrap_or_default();
        let kept = if data.is_empty() { 0 } else { checksum(&data) };
        let info = vk::PipelineCacheCreateInfo::default().initial_data(&data);
        // SAFETY: the data are this driver's own, whole.
        match unsafe { self.device().create_pipeline_cache(&info, None) } {
            Ok(handle) => {
                let loaded = KeptPipelines { handle, file, kept: AtomicU64::new(kept) };
                if let Err(second) = self.kept_pipelines.set(loaded) {
                    second.destroy(self.device());
                }
            }
            Err(error) => tracing::warn!("compiled pipelines are not kept: {error}"),
        }
    }

    /// Writes what has been compiled to the folder of [`Self::load_pipelines`], where there is anything new.
    pub fn keep_pipelines(&self) {
        let Some(kept) = self.kept_pipelines.get() else { return };
        if let Err(error) = self.write_pipelines(kept) {
            tracing::warn!("compiled pipelines are not kept: {}: {error}", kept.file.display());
        }
    }

    fn write_pipelines(&self, kept: &KeptPipelines) -> io::Result<()> {
        // SAFETY: the cache is alive as long as the device.
        let data = unsafe { self.device().get_pipeline_cache_data(kept.handle) };
        let mut data = data.map_err(io::Error::other)?;
        let new = checksum(&data);
        if kept.kept.swap(new, Ordering::Relaxed) == new {
            return Ok(());
        }
        let folder = kept.file.parent().expect("a file in a folder");
        owner::make_folder(folder)?;
        if !owner::is_written_by_owner_alone(&std::fs::metadata(folder)?) {
            return Err(io::Error::other("other users can write to its folder; run chmod go-w on it"));
        }
        data.extend(new.to_le_bytes());
        let mut file = PendingFile::create_private(&kept.file)?;
        file.write_all(&data)?;
        file.commit()
    }

    /// For pipelines that are made; null where none are kept.
    pub(crate) fn pipeline_cache(&self) -> vk::PipelineCache {
        self.kept_pipelines.get().map_or(vk::PipelineCache::null(), |kept| kept.handle)
    }

    fn pipelines_file(&self, program: &str) -> String {
        let device: String = self.pipelines_header()[8..].iter().map(|byte| format!("{byte:02x}")).collect();
        format!("pipelines-{program}-{device}.bin")
    }

    /// What this driver's data begin with.
    fn pipelines_header(&self) -> [u8; HEADER_BYTES] {
        let vk::PhysicalDeviceProperties { vendor_id, device_id, pipeline_cache_uuid, .. } = self.properties;
        let mut header = [0; HEADER_BYTES];
        let numbers = [HEADER_BYTES as u32, HEADER_VERSION, vendor_id, device_id];
        for (bytes, number) in header.chunks_exact_mut(4).zip(numbers) {
            bytes.copy_from_slice(&number.to_le_bytes());
        }
        header[16..].copy_from_slice(&pipeline_cache_uuid);
        header
    }
}

/// The data of a whole file of this driver, that only its owner could write.
fn read(file: &Path, header: &[u8]) -> Option<Vec<u8>> {
    let folder = std::fs::metadata(file.parent()?).ok()?;
    let meta = std::fs::metadata(file).ok()?;
    let is_ours = [&folder, &meta].into_iter().all(owner::is_written_by_owner_alone);
    if !is_ours || !meta.is_file() || meta.len() > MAX_BYTES {
        return None;
    }
    let mut data = std::fs::read(file).ok()?;
    let written = data.split_off(data.len().checked_sub(CHECKSUM_BYTES)?);
    let is_whole = written == checksum(&data).to_le_bytes() && data.starts_with(header);
    is_whole.then_some(data)
}

/// Excludes chance, not intent. Another toolchain may count otherwise: then pipelines are compiled once more.
fn checksum(data: &[u8]) -> u64 {
    let mut hasher = std::hash::DefaultHasher::new();
    hasher.write(data);
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: [u8; HEADER_BYTES] = [7; HEADER_BYTES];

    fn whole(data: &[u8]) -> Vec<u8> {
        [data, &checksum(data).to_le_bytes()].concat()
    }

    #[test]
    fn whole_files_of_this_driver_are_read_and_no_others() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("pipelines.bin");
        let read_from = |bytes: &[u8]| {
            std::fs::write(&file, bytes).expect("written");
            read(&file, &HEADER)
        };
        assert_eq!(read(&file, &HEADER), None, "there is none yet");
        let data = [&HEADER[..], b"pipelines"].concat();
        let good = whole(&data);
        assert_eq!(read_from(&good), Some(data));
        for length in 0..good.len() {
            assert_eq!(read_from(&good[..length]), None, "cut to {length}");
        }
        for at in 0..good.len() {
            let mut damaged = good.clone();
            damaged[at] ^= 1;
            assert_eq!(read_from(&damaged), None, "damaged at {at}");
        }
        assert_eq!(read_from(&whole(&[8; 2 * HEADER_BYTES])), None, "another driver's");
        assert_eq!(read(folder.path(), &HEADER), None, "a folder");
    }

    #[cfg(unix)]
    #[test]
    fn files_that_others_could_write_are_not_read() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("pipelines.bin");
        std::fs::write(&file, whole(&HEADER)).expect("written");
        let mode = |path: &Path, mode| {
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).expect("changed");
            read(&file, &HEADER).is_some()
        };
        assert!(mode(&file, 0o600));
        assert!(!mode(&file, 0o666));
        assert!(mode(&file, 0o600));
        assert!(!mode(folder.path(), 0o777));
    }
}
