use super::*;
use crate::scene::gloss::{Brightness, Gloss, Seen, radians};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_protocol::pose::Pose;
use shadecast_scene::Material;

fn direction(rng: &mut SmallRng) -> Vec3 {
    loop {
        let way = Vec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0f32)));
        if (0.01..1.0).contains(&way.length_squared()) {
            return way.normalize();
        }
    }
}

fn light(rng: &mut SmallRng) -> StillLight {
    let mut color = |most: f32| Vec3::from_array(std::array::from_fn(|_| rng.random_range(0.0..most)));
    let sky = Sky { zenith: color(1.0), horizon: color(1.0), nadir: color(0.5) };
    let irradiance = color(4.0);
    StillLight { sky, to_sun: direction(rng), irradiance }
}

fn shine(rng: &mut SmallRng) -> Shine {
    let reflectance = if rng.random_bool(0.5) { 0.04 } else { rng.random_range(0.04..1.0) };
    Shine {
        roughness: rng.random_range(LEAST_ROUGHNESS..1.0),
        reflectance,
        diffuse: rng.random_range(0.0..1.0),
    }
}

/// A change of radiance that counts as none: one and a half steps of a display, in the dark.
const STAYS: f32 = 1.5 / 470.0;

/// Places of the facet, their normals by up to a tenth of a radian off: none that counts as unchanged changes by twice what is allowed,
/// and few by half as much again as is said.
#[test]
fn no_place_of_a_facet_changes_much_more_than_is_said() {
    let mut rng = SmallRng::seed_from_u64(9);
    let (mut tried, mut wrong, mut said_sum, mut found_sum) = (0, 0, 0.0, 0.0);
    for case in 0..4000 {
        let (light, shine) = (light(&mut rng), shine(&mut rng));
        let normal = direction(&mut rng);
        let facet = Facet { centre: direction(&mut rng), radius_m: rng.random_range(0.01..0.3), normal };
        let mut eye = || facet.centre + direction(&mut rng) * 2.5;
        let then = eye();
        let now = then + (eye() - then) * 0.2;
        if (then - facet.centre).dot(normal) * (now - facet.centre).dot(normal) <= 0.0 {
            continue; // it turns its other side, which is another rule's
        }
        let Some(said) = shine.change(&light, &facet, [then, now]) else { continue };
        let side = normal * (then - facet.centre).dot(normal).signum();
        let mut worst = 0.0f32;
        for _ in 0..20 {
            let at = facet.centre + direction(&mut rng).reject_from_normalized(side) * facet.radius_m;
            let normal = (side + 0.1 * direction(&mut rng)).normalize();
            let [a, b] = [then, now].map(|eye| shine.radiance(&light, normal, (eye - at).normalize()));
            worst = worst.max((a - b).abs().max_element());
        }
        assert!(said > STAYS || worst < 2.0 * STAYS, "seed 9, case {case}: {worst} for {said}, {shine:?}");
        wrong += usize::from(worst > 1.5 * said + 0.001);
        (tried, said_sum, found_sum) = (tried + 1, said_sum + said, found_sum + worst);
    }
    assert!(50 * wrong < tried, "{wrong} of {tried} by more than half");
    assert!(tried > 1000 && said_sum < 2.0 * found_sum, "{tried}: {said_sum} said, {found_sum} found");
}

#[test]
fn a_rough_wall_under_a_sky_changes_many_times_less_than_its_bound() {
    let sky = Sky { zenith: Vec3::splat(0.8), horizon: Vec3::splat(1.0), nadir: Vec3::splat(0.3) };
    let light =
        StillLight { sky, to_sun: Vec3::new(0.3, 0.9, 0.3).normalize(), irradiance: Vec3::splat(3.0) };
    let material = Material { roughness: 0.8, metallic: 0.0, ..Material::default() };
    let gloss = Gloss::of(&material, &[], Brightness { direct: 3.0, lamps: 0.0, sky: 1.0 });
    let facet = Facet { centre: Vec3::new(0.0, 1.2, -2.5), radius_m: 0.1, normal: Vec3::Z };
    let eyes = [Vec3::new(0.0, 1.6, 0.0), Vec3::new(0.6, 1.6, 0.0)];
    let [then, now] = eyes.map(|position| {
        Seen::from(Pose { position, ..Pose::IDENTITY }, facet.centre, facet.radius_m, Some(facet.normal))
    });
    let bound = gloss.mirrored_steps(&then, &now, 0.6);
    let steps = gloss.evaluated_steps(&light, &facet, eyes, radians(&then, &now, 0.6)).expect("a rough one");
    assert!(bound > 4.0 && steps < 0.4 * bound, "{steps} of {bound}");
}

#[test]
fn what_is_seen_from_too_near_or_is_too_smooth_is_not_evaluated() {
    let mut rng = SmallRng::seed_from_u64(1);
    let (light, shine) = (light(&mut rng), shine(&mut rng));
    let facet = Facet { centre: Vec3::ZERO, radius_m: 1.0, normal: Vec3::Z };
    assert_eq!(shine.change(&light, &facet, [Vec3::Z, Vec3::new(0.1, 0.0, 1.0)]), None);
    let smooth = Material { roughness: 0.3, ..Material::default() };
    assert_eq!(Gloss::of(&smooth, &[], Brightness { direct: 1.0, lamps: 0.0, sky: 1.0 }).shine, None);
}
