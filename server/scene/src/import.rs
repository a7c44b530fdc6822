//! Common work of all importers: reading the file, naming elements, and reporting warnings and faults.

use super::error::{Fault, SceneError, shown};
use super::limits::read_limited;
use super::references::Folder;
use crate::{Cancel, Model};
use shadecast_model::text::printable;
use std::collections::BTreeSet;
use std::path::Path;

/// What was left out of a model, one sentence each, each once.
pub(crate) type Warnings = BTreeSet<String>;

/// Makes a model of an asset's bytes. The name becomes the model's.
pub(crate) type Import = fn(&[u8], &str, &Surroundings) -> Result<(Model, Warnings), Fault>;

/// What an importer may look at beside the asset's bytes, and whether it is to stop.
#[derive(Debug, Default)]
pub(crate) struct Surroundings {
    /// Where other files are looked up; `None` forbids them.
    pub folder: Option<Folder>,
    /// Looked at between meshes, images and clips.
    pub cancel: Cancel,
}

impl Surroundings {
    /// Of a file.
    pub fn of(path: &Path, cancel: &Cancel) -> Self {
        Self { folder: Some(Folder::of(path)), cancel: cancel.clone() }
    }
}

/// Loads a file; what it refers to is found relative to it.
pub(crate) fn load(path: &Path, import: Import) -> Result<Model, SceneError> {
    let (model, warnings) = read(path, import, &Cancel::default())?;
    report(&warnings, &path.display().to_string());
    Ok(model)
}

/// As [`load`], with the warnings still to be told.
pub(crate) fn read(path: &Path, import: Import, cancel: &Cancel) -> Result<(Model, Warnings), SceneError> {
    let file = path.display().to_string();
    let bytes = read_limited(path).map_err(|reason| SceneError::Read { file: file.clone(), reason })?;
    let name = path.file_stem().map_or_else(|| file.clone(), |stem| printable(&stem.to_string_lossy()));
    import(&bytes, &name, &Surroundings::of(path, cancel)).map_err(|fault| fault.in_file(&file))
}

/// Loads an asset that lies in memory and refers to no other file. `name` stands for the file in messages.
pub(crate) fn from_slice(bytes: &[u8], name: &str, import: Import) -> Result<Model, SceneError> {
    let nothing = Surroundings::default();
    let (model, warnings) = import(bytes, name, &nothing).map_err(|fault| fault.in_file(name))?;
    report(&warnings, name);
    Ok(model)
}

/// Says what was left out.
pub(crate) fn report(warnings: &Warnings, file: &str) {
    for warning in warnings {
        tracing::warn!("{}: {}", shown(file), shown(warning));
    }
}

/// `mesh 'x'` where it has a name, `mesh 3` where not.
pub(crate) fn label(kind: &str, index: usize, name: Option<&str>) -> String {
    name.map_or_else(|| format!("{kind} {index}"), |name| format!("{kind} '{}'", printable(name)))
}
