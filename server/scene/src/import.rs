//! What every importer does around its format: reading the file, naming elements, and telling warnings and faults.

use super::error::{Fault, SceneError};
use super::limits::read_limited;
use crate::Model;
use std::collections::BTreeSet;
use std::path::Path;

/// What was left out of a model, one sentence each, each once.
pub(crate) type Warnings = BTreeSet<String>;

/// Makes a model of an asset's bytes. The name becomes the model's; files beside the asset are looked up in the
/// folder, and `None` forbids them.
pub(crate) type Import = fn(&[u8], &str, Option<&Path>) -> Result<(Model, Warnings), Fault>;

/// Loads a file; what it refers to is found relative to it.
pub(crate) fn load(path: &Path, import: Import) -> Result<Model, SceneError> {
    let (model, warnings) = read(path, import)?;
    tell(&warnings, &path.display().to_string());
    Ok(model)
}

/// As [`load`], with the warnings still to be told.
pub(crate) fn read(path: &Path, import: Import) -> Result<(Model, Warnings), SceneError> {
    let file = path.display().to_string();
    let bytes = read_limited(path).map_err(|source| SceneError::Read { file: file.clone(), source })?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let name = path.file_stem().map_or_else(|| file.clone(), |stem| stem.to_string_lossy().into_owned());
    import(&bytes, &name, Some(folder)).map_err(|fault| fault.in_file(&file))
}

/// Loads an asset that lies in memory and refers to no other file. `name` stands for the file in messages.
pub(crate) fn from_slice(bytes: &[u8], name: &str, import: Import) -> Result<Model, SceneError> {
    let (model, warnings) = import(bytes, name, None).map_err(|fault| fault.in_file(name))?;
    tell(&warnings, name);
    Ok(model)
}

/// Says what was left out.
pub(crate) fn tell(warnings: &Warnings, file: &str) {
    for warning in warnings {
        tracing::warn!("{file}: {warning}");
    }
}

/// `mesh 'x'` where it has a name, `mesh 3` where not.
pub(crate) fn label(kind: &str, index: usize, name: Option<&str>) -> String {
    name.map_or_else(|| format!("{kind} {index}"), |name| format!("{kind} '{}'", name.escape_debug()))
}
