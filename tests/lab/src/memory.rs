//! The resident memory of processes, as Linux counts it.

/// Of a process of this machine, in units of 1024 bytes.
pub(crate) fn resident_kib(pid: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    parse_resident(&status)
}

fn parse_resident(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.trim().strip_suffix("kB")?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resident_memory_is_read_from_the_status_file() {
        let status = "Name:\tx\nVmPeak:\t  900 kB\nVmRSS:\t   52340 kB\nThreads:\t3\n";
        assert_eq!(parse_resident(status), Some(52_340));
        assert_eq!(parse_resident("Name:\tx\n"), None);
        let own = resident_kib(std::process::id()).expect("this process is there");
        assert!(own > 1 << 10, "{own}");
    }
}
