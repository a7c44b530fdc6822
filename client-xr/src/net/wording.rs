//! Short forms of terminal texts for the headset.

/// Hexadecimal digits of a fingerprint.
const FINGERPRINT_DIGITS: usize = 64;
/// Those of them that are shown: enough to compare by eye, a third of a row.
const SHOWN_DIGITS: usize = 12;

/// The same with fingerprints cut short.
pub(super) fn for_headset(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    let mut rest = text;
    while !rest.is_empty() {
        let digits = rest.bytes().take_while(u8::is_ascii_hexdigit).count();
        let others = rest[digits..].bytes().take_while(|byte| !byte.is_ascii_hexdigit()).count();
        let kept = if digits == FINGERPRINT_DIGITS { SHOWN_DIGITS } else { digits };
        shown.push_str(&rest[..kept]);
        shown.push_str(&rest[digits..digits + others]);
        rest = &rest[digits + others..];
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::stages::text::shown_lines;
    use shadecast_transport::{ExpectedIdentity, Fingerprint, KnownServers};
    use std::net::SocketAddr;
    use std::path::Path;

    #[test]
    fn fingerprints_are_cut_short_and_nothing_else_is() {
        let [expected, found] = ["a1".repeat(32), "0f".repeat(32)];
        assert_eq!(
            for_headset(&format!("né (expected {expected}, found {found})")),
            "né (expected a1a1a1a1a1a1, found 0f0f0f0f0f0f)"
        );
        for whole in ["", "faced", &"a".repeat(63), &"a".repeat(65), "é"] {
            assert_eq!(for_headset(whole), whole);
        }
    }

    /// What a headset shows of the words for a server that has another key, and what the user is to do.
    fn refusal(known: KnownServers, folder: &Path) -> (String, String) {
        let address: SocketAddr = "192.168.100.100:7400".parse().expect("an address");
        let key = |digit: &str| digit.repeat(64).parse::<Fingerprint>().expect("64 digits");
        let mut known = known;
        known.remember("the living room", address, key("a")).expect("pinned");
        let ExpectedIdentity::Pinned { fingerprint, remedy } = known.expected("the living room", address)
        else {
            panic!("it is known")
        };
        // As the transport says it; its own test holds that the remedy comes first.
        let said = format!(
            "{address}: another identity than expected: {remedy} (expected {fingerprint}, found {})",
            key("b")
        );
        let at_home =
            |text: &str| text.replace(&folder.display().to_string(), "/home/somebody/.config/shadecast");
        let shown: String = shown_lines(for_headset(&at_home(&said)).lines()).collect();
        (shown.replace(' ', ""), at_home(&remedy).replace(' ', ""))
    }

    #[test]
    fn the_identity_remedy_fits_a_headsets_rows() {
        let folder = tempfile::tempdir().expect("a folder");
        let load = || KnownServers::load(folder.path()).expect("a list");
        let (shown, remedy) = refusal(load(), folder.path());
        assert!(remedy.contains("known_servers.toml") && shown.contains(&remedy), "{remedy} in {shown}");
        let on_android = "clear this app's data in the headset's settings, or run: adb shell pm clear org.shadecast.client";
        let (shown, remedy) = refusal(load().with_remedy(on_android), folder.path());
        assert!(
            remedy.contains("pmclearorg.shadecast.client") && shown.contains(&remedy),
            "{remedy} in {shown}"
        );
        assert!(
            shown.ends_with("(expectedaaaaaaaaaaaa,foundbbbbbbbbbbbb)"),
            "there is room for both keys: {shown}"
        );
    }
}
