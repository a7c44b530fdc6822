//! Arguments that several commands share, and what they mean to the server.
//!
//! Text enters; options of the server's library leave. The library knows no command line.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Args, value_parser};
use shadecast_desktop::flags::number;
use shadecast_gpu::{GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::scene::skins::Skinning;
use shadecast_server::update::ShowOptions;
use shadecast_server::visibility::detail::DEFAULT_DETAIL_PIXELS;
use std::fmt::Debug;
use std::path::PathBuf;
use std::str::FromStr;

/// How a scene is shown to viewers.
#[derive(Clone, Debug, Args)]
pub struct RenderArgs {
    #[command(flatten)]
    quality: QualityArgs,
    /// Atlas width and height in texels, powers of two from 512x512 to 4096x2048
    #[arg(long, value_name = "WxH", default_value_t = AtlasExtent::DEFAULT)]
    pub atlas: AtlasExtent,
    /// Pixels of the client's display that a level of detail may err by, twice as many where bits or time are short, half as many where they are
    /// to spare; 0: everything has full detail
    #[arg(long, value_name = "PIXELS", default_value_t = DEFAULT_DETAIL_PIXELS, value_parser = number(0.0..=64.0f32, "pixels"))]
    detail: f32,
    /// Part of the client's slots and of the atlas for what an abrupt turn of the head would show, 0 to 0.5; 0: none
    #[arg(long, value_name = "SHARE", default_value_t = DEFAULT_SURROUND, value_parser = number(0.0..=0.5f32, "of all"))]
    surround: f32,
    /// Writes there what happened when, for Perfetto (ui.perfetto.dev)
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
}

impl RenderArgs {
    /// How finely pictures are quantised; `usual`: unless told.
    pub fn quality(&self, usual: QualityOptions) -> QualityOptions {
        let QualityArgs { qp, bitrate } = self.quality;
        qp.map(QualityOptions::Constant).or(bitrate).unwrap_or(usual)
    }

    /// What viewers are shown.
    pub fn show(&self) -> ShowOptions {
        ShowOptions { detail_pixels: self.detail, surround: self.surround }
    }
}

#[derive(Clone, Copy, Debug, Args)]
struct QualityArgs {
    /// The same quantisation for all pictures, 0 (finest) to 51, instead of one that follows --bitrate
    #[arg(long, conflicts_with = "bitrate", value_parser = value_parser!(u8).range(0..=51))]
    qp: Option<u8>,
    /// What all streams of one client may take together: Mbit/s, or auto for what the link carries, up to 100. Pictures are quantised as
    /// finely as that allows [default: auto; in the lab 20]
    #[arg(long, value_name = "MBIT", value_parser = bitrate)]
    bitrate: Option<QualityOptions>,
}

fn bitrate(text: &str) -> Result<QualityOptions, String> {
    if text == "auto" {
        return Ok(QualityOptions::Auto);
    }
    let mbit_s = number(0.1..=1000.0, "Mbit/s")(text).map_err(|wrong| format!("{wrong}, or auto"))?;
    Ok(QualityOptions::Bitrate(mbit_s))
}

/// How clips are sampled.
#[derive(Clone, Copy, Debug, Args)]
pub struct SamplingArgs {
    /// How clips become keys.
    #[arg(
        long,
        default_value_t,
        help = "How clips become keys: error-bounded[:0.1mm], or the paper's constant[:100ms]"
    )]
    pub sampling: Sampling,
}

/// How a scene is prepared for viewers.
#[derive(Clone, Copy, Debug, Args)]
pub struct SceneArgs {
    #[command(flatten)]
    sampling: SamplingArgs,
    /// How vertices are skinned
    #[arg(long, default_value_t, value_parser = one_of(Skinning::ALL, of_skinning))]
    skinning: Skinning,
    /// How clients are told of motion
    #[arg(long, default_value_t, value_parser = one_of(MotionOption::ALL, of_motion))]
    motion: MotionOption,
}

impl SceneArgs {
    /// The same for the library.
    pub fn options(&self) -> SceneOptions {
        SceneOptions {
            sampling: self.sampling.sampling,
            skinning: self.skinning,
            motion: self.motion,
            ..SceneOptions::default()
        }
    }
}

/// The device.
#[derive(Clone, Debug, Args)]
pub struct GpuArgs {
    /// Part of the wanted Vulkan device's name
    #[arg(long)]
    pub device: Option<String>,
    /// Vulkan validation layers on; messages are logged and counted
    #[arg(long)]
    pub validation: bool,
}

impl GpuArgs {
    /// The same for a server's device.
    pub fn options(&self) -> GpuOptions {
        GpuOptions { needs: Needs::Server, validation: self.validation, device_name: self.device.clone() }
    }
}

/// A reader of the name of one of these values, of which the help lists each with a line about it.
pub fn one_of<T, const N: usize>(
    all: [T; N],
    about: impl Fn(T) -> (&'static str, &'static str),
) -> impl TypedValueParser<Value = T>
where
    T: Copy + FromStr<Err: Debug> + Send + Sync + 'static,
{
    let value = |value| {
        let (name, about) = about(value);
        PossibleValue::new(name).help(about)
    };
    PossibleValuesParser::new(all.map(value)).map(|name| name.parse().expect("the name of one of them"))
}

fn of_skinning(skinning: Skinning) -> (&'static str, &'static str) {
    let about = match skinning {
        Skinning::PerVertexChain => {
            "The paper's: each vertex walks the whole parent chain of each of its bones"
        }
        Skinning::Palette => "Each bone once into a palette, then each vertex once",
        Skinning::Packed => "As palette, from compact vertices, each number of influences by itself",
    };
    (skinning.name(), about)
}

fn of_motion(motion: MotionOption) -> (&'static str, &'static str) {
    let about = match motion {
        MotionOption::Auto => {
            "Clips where there are any, poses where an application gives them, samples for the rest"
        }
        MotionOption::Clip => "Clips, whatever they take",
        MotionOption::Palette => "A transform a bone and grid step",
        MotionOption::Samples => "A position a vertex and grid step",
        MotionOption::Paper => "Three predicted positions a vertex with every update, as the paper does",
    };
    (motion.name(), about)
}
