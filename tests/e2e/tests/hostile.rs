//! Strangers attack a server, and a server attacks a client, in every way the lab knows, each for a second. Well-behaved peers
//! keep their picture. The long runs do the same for 20 s each, with the bars of the acceptance.

use shadecast_lab::hostile::attacks::ATTACKS;
use shadecast_lab::hostile::{Bars, ClientReport, HostileOptions, HostileReport, run};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Each test starts programs that need all of a small machine.
static MACHINE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    MACHINE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn attack(names: impl Iterator<Item = &'static str>) -> HostileReport {
    let options = HostileOptions {
        attacks: names.map(str::to_owned).collect(),
        always_alone: false,
        bars: Bars::LOADED,
        verbose: true,
        ..HostileOptions::all(1.0)
    };
    run(&options).unwrap()
}

#[track_caller]
fn assert_good(report: &HostileReport) {
    for attack in &report.attacks {
        println!("{}: {:?} {}", attack.attack, attack.effort, attack.last_words);
    }
    assert_eq!(report.misses(), Vec::<String>::new());
}

#[test]
fn a_hostile_peer_disturbs_neither_served_nor_next_clients() {
    let _alone = alone();
    let report = attack(ATTACKS.iter().map(|attack| attack.name));
    assert_good(&report);
    for attack in &report.attacks {
        let effort = &attack.effort;
        assert!(effort.connections + effort.datagrams > 0, "{} did nothing: {effort:?}", attack.attack);
    }
    let of = |name: &str, while_serving: bool| {
        let found = report.attacks.iter().find(|it| it.attack == name && it.while_serving == while_serving);
        &found.unwrap_or_else(|| panic!("{name} was not made")).effort
    };
    // What the attackers are about needs a handshake, and where nobody else is served, an answer.
    for name in ["empty-messages", "small-messages", "holding"] {
        assert!(of(name, true).established > 0, "{name}: {:?}", of(name, true));
    }
    for name in ["hellos", "small-messages-after-hello", "reconnects", "streams"] {
        assert!(of(name, false).answered > 0, "{name}: {:?}", of(name, false));
    }
    assert!(of("half-open", true).datagrams >= 20, "{:?}", of("half-open", true));
}

#[test]
fn a_client_survives_any_server_and_shows_the_next_valid_one() {
    let _alone = alone();
    let report =
        attack(["far-pictures", "last-pictures", "hollow-deltas", "pongs", "broken-units"].into_iter());
    assert_good(&report);
    assert_eq!(report.client_attacks.len(), 5);
    for ClientReport { attack, sent, quiet_fps, .. } in &report.client_attacks {
        assert!(*sent > 0 && *quiet_fps > 0.0, "{attack}: {sent} sent, {quiet_fps} frames/s in peace");
    }
}
