//! A compiled shader in Rust: SPIR-V with its reflection. Build scripts make these from GLSL (feature `compile`). This crate
//! knows no shader, and no Vulkan.
#![forbid(unsafe_code)]

#[cfg(feature = "compile")]
pub mod compile;

/// Compiled GLSL with what reflection found in it.
#[derive(Debug)]
pub struct Shader {
    /// File name, such as `skin.comp`.
    pub name: &'static str,
    /// Pipeline stage.
    pub stage: Stage,
    /// Size of the push constant block; 0 where there is none.
    pub push_bytes: u32,
    /// Invocations of a workgroup in x, y and z; `None` where the stage is not compute.
    pub workgroup: Option<[u32; 3]>,
    /// SPIR-V.
    pub words: &'static [u32],
    /// Bindings of descriptor set 0, by index.
    pub bindings: &'static [Binding],
}

/// Pipeline stage of a shader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Vertex.
    Vertex,
    /// Fragment.
    Fragment,
    /// Compute.
    Compute,
}

/// One binding of descriptor set 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// The `binding = ` number.
    pub index: u32,
    /// What is bound.
    pub kind: BindingKind,
    /// Array length; 0 for an array whose length the application chooses.
    pub count: u32,
    /// Name of the GLSL variable or block instance.
    pub name: &'static str,
}

/// What a binding holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BindingKind {
    /// `uniform` block.
    UniformBuffer,
    /// `buffer` block.
    StorageBuffer,
    /// `sampler2D`.
    SampledImage,
    /// `image2D`.
    StorageImage,
}
