//! Assets made by the program itself, so that a first start and every test have something real to render.
//!
//! A [`BuiltIn`] is produced as the bytes of a GLB file and goes through the same importer as any other file: nothing in here
//! knows of scenes, renderers or Vulkan.

mod courtyard;
mod curve;
mod dragon;
pub mod glb;
mod noise;
pub mod picture;
pub mod surface;

pub use dragon::dragon;

/// A model that needs no file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuiltIn {
    /// A winged dragon, with the clip `fly`.
    Dragon,
    /// Walls, gates, steps and seats of a courtyard of 10 m by 10 m around the user.
    Masonry,
    /// The ground that belongs to them.
    Paving,
    /// A tree of 4 m.
    Tree,
    /// A cypress of 5 m.
    Cypress,
    /// Ivy, 2 m wide, that hangs at a wall behind z = 0.
    Ivy,
    /// A shrub in a pot.
    Pot,
    /// A lamp post with its light.
    Lantern,
}

impl BuiltIn {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Dragon,
        Self::Masonry,
        Self::Paving,
        Self::Tree,
        Self::Cypress,
        Self::Ivy,
        Self::Pot,
        Self::Lantern,
    ];

    /// What a scene file calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dragon => "dragon",
            Self::Masonry => "masonry",
            Self::Paving => "paving",
            Self::Tree => "tree",
            Self::Cypress => "cypress",
            Self::Ivy => "ivy",
            Self::Pot => "pot",
            Self::Lantern => "lantern",
        }
    }

    /// The one of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|built_in| built_in.name() == name)
    }

    /// The bytes of a GLB file, the same at every call: metres, standing on y = 0, facing +z.
    pub fn glb(self) -> Vec<u8> {
        match self {
            Self::Dragon => dragon(),
            Self::Masonry => courtyard::masonry(),
            Self::Paving => courtyard::paving(),
            Self::Tree => courtyard::tree(),
            Self::Cypress => courtyard::cypress(),
            Self::Ivy => courtyard::ivy(),
            Self::Pot => courtyard::pot(),
            Self::Lantern => courtyard::lantern(),
        }
    }
}
