//! A server's announcement, by a library for multicast DNS: probes, answers, goodbye.

use super::{FINGERPRINT_KEY, SERVICE};
use crate::identity::Fingerprint;
use mdns_sd::{IfKind, ServiceDaemon, ServiceInfo};
use std::net::SocketAddr;
use std::time::Duration;

/// How long leaving may take.
const FAREWELL: Duration = Duration::from_millis(300);

/// Stands as long as it lives.
pub struct Announcement {
    daemon: ServiceDaemon,
    full_name: String,
}

/// Why nobody will find the server by itself.
#[derive(Debug, thiserror::Error)]
#[error("the server cannot announce itself on the network ({0}): clients need its address")]
pub struct AnnounceError(#[from] mdns_sd::Error);

impl Announcement {
    /// Announces a server of this name that listens at `address`: on the networks where it can be reached, and no others.
    ///
    /// # Errors
    /// Multicast DNS cannot be spoken here.
    pub fn start(name: &str, address: SocketAddr, fingerprint: Fingerprint) -> Result<Self, AnnounceError> {
        let daemon = ServiceDaemon::new()?;
        let fingerprint = fingerprint.to_string();
        let text = [(FINGERPRINT_KEY, fingerprint.as_str())];
        let (ty, host) = (format!("{SERVICE}.local."), format!("{}.local.", host_label(name)));
        let ip = address.ip();
        let info = if ip.is_unspecified() {
            if ip.is_ipv4() {
                daemon.disable_interface(IfKind::IPv6)?;
            }
            ServiceInfo::new(&ty, name, &host, "", address.port(), &text[..])?.enable_addr_auto()
        } else {
            daemon.disable_interface(IfKind::All)?;
            daemon.enable_interface(IfKind::Addr(ip))?;
            ServiceInfo::new(&ty, name, &host, ip, address.port(), &text[..])?
        };
        let full_name = info.get_fullname().to_owned();
        daemon.register(info)?;
        Ok(Self { daemon, full_name })
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        // Who does not answer by then is gone anyway.
        if let Ok(left) = self.daemon.unregister(&self.full_name) {
            let _ = left.recv_timeout(FAREWELL);
        }
        if let Ok(ended) = self.daemon.shutdown() {
            let _ = ended.recv_timeout(FAREWELL);
        }
    }
}

/// A name for people as one for machines: letters, digits and hyphens.
fn host_label(name: &str) -> String {
    let label: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let label: String = label.trim_matches('-').chars().take(40).collect();
    format!("shadecast-{}", if label.is_empty() { "server" } else { &label })
}
