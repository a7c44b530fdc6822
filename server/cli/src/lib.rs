//! The parts of the server's command line that another program of the project uses: its arguments, and `inspect`.

pub mod arguments;
pub mod inspect;
