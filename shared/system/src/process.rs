//! Processes: memory, and requests to end.

use std::io;
use std::process::{Child, Command};

/// Starts a program so that [`interrupt`] can ask it to end. A shell lets its background jobs ignore Ctrl-C, and children inherit that.
pub fn interruptible(command: &mut Command) -> &mut Command {
    #[cfg(unix)]
    // SAFETY: between fork and exec the child calls `signal` alone, which is async-signal-safe.
    unsafe {
        std::os::unix::process::CommandExt::pre_exec(command, || set_interrupt_action(libc::SIG_DFL));
    }
    #[cfg(windows)]
    {
        use windows_sys::Win32::System::Threading::CREATE_NEW_PROCESS_GROUP;
        std::os::windows::process::CommandExt::creation_flags(command, CREATE_NEW_PROCESS_GROUP);
    }
    command
}

/// Sets what this process does when it is interrupted.
#[cfg(unix)]
fn set_interrupt_action(action: libc::sighandler_t) -> io::Result<()> {
    // SAFETY: the callers set the default action, or none: no handler of ours runs.
    let failed = unsafe { libc::signal(libc::SIGINT, action) } == libc::SIG_ERR;
    if failed { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Asks a process to end, as Ctrl-C does (on Windows Ctrl-Break, the only one that reaches one process alone).
///
/// # Errors
/// The process is gone, or is none of ours.
#[cfg(unix)]
pub fn interrupt(child: &Child) -> io::Result<()> {
    // SAFETY: a signal to a process; its number cannot be another's, since nobody has waited for the child.
    let failed = unsafe { libc::kill(child.id() as libc::pid_t, libc::SIGINT) } != 0;
    if failed { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// The same.
#[cfg(windows)]
pub fn interrupt(child: &Child) -> io::Result<()> {
    use windows_sys::Win32::System::Console::{CTRL_BREAK_EVENT, GenerateConsoleCtrlEvent};
    // SAFETY: an event for the process group that the child is the first of.
    let failed = unsafe { GenerateConsoleCtrlEvent(CTRL_BREAK_EVENT, child.id()) } == 0;
    if failed { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// A program that is put into the background and reads its terminal gets an error instead of being stopped.
pub fn read_terminal_in_foreground_alone() {
    #[cfg(unix)]
    // SAFETY: no handler of ours runs; the signal is ignored from now on.
    unsafe {
        libc::signal(libc::SIGTTIN, libc::SIG_IGN);
    }
}

/// What a shell shows for a program that Ctrl-C ended.
pub const INTERRUPTED: i32 = 130;

/// Ends this process, which somebody interrupts, without the clean-up of the libraries, which may wait for what hangs; files that are being written beside
/// their places go.
pub fn end_at_once() -> ! {
    crate::remove_pending_files();
    #[cfg(unix)]
    // SAFETY: ends the process; nothing runs after it that could see anything broken.
    unsafe {
        libc::_exit(INTERRUPTED)
    }
    #[cfg(windows)]
    // SAFETY: ends the process; nothing runs after it that could see anything broken.
    unsafe {
        windows_sys::Win32::System::Threading::TerminateProcess(
            windows_sys::Win32::System::Threading::GetCurrentProcess(),
            INTERRUPTED as u32,
        );
        std::process::abort() // not reached
    }
}

/// The resident memory of a process of this machine, bytes; `None` where the system does not tell.
#[cfg(unix)]
pub fn resident_bytes(pid: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    parse_resident_kib(&status).map(|kib| kib * 1024)
}

#[cfg(unix)]
fn parse_resident_kib(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.trim().strip_suffix("kB")?.trim().parse().ok()
}

/// The same: what the system calls its working set.
#[cfg(windows)]
pub fn resident_bytes(pid: u32) -> Option<u64> {
    use windows_sys::Win32::Foundation::CloseHandle;
    use windows_sys::Win32::System::ProcessStatus::{K32GetProcessMemoryInfo, PROCESS_MEMORY_COUNTERS};
    use windows_sys::Win32::System::Threading::{OpenProcess, PROCESS_QUERY_LIMITED_INFORMATION};
    // SAFETY: asks for a handle; null is told apart.
    let process = unsafe { OpenProcess(PROCESS_QUERY_LIMITED_INFORMATION, 0, pid) };
    if process.is_null() {
        return None;
    }
    let bytes = size_of::<PROCESS_MEMORY_COUNTERS>() as u32;
    let mut counters = PROCESS_MEMORY_COUNTERS { cb: bytes, ..Default::default() };
    // SAFETY: the handle is open, and `counters` is valid to write to for the length of the call.
    let known = unsafe { K32GetProcessMemoryInfo(process, &mut counters, bytes) } != 0;
    // SAFETY: it was opened above, and is not used again.
    unsafe { CloseHandle(process) };
    known.then_some(counters.WorkingSetSize as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_process_has_memory() {
        let own = resident_bytes(std::process::id()).expect("this process is there");
        assert!(own > 1 << 20, "{own}");
    }

    #[cfg(unix)]
    #[test]
    fn resident_memory_is_read_from_the_status_file() {
        let status = "Name:\tx\nVmPeak:\t  900 kB\nVmRSS:\t   52340 kB\nThreads:\t3\n";
        assert_eq!(parse_resident_kib(status), Some(52_340));
        assert_eq!(parse_resident_kib("Name:\tx\n"), None);
    }

    #[cfg(unix)]
    #[test]
    fn a_process_that_is_asked_to_end_ends() {
        let mut child = interruptible(Command::new("sleep").arg("60")).spawn().expect("it starts");
        interrupt(&child).expect("it is there");
        assert!(!child.wait().expect("it ends").success());
    }

    #[cfg(unix)]
    #[test]
    fn children_of_a_background_job_can_be_interrupted() {
        use std::os::unix::process::{CommandExt, ExitStatusExt};
        let mut command = Command::new("sleep");
        // SAFETY: between fork and exec the child calls `signal` alone, which is async-signal-safe.
        unsafe { command.arg("3").pre_exec(|| set_interrupt_action(libc::SIG_IGN)) };
        let mut child = interruptible(&mut command).spawn().expect("it starts");
        interrupt(&child).expect("it is there");
        assert_eq!(child.wait().expect("it ends").signal(), Some(libc::SIGINT));
    }
}
