//! Results of attacks, judged by bars.

use crate::hostile::attacks::Effort;
use serde::Serialize;
use std::fmt;

/// What is still good.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bars {
    /// Longest pause between two pictures of who was being served, milliseconds.
    pub pause_ms: u64,
    /// From the end of an attack to the first picture of who comes then, milliseconds.
    pub newcomer_ms: u64,
    /// Resident memory above that at the start, bytes.
    pub growth_bytes: u64,
    /// The same under an attack that is served as a viewer, and in a client.
    pub served_growth_bytes: u64,
    /// Longest pause between two display frames of a client, milliseconds.
    pub frame_pause_ms: u64,
    /// Display frames a second under attack, of those in peace.
    pub least_fps_share: f64,
    /// Pictures a second of who was being served, of those in peace; under an attack that takes a core of this machine, of those beside
    /// the control, which takes it too.
    pub least_picture_share: f64,
}

impl Bars {
    /// The acceptance's: 0.5 s, 2 s, 100 MB, 0.9 of the pictures; of a client 1 s and half of its frames. An attack that is served costs
    /// what a viewer costs: 200 MB.
    pub const STRICT: Self = Self {
        pause_ms: 500,
        newcomer_ms: 2000,
        growth_bytes: 100_000_000,
        served_growth_bytes: 200_000_000,
        frame_pause_ms: 1000,
        least_fps_share: 0.5,
        least_picture_share: 0.9,
    };
    /// For a machine that does other things too: times say little there, memory as much as ever.
    pub const LOADED: Self = Self {
        pause_ms: 6000,
        newcomer_ms: 30_000,
        frame_pause_ms: 6000,
        least_fps_share: 0.1,
        least_picture_share: 0.1,
        growth_bytes: 200_000_000,
        ..Self::STRICT
    };
}

/// One attack on a server.
#[derive(Clone, Debug, Serialize)]
pub struct AttackReport {
    /// The attack.
    pub attack: &'static str,
    /// What it does.
    pub what: &'static str,
    /// True where a lawful client was being served meanwhile; false where the attackers were alone with the server.
    pub while_serving: bool,
    /// Whether it takes a viewer's place.
    pub is_served: bool,
    /// What the attackers did.
    pub effort: Effort,
    /// Longest pause of the lawful client's pictures before the attack, over as long a time, milliseconds.
    pub quiet_pause_ms: Option<u64>,
    /// The same during the attack.
    pub attacked_pause_ms: Option<u64>,
    /// Pictures a second of the lawful client before the attack.
    pub quiet_per_s: Option<f64>,
    /// The same during the attack.
    pub attacked_per_s: Option<f64>,
    /// The same beside the control, for an attack that takes as much of this machine.
    pub control_per_s: Option<f64>,
    /// Why the lawful client lost its connection, each time that it did.
    pub losses: Vec<String>,
    /// From the coming of a lawful client, a quarter into the attack, to its first picture, milliseconds; `None`: none came,
    /// or none was to be served, or the attack was over before.
    pub arrival_ms: Option<u64>,
    /// True where one came that had to be served, and the attack lasted long enough to tell.
    pub arrival_counts: bool,
    /// From the attack's end to the first picture of a lawful client that comes then, milliseconds; `None`: never.
    pub newcomer_ms: Option<u64>,
    /// Whether the server was still there.
    pub survived: bool,
    /// Its last lines, where it was not.
    pub last_words: String,
    /// Resident memory before the attack, bytes.
    pub memory_before_bytes: u64,
    /// The most during the attack and until the newcomer was served, bytes.
    pub memory_peak_bytes: u64,
    /// Once the newcomer is served, bytes.
    pub memory_after_bytes: u64,
    /// What missed its bar, in words; empty: all is good.
    pub misses: Vec<String>,
}

/// One attack on a client.
#[derive(Clone, Debug, Serialize)]
pub struct ClientReport {
    /// The attack.
    pub attack: &'static str,
    /// What it does.
    pub what: &'static str,
    /// Streams and datagrams sent against the rules.
    pub sent: u64,
    /// Display frames a second before the attack.
    pub quiet_fps: f64,
    /// The same during the attack.
    pub attacked_fps: f64,
    /// Longest pause between two display frames during the attack, milliseconds.
    pub attacked_pause_ms: u64,
    /// From the attack's end until the client shows what a lawful server sends, milliseconds; `None`: never.
    pub back_ms: Option<u64>,
    /// Whether the client was still there.
    pub survived: bool,
    /// Its last lines, where it was not.
    pub last_words: String,
    /// Resident memory before the attack, bytes.
    pub memory_before_bytes: u64,
    /// The most until the lawful server's pictures were shown, bytes.
    pub memory_peak_bytes: u64,
    /// What missed its bar, in words; empty: all is good.
    pub misses: Vec<String>,
}

