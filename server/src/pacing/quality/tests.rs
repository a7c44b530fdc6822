use super::*;

const PERIOD_NS: i64 = 33_333_333;

/// An encoder of pictures of which so many bytes change at quantiser 22; what stands still costs bits once.
struct Scene {
    moving_bytes: f64,
    still_bytes: f64,
    still_qp: u8,
}

impl Scene {
    fn new(moving_bytes: f64, still_bytes: f64) -> Self {
        Self { moving_bytes, still_bytes, still_qp: 51 }
    }

    fn picture(&mut self, qp: u8) -> usize {
        let at = |bytes: f64, qp: u8| bytes * 2f64.powf((22.0 - f64::from(qp)) / 6.0);
        let still = (at(self.still_bytes, qp) - at(self.still_bytes, self.still_qp)).max(0.0);
        self.still_qp = self.still_qp.min(qp);
        (at(self.moving_bytes, qp) + still) as usize
    }
}

fn sent(stream_bytes: usize, encode_s: f64) -> SentPicture {
    SentPicture { stream_bytes, is_refresh: false, encode_s }
}

/// Bytes and quantiser of each picture of a scene, one an update.
fn run(quality: &mut Quality, scene: &mut Scene, pictures: usize) -> Vec<(usize, u8)> {
    let picture = |_| {
        let qp = quality.qp();
        let bytes = scene.picture(qp);
        note(quality, sent(bytes, 0.0));
        (bytes, qp)
    };
    (0..pictures).map(picture).collect()
}

/// A picture a period after what is known.
fn note(quality: &mut Quality, picture: SentPicture) {
    quality.note_picture(picture, quality.known_ns.unwrap_or(0) + PERIOD_NS);
}

fn quality() -> Quality {
    Quality::new(QualityOptions::default(), PERIOD_NS)
}

/// Mbit/s of the last second.
fn last_mbit_s(pictures: &[(usize, u8)]) -> f64 {
    pictures[pictures.len() - 30..].iter().map(|(bytes, _)| *bytes as f64 * 8e-6).sum()
}

#[test]
fn what_stands_still_gets_as_fine_as_it_gets_and_then_costs_nothing() {
    let pictures = run(&mut quality(), &mut Scene::new(0.0, 50_000.0), 60);
    assert_eq!(pictures[59], (0, FINEST_QP));
    assert!(pictures[2..].iter().all(|(bytes, _)| *bytes < 83_333));
}

#[test]
fn what_moves_takes_what_was_asked_for_and_swings_by_no_more_than_a_step() {
    for bytes in [50_000.0, 83_000.0, 120_000.0, 200_000.0] {
        let pictures = run(&mut quality(), &mut Scene::new(bytes, 0.0), 90);
        let mbit_s = last_mbit_s(&pictures);
        assert!((18.0..=20.2).contains(&mbit_s), "{bytes}: {mbit_s} Mbit/s");
        let last: Vec<u8> = pictures[60..].iter().map(|(_, qp)| *qp).collect();
        assert!(last.iter().max() <= last.iter().min().map(|qp| qp + 1).as_ref(), "{bytes}: {last:?}");
    }
}

#[test]
fn a_large_picture_is_followed_by_as_fine_ones_as_before() {
    let mut quality = quality();
    run(&mut quality, &mut Scene::new(83_000.0, 0.0), 60);
    let usual = quality.qp();
    note(&mut quality, sent(330_000, 0.0));
    assert_eq!(quality.qp(), COARSEST_QP);
    let pictures = run(&mut quality, &mut Scene::new(83_000.0, 0.0), 12);
    assert!(pictures.iter().position(|(_, qp)| *qp <= usual + 1) <= Some(8), "{usual}: {pictures:?}");
}

#[test]
fn no_picture_takes_three_times_what_it_may_since_the_one_before_took_little() {
    let (mut quality, mut scene) = (quality(), Scene::new(200_000.0, 0.0));
    run(&mut quality, &mut scene, 90);
    note(&mut quality, sent(0, 0.0));
    let bytes = scene.picture(quality.qp());
    assert!(bytes < 250_000, "{bytes}");
}

#[test]
fn bits_that_show_nothing_are_left() {
    for (bytes, qp) in [(20_000.0, FINEST_QP), (30_000.0, NEXT_QP), (40_000.0, NEXT_QP), (46_700.0, NEXT_QP)]
    {
        let pictures = run(&mut quality(), &mut Scene::new(bytes, 0.0), 90);
        assert!(pictures[60..].iter().all(|(_, of)| *of == qp), "{bytes}: {pictures:?}");
        assert!(last_mbit_s(&pictures) < 20.2, "{bytes}");
    }
}

#[test]
fn a_scene_that_begins_to_move_is_coded_coarsely_enough_with_its_second_picture() {
    let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
    run(&mut quality, &mut scene, 60);
    scene.moving_bytes = 60_000.0;
    let pictures = run(&mut quality, &mut scene, 3);
    // A fifth more than a period has: nothing was taken before.
    assert!(pictures[0].0 > 150_000 && pictures[1].0 <= 100_000, "{pictures:?}");
}

#[test]
fn geometry_and_motion_take_of_the_same_bits() {
    let (mut quality, mut scene) = (quality(), Scene::new(50_000.0, 0.0));
    let mut mbit = Vec::new();
    for update in 0..300 {
        // Nothing in the first second, then 5 to 15 Mbit/s, in turns of a second.
        let others = if update < 30 { 0 } else { 20_833 + 41_667 * usize::from(update / 30 % 2 == 0) };
        quality.note_other(others, update * PERIOD_NS);
        let bytes = others + run(&mut quality, &mut scene, 1)[0].0;
        mbit.push(bytes as f64 * 8e-6);
    }
    let seconds: Vec<f64> = mbit.chunks(30).map(|second| second.iter().sum()).collect();
    assert!(seconds.iter().all(|mbit| (13.0..=25.0).contains(mbit)), "{seconds:?}");
    let mean = seconds[1..].iter().sum::<f64>() / 9.0;
    assert!((18.5..=20.2).contains(&mean), "{seconds:?}");
}

