//! Faults of a scene, for the author of the file: file, element or line, the fault, and where possible the correction.

use crate::cancel::Cancelled;
use shadecast_model::text::printable;

/// Why a scene or an asset cannot be used. The text is complete: print it as it is.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// Loading was asked to end.
    #[error("loading was interrupted")]
    Cancelled(#[from] Cancelled),
    /// The operating system refused the file.
    #[error("{}: cannot be read: {reason}", shown(file))]
    Read {
        /// The path as the user wrote it.
        file: String,
        /// The system's reason; not called source, since who prints the chain of causes would print it twice.
        reason: std::io::Error,
    },
    /// An asset is damaged, or uses what is not supported.
    #[error("{}: {}: {}", shown(file), shown(element), shown(problem))]
    Asset {
        /// File name or the name handed to the importer.
        file: String,
        /// The part of it: `mesh 'x' primitive 0`, `node 3`.
        element: String,
        /// What is wrong with it.
        problem: String,
    },
    /// A scene file has a wrong line.
    #[error("{}:{line}: {}", shown(file), shown(problem))]
    SceneFile {
        /// The path as the user wrote it.
        file: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong, with a suggestion where there is one.
        problem: String,
    },
    /// A camera or a head path of this name is wanted, and the scene has none.
    #[error("the scene has no {what} \"{}\"{}", printable(name), shown(hint))]
    UnknownName {
        /// What is looked for: `camera`.
        what: &'static str,
        /// The name as the user wrote it.
        name: String,
        /// What there is instead, ready to be appended.
        hint: String,
    },
    /// The SCENE argument itself makes no sense.
    #[error("scene '{}': {}", shown(argument), shown(problem))]
    Argument {
        /// What the user wrote.
        argument: String,
        /// What is wrong, and what is accepted.
        problem: String,
    },
}

/// A fault in an asset, before it is known which file the asset came from.
#[derive(Debug)]
pub(super) struct Fault {
    pub(super) element: String,
    pub(super) problem: String,
    /// The asset is not to blame: somebody asked to end.
    is_interruption: bool,
}

impl From<Cancelled> for Fault {
    fn from(cancelled: Cancelled) -> Self {
        Self { is_interruption: true, ..Self::new("asset", cancelled.to_string()) }
    }
}

impl Fault {
    pub(super) fn new(element: impl Into<String>, problem: impl Into<String>) -> Self {
        Self { element: element.into(), problem: problem.into(), is_interruption: false }
    }

    pub(super) fn in_file(self, file: &str) -> SceneError {
        if self.is_interruption {
            return Cancelled.into();
        }
        SceneError::Asset { file: file.to_owned(), element: self.element, problem: self.problem }
    }
}

/// A sentence of ours as it may reach a terminal, whatever of a file it quotes; only quotes are cut, where they are made.
pub(crate) fn shown(sentence: &str) -> String {
    let is_plain = |c: char| c == ' ' || c.is_ascii_graphic();
    let mut letter = [0; 4];
    let mut out = String::with_capacity(sentence.len());
    for character in sentence.chars() {
        match is_plain(character) {
            true => out.push(character),
            false => out += &printable(character.encode_utf8(&mut letter)),
        }
    }
    out
}