impl ClientReport {
    /// How much memory was added at worst, bytes.
    pub fn growth_bytes(&self) -> u64 {
        self.memory_peak_bytes.saturating_sub(self.memory_before_bytes)
    }

    /// Says what misses its bar.
    pub(crate) fn judge(&mut self, bars: &Bars) {
        let mut misses = Vec::new();
        if !self.survived {
            misses.push("the client ended".to_owned());
        }
        if self.attacked_fps < self.quiet_fps * bars.least_fps_share {
            misses.push(format!("{:.1} frames/s instead of {:.1}", self.attacked_fps, self.quiet_fps));
        }
        if self.attacked_pause_ms > bars.frame_pause_ms {
            let pause_ms = self.attacked_pause_ms;
            misses.push(format!("no frame for {pause_ms} ms; the bar is {} ms", bars.frame_pause_ms));
        }
        match self.back_ms {
            None => misses.push("a lawful server was not shown afterwards".to_owned()),
            Some(ms) if ms > bars.newcomer_ms => {
                misses.push(format!(
                    "a lawful server was shown after {ms} ms; the bar is {} ms",
                    bars.newcomer_ms
                ));
            }
            Some(_) => {}
        }
        misses.extend(growth_miss(self.growth_bytes(), bars.served_growth_bytes));
        self.misses = misses;
    }
}

impl fmt::Display for ClientReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = if self.misses.is_empty() { "good" } else { "BAD " };
        write!(
            f,
            "{verdict} {:<27} client  {:.1} frames/s (quiet {:.1}), pause {} ms, back after {}, memory {:+} MB of {} MB",
            self.attack,
            self.attacked_fps,
            self.quiet_fps,
            self.attacked_pause_ms,
            self.back_ms.map_or("-".to_owned(), |ms| format!("{ms} ms")),
            self.growth_bytes() / 1_000_000,
            self.memory_before_bytes / 1_000_000,
        )?;
        self.misses.iter().try_for_each(|miss| write!(f, "\n       {miss}"))
    }
}

fn growth_miss(growth_bytes: u64, most_bytes: u64) -> Option<String> {
    let megabytes = |bytes: u64| bytes / 1_000_000;
    (growth_bytes > most_bytes).then(|| {
        format!("{} MB more memory; the bar is {} MB", megabytes(growth_bytes), megabytes(most_bytes))
    })
}

/// All attacks.
#[derive(Clone, Debug, Serialize)]
pub struct HostileReport {
    /// Seconds that each lasted.
    pub seconds: f64,
    /// On the server, in the order in which they were made.
    pub attacks: Vec<AttackReport>,
    /// On the client, likewise.
    pub client_attacks: Vec<ClientReport>,
}

impl AttackReport {
    /// How much memory was added at worst, bytes.
    pub fn growth_bytes(&self) -> u64 {
        self.memory_peak_bytes.saturating_sub(self.memory_before_bytes)
    }

    /// Says what misses its bar.
    pub(crate) fn judge(&mut self, bars: &Bars) {
        let mut misses = Vec::new();
        if !self.survived {
            misses.push("the server ended".to_owned());
        }
        if let Some(reason) = self.losses.first() {
            misses.push(format!("the client that was served lost its connection: {reason}"));
        }
        if let Some(pause_ms) = self.attacked_pause_ms.filter(|pause_ms| *pause_ms > bars.pause_ms) {
            misses.push(format!("no picture for {pause_ms} ms; the bar is {} ms", bars.pause_ms));
        }
        let fair_per_s = self.control_per_s.or(self.quiet_per_s);
        if let (Some(fair), Some(attacked)) = (fair_per_s, self.attacked_per_s)
            && attacked < fair * bars.least_picture_share
        {
            misses.push(format!(
                "{attacked:.1} pictures/s instead of {fair:.1}; the bar is {:.2} of them",
                bars.least_picture_share
            ));
        }
        if self.arrival_counts && self.arrival_ms.is_none_or(|ms| ms > bars.newcomer_ms) {
            misses.push(match self.arrival_ms {
                Some(ms) => format!("who came meanwhile waited {ms} ms; the bar is {} ms", bars.newcomer_ms),
                None => "who came meanwhile was not served".to_owned(),
            });
        }
        match self.newcomer_ms {
            None => misses.push("who came afterwards was not served".to_owned()),
            Some(ms) if ms > bars.newcomer_ms => {
                misses
                    .push(format!("who came afterwards waited {ms} ms; the bar is {} ms", bars.newcomer_ms));
            }
            Some(_) => {}
        }
        let most_bytes = if self.is_served { bars.served_growth_bytes } else { bars.growth_bytes };
        misses.extend(growth_miss(self.growth_bytes(), most_bytes));
        self.misses = misses;
    }
}