#[test]
fn what_a_still_scene_leaves_makes_no_burst_and_a_flood_starves_nothing_for_long() {
    let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
    run(&mut quality, &mut scene, 300);
    scene.moving_bytes = 40_000.0;
    let pictures = run(&mut quality, &mut scene, 30);
    assert!(last_mbit_s(&pictures) < 25.0, "{pictures:?}");
    quality.note_other(5_000_000, quality.known_ns.unwrap_or(0));
    let pictures = run(&mut quality, &mut scene, 90);
    assert!(pictures.iter().all(|(bytes, _)| *bytes > 10_000), "{pictures:?}");
    assert!(last_mbit_s(&pictures) > 16.0, "{pictures:?}");
}

#[test]
fn a_slow_link_has_less_and_a_slow_encoder_is_given_nothing_finer() {
    let (mut quality, mut scene) = (quality(), Scene::new(10_000.0, 0.0));
    quality.note_link(Some(100_000.0));
    let (bytes, _) = run(&mut quality, &mut scene, 60)[59];
    assert!((7_000..=10_000).contains(&bytes), "{bytes}: ten pictures a second");
    let mut quality = Quality::new(QualityOptions::default(), PERIOD_NS);
    (0..4).for_each(|_| note(&mut quality, sent(10, 0.01)));
    assert_eq!(quality.qp(), FINEST_QP);
    (0..30).for_each(|_| note(&mut quality, sent(10, 0.03)));
    assert_eq!(quality.qp(), DEFAULT_QP);
}

#[test]
fn pictures_follow_the_link_where_no_number_is_given() {
    let mut quality = Quality::new(QualityOptions::Auto, PERIOD_NS);
    let mut scene = Scene::new(300_000.0, 0.0);
    for (link_mbit_s, taken) in [(None, 18.0..=20.2), (Some(60.0), 54.0..=60.6), (Some(400.0), 90.0..=101.1)]
    {
        quality.note_link(link_mbit_s.map(bytes_s));
        let mbit_s = last_mbit_s(&run(&mut quality, &mut scene, 90));
        assert!(taken.contains(&mbit_s), "{link_mbit_s:?}: {mbit_s} Mbit/s");
    }
}

#[test]
fn a_little_less_than_asked_makes_no_larger_pictures() {
    let mut quality = quality();
    quality.note_link(Some(bytes_s(18.0)));
    let mbit_s = last_mbit_s(&run(&mut quality, &mut Scene::new(200_000.0, 0.0), 90));
    assert!((16.0..=20.2).contains(&mbit_s), "{mbit_s} Mbit/s");
}

#[test]
fn bits_are_left_over_where_pictures_are_fine_and_time_where_updates_are_quick() {
    let mut quality = quality();
    note(&mut quality, SentPicture { is_refresh: true, ..sent(10, 0.0) });
    assert_eq!(quality.spare(), Spare::Short, "nothing is known of pictures that follow another");
    note(&mut quality, sent(70_000, 0.0));
    assert_eq!(quality.spare(), Spare::Enough);
    run(&mut quality, &mut Scene::new(10_000.0, 0.0), 30);
    assert_eq!(quality.spare(), Spare::Room);
    quality.note_update(0.03);
    assert_eq!(quality.spare(), Spare::Short, "updates take too long");
    quality.note_update(0.01);
    assert_eq!(quality.spare(), Spare::Room);
    run(&mut quality, &mut Scene::new(300_000.0, 0.0), 30);
    assert_eq!(quality.spare(), Spare::Short);
}

#[test]
fn a_constant_quantiser_stays_and_a_refresh_says_nothing() {
    let mut constant = Quality::new(QualityOptions::Constant(7), PERIOD_NS);
    run(&mut constant, &mut Scene::new(1e6, 0.0), 10);
    assert_eq!(constant.qp(), 7);
    let mut quality = quality();
    note(&mut quality, SentPicture { is_refresh: true, ..sent(10_000_000, 0.0) });
    assert_eq!(quality.qp(), DEFAULT_QP);
}

#[test]
fn a_refresh_begins_as_the_first_picture_did_and_then_gets_finer() {
    let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
    run(&mut quality, &mut scene, 60);
    assert_eq!(quality.qp(), FINEST_QP);
    assert_eq!(quality.refresh_qp(), DEFAULT_QP);
    scene.still_qp = 51;
    let bytes = scene.picture(DEFAULT_QP);
    assert!(bytes <= 50_000, "{bytes}");
    note(&mut quality, SentPicture { is_refresh: true, ..sent(bytes, 0.0) });
    let pictures = run(&mut quality, &mut scene, 30);
    assert_eq!(pictures[0].1, DEFAULT_QP);
    let steps = |pair: &[(usize, u8)]| pair[0].1.checked_sub(pair[1].1);
    assert!(
        pictures.windows(2).all(|pair| steps(pair) <= Some(MOST_FINER) && steps(pair).is_some()),
        "{pictures:?}"
    );
    assert_eq!(pictures[29], (0, FINEST_QP));
    let mut coarse = Quality { qp: COARSEST_QP, ..quality };
    assert_eq!(coarse.refresh_qp(), COARSEST_QP, "no finer than it is");
    let mut constant = Quality::new(QualityOptions::Constant(7), PERIOD_NS);
    assert_eq!(constant.refresh_qp(), 7);
}
