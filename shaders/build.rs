//! Compiles `glsl/` for `generated` of `src/lib.rs`. GLSL gets its macros from Rust: see `src/constants.rs`.

#[path = "src/constants.rs"]
mod constants;

fn main() {
    shadecast_spirv::compile::folder("glsl", &constants::glsl_macros(), "generated.rs");
}
