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

impl Literal for f32 {
    fn literal(&self) -> String {
        format!("{self:?}")
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
    /// Tag of a place in the sample ring that holds no sample. Samples have tags above it.
    NO_SAMPLE: u32 = 0;
    /// Bit of [`VertexWriteGpu::slot`](crate::generated::VertexWriteGpu::slot) for a static vertex that enters.
    STATIC_BIT: u32 = 1 << 31;
    /// State of a vertex's position, its `w`: no samples around the display time.
    NOT_DRAWABLE: f32 = 0.0;
    /// State of a position: interpolated, or static.
    ON_CURVE: f32 = 1.0;
    /// State of a position: past the last sample, or the future has changed; the next curve is blended to.
    PAST_THE_END: f32 = 2.0;
    /// Texels across and down that an invocation of `ycbcr.comp` converts.
    YCBCR_TEXELS: [u32; 2] = [8, 2];
}
