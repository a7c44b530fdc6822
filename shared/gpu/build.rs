//! Compiles the self-test's shaders, and those of the tests.

fn main() {
    shadecast_spirv::compile::folder("glsl", &[], "selftest.rs");
    shadecast_spirv::compile::folder("tests/glsl", &[], "tests.rs");
}
