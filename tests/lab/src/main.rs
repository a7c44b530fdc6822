//! `shadecast-lab`: the program. Its command line is in `cli/`.

mod cli;

use shadecast_protocol::text::with_causes;
use std::io::IsTerminal;

/// Colour escapes are for terminals: not for files, and not for who sets NO_COLOR.
fn wants_colour() -> bool {
    let is_refused = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    std::io::stderr().is_terminal() && !is_refused
}

fn main() {
    use tracing_subscriber::layer::SubscriberExt;
    use tracing_subscriber::util::SubscriberInitExt;
    let filter = tracing_subscriber::filter::Targets::new().with_default(tracing::Level::WARN);
    let layer = tracing_subscriber::fmt::layer().with_ansi(wants_colour()).with_writer(std::io::stderr);
    tracing_subscriber::registry().with(layer).with(filter).init();
    if let Err(error) = cli::run() {
        eprintln!("error: {}", with_causes(error.as_ref()));
        std::process::exit(1);
    }
}
