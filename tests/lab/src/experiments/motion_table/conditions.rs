//! Conditions of the motion table: the kinds of motion, and the links.

use serde::Serialize;
use shadecast_scene::suggest::did_you_mean_or_list;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_transport::{LinkProfile, LinkSchedule};
use std::fmt;
use std::str::FromStr;

/// A way in which vertices move, by the name that the table has for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// As it is written.
    pub name: &'static str,
    /// What the server is told.
    pub option: MotionOption,
}

impl Serialize for Kind {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

/// All that the product has, a line each.
pub const KINDS: &[Kind] = &[
    Kind { name: "auto", option: MotionOption::Auto },
    Kind { name: "clip", option: MotionOption::Clip },
    Kind { name: "palette", option: MotionOption::Palette },
    Kind { name: "samples", option: MotionOption::Samples },
    Kind { name: "paper", option: MotionOption::Paper },
];

/// Links of which each table has a row: the issue's.
const CONDITIONS: [&str; 6] = [
    "latency=20ms,jitter=5ms,rate=100mbit",
    "latency=50ms,jitter=10ms,loss=1%,rate=100mbit",
    "latency=110ms,jitter=10ms,rate=100mbit",
    "latency=200ms,jitter=10ms,rate=100mbit",
    "latency=20ms,jitter=5ms,rate=100mbit,outage=3s",
    "latency=20ms,jitter=5ms,rate=100mbit,updates=2",
];

/// An outage begins so many nanoseconds after the link's first use: there is something on display.
const OUTAGE_START_NS: i64 = 2_000_000_000;
/// Updates that a server makes each second where nothing else is said.
const USUAL_UPDATES_HZ: f64 = 30.0;

/// A link, and how often the server makes an update at its end.
#[derive(Clone, Debug, PartialEq)]
pub struct Condition {
    text: String,
    /// The network.
    pub link: LinkSchedule,
    /// Updates a second.
    pub updates_hz: f64,
}

impl Condition {
    /// Those of each table.
    pub fn all() -> Vec<Self> {
        CONDITIONS.iter().map(|text| text.parse().expect("a test reads each of them")).collect()
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        KINDS.iter().find(|kind| kind.name == text).copied().ok_or_else(|| {
            let hint = did_you_mean_or_list(text, KINDS.iter().map(|kind| kind.name), "there are");
            format!("\"{text}\" is no kind of motion{hint}")
        })
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name)
    }
}

impl FromStr for Condition {
    type Err = String;

    /// A link as of `run`, with two keys more: `outage=3s` is silent for so long from 2 s on, `updates=2` is a server that makes
    /// so many updates a second.
    fn from_str(text: &str) -> Result<Self, String> {
        let (mut parts, mut outage_s, mut updates_hz) = (Vec::new(), None, USUAL_UPDATES_HZ);
        for part in text.split(',') {
            match part.trim().split_once('=') {
                Some(("outage", length)) => outage_s = Some(seconds(length)?),
                Some(("updates", rate)) => updates_hz = updates(rate)?,
                _ => parts.push(part.trim()),
            }
        }
        let profile = if parts.is_empty() { "none".to_owned() } else { parts.join(",") };
        let profile: LinkProfile = profile.parse().map_err(|error| format!("{error}"))?;
        let link = match outage_s {
            None => profile.into(),
            Some(length_s) => LinkSchedule::interrupted(profile, OUTAGE_START_NS, (length_s * 1e9) as i64),
        };
        Ok(Self { text: text.to_owned(), link, updates_hz })
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.text)
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let length_s = text.strip_suffix('s').and_then(|number| number.parse::<f64>().ok());
    length_s
        .filter(|length_s| (0.001..=60.0).contains(length_s))
        .ok_or_else(|| format!("outage={text}: write seconds from 0.001s to 60s, such as outage=3s"))
}

fn updates(text: &str) -> Result<f64, String> {
    let rate_hz = text.parse::<f64>().ok().filter(|rate_hz| (1.0..=1000.0).contains(rate_hz));
    rate_hz.ok_or_else(|| format!("updates={text}: write updates a second from 1 to 1000, such as updates=2"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_is_a_link_with_its_outage_and_its_updates() {
        let [plain, .., outage, slow] = CONDITIONS.map(|text| text.parse::<Condition>().expect("built in"));
        assert_eq!((plain.updates_hz, slow.updates_hz), (30.0, 2.0));
        assert_eq!((&plain.link, plain.to_string().as_str()), (&slow.link, CONDITIONS[0]));
        let is_silent = |at_s: f64| outage.link.at((at_s * 1e9) as i64).loss == 1.0;
        assert_eq!([0.0, 1.9, 2.0, 4.9, 5.0].map(is_silent), [false, false, true, true, false]);
        assert_eq!("updates=5".parse::<Condition>().expect("a link that is none").updates_hz, 5.0);
    }

    #[test]
    fn a_condition_that_is_none_is_refused_with_an_example() {
        for (text, words) in [
            ("outage=3", "outage=3s"),
            ("outage=0s", "outage=3s"),
            ("updates=nan", "updates=2"),
            ("updates=0", "updates=2"),
            ("latency=fast", "latency=20ms"),
            ("outrage=3s", "outrage"),
        ] {
            let error = text.parse::<Condition>().expect_err(text);
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn a_kind_that_is_none_is_refused_with_those_that_are() {
        KINDS.iter().for_each(|kind| assert_eq!(kind.name.parse(), Ok(*kind)));
        assert!("sample".parse::<Kind>().expect_err("none").contains("did you mean \"samples\"?"));
        assert!("x".parse::<Kind>().expect_err("none").contains("there are \"auto\""));
    }
}
