//! Constants that GLSL and Rust share. Rust is the source: the build script, which includes this file, gives them and the
//! limits of `shadecast_protocol::limits` to the compiler as macros of the same names.

/// A value as GLSL writes it.
trait Literal {
    fn literal(&self) -> String;
}

impl Literal for u32 {
    fn literal(&self) -> String {
        format!("{self}u")
    }
}

impl Literal for [u32; 2] {
    fn literal(&self) -> String {
        format!("uvec2({}u, {}u)", self[0], self[1])
    }
}

/// Defines constants, and [`glsl_defines`] of all of them.
macro_rules! shared {
    ($($(#[$doc:meta])* $name:ident: $type:ty = $value:expr;)*) => {
        $($(#[$doc])* pub const $name: $type = $value;)*

        /// All of them, as `#define` names and values.
        pub fn glsl_defines() -> Vec<(&'static str, String)> {
            vec![$((stringify!($name), $name.literal())),*]
        }
    };
}

shared! {
    /// Texels across and down that an invocation of `ycbcr.comp` converts.
    YCBCR_TEXELS: [u32; 2] = [8, 2];
}
