use super::*;
use std::convert::Infallible;

const MS: i64 = 1_000_000;

/// A device that does one thing after the other, and an encoder a viewer, in virtual time.
#[derive(Default)]
struct Desk {
    now_ns: i64,
    flights: BTreeMap<u32, (Flight, i64)>,
    /// What visibility and shading of a viewer's updates take.
    device_ns: BTreeMap<u32, i64>,
    closed: Vec<u32>,
}

impl Situation<u32> for Desk {
    type Error = Infallible;

    fn flight(&mut self, viewer: u32) -> Result<Flight, Infallible> {
        let (mut flight, done_ns) = self.flights.get(&viewer).copied().unwrap_or_default();
        let is_done = done_ns <= self.now_ns;
        flight.is_seen = flight.is_begun && is_done;
        flight.is_shaded = flight.is_in_work && is_done;
        Ok(flight)
    }

    fn is_open(&mut self, viewer: u32, _: i64) -> bool {
        !self.closed.contains(&viewer)
    }
}

impl Desk {
    fn make(&mut self, viewer: u32, step: Step) {
        let took_ns = self.device_ns[&viewer] / 2;
        let (flight, done_ns) = self.flights.entry(viewer).or_default();
        match step {
            Step::Begin => (flight.is_begun, *done_ns) = (true, self.now_ns + took_ns),
            Step::Place => (flight.is_begun, flight.is_placed) = (false, true),
            Step::Shade => {
                (flight.is_placed, flight.is_in_work, *done_ns) = (false, true, self.now_ns + took_ns);
            }
            Step::Collect => flight.is_in_work = false,
            Step::Wait => unreachable!("nothing is made while there is nothing to make"),
        }
    }
}

/// What happened, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Done {
    Made(u32, Step),
    /// What an update took, once it is collected.
    Cost(u32, UpdateCost),
    HandedOver(u32),
}

/// Plays viewers whose updates take so long on the device, with encoders that take `encode_ns`.
fn play(viewers_ns: &[i64], closed: &[u32], encode_ns: i64, for_ns: i64) -> Vec<(i64, Done)> {
    let mut scheduler = Scheduler::new(33 * MS);
    let mut desk = Desk { closed: closed.to_vec(), ..Desk::default() };
    for (viewer, device_ns) in (0..).zip(viewers_ns) {
        desk.device_ns.insert(viewer, *device_ns);
        scheduler.join(viewer, 0);
    }
    let mut encoding: BTreeMap<u32, i64> = BTreeMap::new();
    let mut done = Vec::new();
    while desk.now_ns < for_ns {
        let now_ns = desk.now_ns;
        for (viewer, _) in encoding.extract_if(.., |_, done_ns| *done_ns <= now_ns) {
            scheduler.encoded(viewer, Some(encode_ns));
        }
        let Ok(action) = scheduler.poll(now_ns, &mut desk);
        match action {
            Action::Make(viewer, step) => {
                desk.make(viewer, step);
                let device_ns = (step == Step::Collect).then(|| desk.device_ns[&viewer]);
                let cost = scheduler.completed((viewer, step), 0, device_ns, now_ns);
                done.push((now_ns, Done::Made(viewer, step)));
                done.extend(cost.map(|cost| (now_ns, Done::Cost(viewer, cost))));
            }
            Action::HandOver(viewer) => {
                assert!(encoding.insert(viewer, now_ns + encode_ns).is_none(), "the encoder is busy");
                scheduler.handed_over(viewer, now_ns);
                done.push((now_ns, Done::HandedOver(viewer)));
            }
            Action::AwaitDevice(..) | Action::Sleep(_) => desk.now_ns += MS / 2,
        }
    }
    done
}

fn begins(done: &[(i64, Done)], of: u32) -> Vec<i64> {
    done.iter().filter(|(_, what)| *what == Done::Made(of, Step::Begin)).map(|(at_ns, _)| *at_ns).collect()
}

#[test]
fn a_lone_viewer_has_an_update_in_each_period() {
    let begun = begins(&play(&[10 * MS], &[], 5 * MS, 1000 * MS), 0);
    assert!((30..=31).contains(&begun.len()), "{begun:?}");
    assert!(begun.windows(2).all(|pair| (pair[1] - pair[0] - 33 * MS).abs() <= MS), "{begun:?}");
}

#[test]
fn viewers_share_the_device_whatever_their_updates_take() {
    let done = play(&[20 * MS, 20 * MS, 80 * MS], &[], 5 * MS, 20_000 * MS);
    let had_ms = [(0, 20), (1, 20), (2, 80)].map(|(viewer, ms)| begins(&done, viewer).len() as i64 * ms);
    let (least, most) = (had_ms.iter().min().unwrap(), had_ms.iter().max().unwrap());
    assert!(most - least <= 2 * 80 + 50, "{had_ms:?}");
}

