//! Answers to wrong calls: an OpenXR code for the caller, one line on stderr, one more in the count of application errors.

use openxr_sys as xr;

use crate::{debug_utils, names, runtime};

/// Why a call is refused.
#[derive(Debug)]
pub(crate) struct Fault {
    pub(crate) code: xr::Result,
    message: String,
    blame: Blame,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Blame {
    /// The application broke a rule: counted and printed.
    Application,
    /// The runtime or the machine failed: printed.
    Runtime,
    /// A legitimate answer that happens to be an error code.
    Nobody,
}

/// Result of an entry point: a success code or a fault.
pub(crate) type CallResult<T = xr::Result> = Result<T, Fault>;

impl Fault {
    /// The application broke a rule.
    pub(crate) fn application(code: xr::Result, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), blame: Blame::Application }
    }

    /// Invalid use that has no code of its own.
    pub(crate) fn usage(message: impl Into<String>) -> Self {
        Self::application(xr::Result::ERROR_VALIDATION_FAILURE, message)
    }

    /// Something came too early, too late or twice.
    pub(crate) fn order(message: impl Into<String>) -> Self {
        Self::application(xr::Result::ERROR_CALL_ORDER_INVALID, message)
    }

    /// A handle that does not exist, or no longer.
    pub(crate) fn handle(kind: &str) -> Self {
        Self::application(
            xr::Result::ERROR_HANDLE_INVALID,
            format!("this {kind} handle does not exist (any more)"),
        )
    }

    /// The runtime or the machine failed.
    pub(crate) fn runtime(code: xr::Result, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), blame: Blame::Runtime }
    }

    /// Nobody's mistake.
    pub(crate) fn quiet(code: xr::Result) -> Self {
        Self { code, message: String::new(), blame: Blame::Nobody }
    }
}

/// Runs the body of the entry point `function`, and reports its fault where it has one.
/// The body must have let go of the runtime's lock when it returns.
pub(crate) fn guard(function: &'static str, body: impl FnOnce() -> CallResult) -> xr::Result {
    match body() {
        Ok(code) => code,
        Err(fault) => {
            report(function, &fault);
            fault.code
        }
    }
}

fn report(function: &'static str, fault: &Fault) {
    if fault.blame == Blame::Nobody {
        return;
    }
    let code = names::result(fault.code);
    eprintln!("shadecast-mock-runtime: {function}: {code}: {}", fault.message);
    let (messengers, labels) = {
        let mut runtime = runtime::lock();
        let messengers = runtime.instance.as_mut().map(|instance| {
            instance.core.tally.errors += u64::from(fault.blame == Blame::Application);
            instance.core.messengers.clone()
        });
        (messengers.unwrap_or_default(), runtime.labels())
    };
    debug_utils::deliver(messengers, &labels, function, &format!("{code}: {}", fault.message));
}
