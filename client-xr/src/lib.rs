//! The Shadecast headset client: receives, decodes, bundles and draws.

pub mod decode;