#[test]
fn updates_of_two_viewers_are_never_in_flight_together() {
    let mut in_flight = None;
    for (at_ns, what) in play(&[20 * MS, 30 * MS], &[], 40 * MS, 5000 * MS) {
        match what {
            Done::Made(viewer, Step::Begin) => {
                assert_eq!(in_flight.replace(viewer), None, "at {at_ns} ns");
            }
            Done::Made(viewer, Step::Collect) => assert_eq!(in_flight.take(), Some(viewer), "at {at_ns} ns"),
            Done::Made(viewer, _) => assert_eq!(in_flight, Some(viewer), "at {at_ns} ns"),
            Done::Cost(..) | Done::HandedOver(_) => {}
        }
    }
}

#[test]
fn a_closed_link_holds_up_its_viewer_alone() {
    let done = play(&[10 * MS, 10 * MS], &[1], 5 * MS, 1000 * MS);
    assert!(begins(&done, 1).is_empty() && begins(&done, 0).len() >= 30);
}

#[test]
fn a_slow_encoder_paces_its_viewer_and_no_update_is_left_out() {
    let done = play(&[10 * MS], &[], 60 * MS, 6000 * MS);
    let begun = begins(&done, 0);
    assert!((98..=101).contains(&begun.len()), "{}", begun.len());
    let mut waiting = 0;
    for (_, what) in done {
        waiting += i32::from(what == Done::Made(0, Step::Collect)) - i32::from(what == Done::HandedOver(0));
        assert!((0..=1).contains(&waiting));
    }
}

/// Times from one update of viewer 0 to its next, as they are reported, milliseconds.
fn apart_ms(done: &[(i64, Done)]) -> Vec<Option<i64>> {
    let apart = done.iter().filter_map(|(_, what)| match what {
        Done::Cost(0, cost) => Some(cost.apart_ns.map(|apart_ns| apart_ns / MS)),
        _ => None,
    });
    apart.skip(8).collect()
}

#[test]
fn how_far_updates_are_apart_counts_where_this_machine_is_the_bound() {
    // The device takes 40 ms, the encoder 90: updates are as far apart as the encoder says, and cost less.
    let slow = apart_ms(&play(&[40 * MS], &[], 90 * MS, 4000 * MS));
    assert!(slow.iter().all(|apart| apart.is_some_and(|ms| (85..=95).contains(&ms))), "{slow:?}");
    let fast = apart_ms(&play(&[10 * MS], &[], 5 * MS, 2000 * MS));
    assert!(fast.iter().all(Option::is_none), "a period holds them back: {fast:?}");
    let shared = apart_ms(&play(&[40 * MS, 40 * MS], &[], 5 * MS, 4000 * MS));
    assert!(shared.iter().flatten().all(|ms| (75..=85).contains(ms)), "{shared:?}");
}

#[test]
fn nothing_is_begun_while_no_one_watches_and_an_update_is_due_when_someone_does() {
    let mut scheduler = Scheduler::new(33 * MS);
    let mut desk = Desk::default();
    scheduler.join(7, 0);
    scheduler.watch(7, false, 0);
    assert!(matches!(scheduler.poll(100 * MS, &mut desk), Ok(Action::Sleep(_))));
    scheduler.watch(7, true, 200 * MS);
    scheduler.watch(7, true, 201 * MS);
    assert_eq!(scheduler.poll(201 * MS, &mut desk), Ok(Action::Make(7, Step::Begin)));
}

#[test]
fn a_viewer_that_leaves_in_flight_holds_up_no_one() {
    let mut scheduler = Scheduler::new(33 * MS);
    let mut desk = Desk { device_ns: BTreeMap::from([(0, 10 * MS), (1, 10 * MS)]), ..Desk::default() };
    scheduler.join(0, 0);
    scheduler.join(1, 0);
    assert_eq!(scheduler.poll(0, &mut desk), Ok(Action::Make(0, Step::Begin)));
    desk.make(0, Step::Begin);
    scheduler.completed((0, Step::Begin), 0, None, 0);
    assert_eq!(scheduler.poll(0, &mut desk), Ok(Action::AwaitDevice(0, LONGEST_WAIT_NS)));
    scheduler.leave(0);
    assert_eq!(scheduler.poll(0, &mut desk), Ok(Action::Make(1, Step::Begin)));
}
