//! GLSL, its SPIR-V and reflection, and the CPU twins of the stages.