impl HostileReport {
    /// What missed its bar, with the attack's name before it.
    pub fn misses(&self) -> Vec<String> {
        let line = |report: &AttackReport, miss: &String| {
            let place = if report.while_serving { "while serving" } else { "alone" };
            format!("{} ({place}): {miss}", report.attack)
        };
        let on_server = self.attacks.iter().flat_map(|it| it.misses.iter().map(move |miss| line(it, miss)));
        let line = |report: &ClientReport, miss: &String| format!("{} (client): {miss}", report.attack);
        let on_client =
            self.client_attacks.iter().flat_map(|it| it.misses.iter().map(move |miss| line(it, miss)));
        on_server.chain(on_client).collect()
    }
}

impl fmt::Display for AttackReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = if self.misses.is_empty() { "good" } else { "BAD " };
        let place = if self.while_serving { "serving" } else { "alone  " };
        let ms = |ms: Option<u64>| ms.map_or("-".to_owned(), |ms| format!("{ms} ms"));
        let rate = |per_s: Option<f64>| per_s.map_or("-".to_owned(), |per_s| format!("{per_s:.1}"));
        write!(
            f,
            "{verdict} {:<27} {place} pictures/s {:>5} (quiet {:>5}), pause {:>8} (quiet {:>8}), meanwhile {:>8}, newcomer {:>8}, memory {:+} MB of {} MB",
            self.attack,
            rate(self.attacked_per_s),
            rate(self.quiet_per_s),
            ms(self.attacked_pause_ms),
            ms(self.quiet_pause_ms),
            ms(self.arrival_ms),
            ms(self.newcomer_ms),
            self.growth_bytes() / 1_000_000,
            self.memory_before_bytes / 1_000_000,
        )?;
        self.misses.iter().try_for_each(|miss| write!(f, "\n       {miss}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> AttackReport {
        AttackReport {
            attack: "x",
            what: "",
            while_serving: true,
            is_served: false,
            effort: Effort::default(),
            quiet_pause_ms: Some(100),
            attacked_pause_ms: Some(500),
            quiet_per_s: Some(10.0),
            attacked_per_s: Some(9.0),
            control_per_s: None,
            losses: Vec::new(),
            arrival_ms: None,
            arrival_counts: false,
            newcomer_ms: Some(2000),
            survived: true,
            last_words: String::new(),
            memory_before_bytes: 100_000_000,
            memory_peak_bytes: 200_000_000,
            memory_after_bytes: 100_000_000,
            misses: Vec::new(),
        }
    }

    #[test]
    fn a_client_misses_its_bars_one_by_one() {
        let good = ClientReport {
            attack: "x",
            what: "",
            sent: 1,
            quiet_fps: 30.0,
            attacked_fps: 15.0,
            attacked_pause_ms: 1000,
            back_ms: Some(2000),
            survived: true,
            last_words: String::new(),
            memory_before_bytes: 0,
            memory_peak_bytes: 200_000_000,
            misses: Vec::new(),
        };
        let misses = |report: &ClientReport| {
            let mut report = report.clone();
            report.judge(&Bars::STRICT);
            report.misses.len()
        };
        assert_eq!(misses(&good), 0);
        assert_eq!(misses(&ClientReport { attacked_fps: 14.9, ..good.clone() }), 1);
        assert_eq!(misses(&ClientReport { attacked_pause_ms: 1001, ..good.clone() }), 1);
        assert_eq!(misses(&ClientReport { back_ms: Some(2001), ..good.clone() }), 1);
        assert_eq!(misses(&ClientReport { back_ms: None, ..good.clone() }), 1);
        assert_eq!(misses(&ClientReport { survived: false, ..good.clone() }), 1);
        assert_eq!(misses(&ClientReport { memory_peak_bytes: 200_000_001, ..good }), 1);
    }

    #[track_caller]
    fn assert_misses(change: impl FnOnce(&mut AttackReport), words: &str) {
        let mut report = good();
        change(&mut report);
        report.judge(&Bars::STRICT);
        assert_eq!(report.misses.len(), 1, "{:?}", report.misses);
        assert!(report.misses[0].contains(words), "{:?}", report.misses);
    }

    #[test]
    fn each_bar_is_missed_by_one_more_than_it() {
        let mut report = good();
        report.judge(&Bars::STRICT);
        assert!(report.misses.is_empty(), "{:?}", report.misses);
        assert_misses(|it| it.attacked_pause_ms = Some(501), "501 ms");
        assert_misses(|it| it.attacked_per_s = Some(8.9), "8.9 pictures/s instead of 10.0");
        assert_misses(|it| it.control_per_s = Some(10.1), "9.0 pictures/s instead of 10.1");
        assert_misses(|it| it.newcomer_ms = Some(2001), "2001 ms");
        assert_misses(|it| it.arrival_counts = true, "meanwhile");
        assert_misses(|it| it.newcomer_ms = None, "not served");
        assert_misses(|it| it.memory_peak_bytes += 1, "100 MB");
        assert_misses(|it| it.survived = false, "ended");
        assert_misses(|it| it.losses.push("gone".into()), "gone");
    }
}
