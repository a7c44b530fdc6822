//! Failures of a headset's runtime, each with its remedy.

use openxr::sys;
use shadecast_gpu::GpuError;
use std::io::ErrorKind;
use std::path::PathBuf;

/// What to do without a loader.
const NO_LOADER: &str = if cfg!(windows) {
    "put openxr_loader.dll beside this program or into the PATH; the OpenXR SDK has it"
} else {
    "install it (Debian and Ubuntu: package libopenxr-loader1)"
};
/// Runtimes of this system, and where the manifest of one lies.
const RUNTIMES: &str = if cfg!(windows) { "SteamVR, Meta Quest Link" } else { "SteamVR, Monado, WiVRn" };
const MANIFEST: &str = if cfg!(windows) {
    r"C:\Program Files (x86)\Steam\steamapps\common\SteamVR\steamxr_win64.json"
} else {
    "/usr/share/openxr/1/openxr_monado.json"
};

/// What went wrong with the headset's runtime.
#[derive(Debug, thiserror::Error)]
pub enum XrError {
    /// The loader library is missing.
    #[error("the OpenXR loader could not be opened ({0}); {remedy}", remedy = NO_LOADER)]
    NoLoader(String),
    /// No runtime answers the loader.
    #[error(
        "no OpenXR runtime answers ({0}); start your headset's runtime ({runtimes}), or set the environment \
         variable XR_RUNTIME_JSON to the path of its manifest, for example \
         XR_RUNTIME_JSON={manifest}",
        runtimes = RUNTIMES,
        manifest = MANIFEST
    )]
    NoRuntime(sys::Result),
    /// The environment names a runtime that is not there.
    #[error(
        "no OpenXR runtime answers: the environment variable XR_RUNTIME_JSON names {}, which {wrong}; correct it, or unset \
         it to use the system's active runtime",
        path.display()
    )]
    NoManifest {
        /// What it names.
        path: PathBuf,
        /// What is wrong with that.
        wrong: &'static str,
    },
    /// The runtime lacks an extension.
    #[error(
        "the OpenXR runtime \"{runtime}\" lacks {extension}, which this program needs; use another runtime"
    )]
    NoExtension {
        /// The runtime's name for itself.
        runtime: String,
        /// The extension.
        extension: &'static str,
    },
    /// No headset.
    #[error("the OpenXR runtime finds no headset ({0}); connect it and switch it on")]
    NoHeadset(sys::Result),
    /// The runtime offers nothing that can be drawn to.
    #[error("the OpenXR runtime offers no swapchain format of 8-bit sRGB; use another runtime")]
    NoFormat,
    /// What the runtime makes for foveation is of no use.
    #[error("the OpenXR runtime's density maps cannot be used: {0}")]
    NoDensityMaps(&'static str),
    /// Session, instance or device are gone; all must be made anew.
    #[error("the headset's session was lost while {0}")]
    Lost(&'static str),
    /// A call failed.
    #[error("{doing}: the OpenXR runtime answers {result:?}")]
    Call {
        /// What was being done.
        doing: &'static str,
        /// The answer.
        result: sys::Result,
    },
    /// The device failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

/// Why no runtime answers, as far as that can be seen from here.
pub(super) fn no_runtime(result: sys::Result) -> XrError {
    let named = std::env::var_os("XR_RUNTIME_JSON").filter(|path| !path.is_empty()).map(PathBuf::from);
    let Some(path) = named else { return XrError::NoRuntime(result) };
    match std::fs::File::open(&path).map_err(|error| error.kind()) {
        Err(ErrorKind::NotFound) => XrError::NoManifest { path, wrong: "does not exist" },
        Err(_) => XrError::NoManifest { path, wrong: "cannot be read" },
        Ok(_) if path.is_dir() => XrError::NoManifest { path, wrong: "is a folder" },
        Ok(_) => XrError::NoRuntime(result),
    }
}

pub(super) trait Doing<T> {
    fn doing(self, doing: &'static str) -> Result<T, XrError>;
}

impl<T> Doing<T> for Result<T, sys::Result> {
    fn doing(self, doing: &'static str) -> Result<T, XrError> {
        self.map_err(|result| match result {
            sys::Result::ERROR_INSTANCE_LOST | sys::Result::ERROR_SESSION_LOST => XrError::Lost(doing),
            _ => XrError::Call { doing, result },
        })
    }
}
