//! Scene files, good and bad.

use super::*;
use crate::{LightKind, Scene};
use glam::{Quat, Vec3};
use shadecast_dragon::BuiltIn;
use shadecast_model::limits::MAX_LIGHTS;

const GOOD: &str = r#"
[[model]]
name = "dragon"
file = "dragon"

[[model]]
name = "fox"
file = "models/Fox.glb"

[[instance]]
model = "dragon"
translation = [1, 2.5, -3]
rotation_euler_deg = [0, 90, 0]
scale = 2
time_shift_s = 0.5
speed = -1.5

[[instance]]
name = "my fox"
model = "fox"
clip = "Run"
matrix = [1, 0, 0, 0,  0, 1, 0, 0,  0, 0, 1, 0,  7, 8, 9, 1]

[sun]
direction = [0, 2, 0]
irradiance = [1, 1, 1]

[sky]
zenith = [0.1, 0.2, 0.3]

[ground]
size_m = 10

[stage]
position = [0, 0, 1]
yaw_deg = 180
"#;

#[track_caller]
fn message(text: &str) -> String {
    parse(text, "scene.toml").expect_err("a fault").to_string()
}

#[test]
fn everything_in_a_scene_file_arrives() {
    let scene = parse(GOOD, "scene.toml").expect("a good file");
    assert_eq!(scene.models[0].file, ModelFile::BuiltIn(BuiltIn::Dragon));
    assert_eq!(scene.models[1].file, ModelFile::Path("models/Fox.glb".into()));
    let [dragon, fox] = &scene.instances[..] else { panic!("two instances") };
    let front = dragon.world_from_model.transform_point3(Vec3::Z);
    assert!(front.abs_diff_eq(Vec3::new(3.0, 2.5, -3.0), 1e-5), "yaw turns +z to +x: {front}");
    assert_eq!((dragon.time_shift.seconds, dragon.speed, &dragon.clip), (0.5, -1.5, &ClipChoice::First));
    assert_eq!(fox.world_from_model.translation, glam::Vec3A::new(7.0, 8.0, 9.0));
    assert_eq!((fox.name.as_str(), &fox.clip), ("my fox", &ClipChoice::Named("Run".into(), 21)));
    assert_eq!((scene.sun.to_sun, scene.sun.irradiance), (Vec3::Y, Vec3::ONE));
    assert_eq!(scene.environment.zenith, Vec3::new(0.1, 0.2, 0.3));
    assert_eq!(scene.environment.horizon, default_light().1.horizon);
    assert_eq!(scene.ground_size_m, Some(10.0));
    assert!((scene.world_from_stage.orientation * Vec3::NEG_Z).abs_diff_eq(Vec3::Z, 1e-5));
}

#[test]
fn undefined_model_is_shown_with_its_line_and_a_suggestion() {
    let text = GOOD.replace("model = \"dragon\"\ntranslation", "model = \"dragn\"\ntranslation");
    assert_eq!(message(&text), "scene.toml:11: model \"dragn\" is not defined; did you mean \"dragon\"?");
}

#[test]
fn faults_are_shown_where_they_stand() {
    let cases = [
        (
            "time_shift_s = 0.5",
            "time_shft_s = 0.5",
            "scene.toml:15: instance has no \"time_shft_s\"; did you mean \"time_shift_s\"?",
        ),
        ("[sky]", "[skyy]", "scene.toml:28: a scene has no \"skyy\"; did you mean \"sky\"?"),
        (
            "scale = 2",
            "scale = \"big\"",
            "scene.toml:14: \"scale\" of instance must be a finite number, not string",
        ),
        (
            "scale = 2",
            "scale = inf",
            "scene.toml:14: \"scale\" of instance must be a finite number, not float",
        ),
        (
            "scale = 2",
            "scale = 0",
            "scene.toml:14: \"scale\" scales the model to 0 or beyond the range of numbers",
        ),
        (
            "scale = 2",
            "scale = [1, -1, 1]",
            "scene.toml:14: \"scale\" mirrors the model; mirror the asset instead",
        ),
        (
            "[1, 2.5, -3]",
            "[1, 2.5]",
            "scene.toml:12: \"translation\" of instance has 2 numbers; it must have 3",
        ),
        (
            "name = \"fox\"",
            "name = \"dragon\"",
            "scene.toml:7: two models have the name \"dragon\"; rename one",
        ),
        ("file = \"dragon\"", "", "scene.toml:2: model needs \"file\""),
        (
            "direction = [0, 2, 0]",
            "direction = [0, 0, 0]",
            "scene.toml:25: \"direction\" has no length; it is the vector towards the sun",
        ),
        ("size_m = 10", "size_m = 1000", "scene.toml:32: \"size_m\" must be from 1 to 100 metres"),
        (
            "clip = \"Run\"",
            "clip = \"Run\"\nscale = 3",
            "scene.toml:23: \"matrix\" cannot be combined with translation, rotation_euler_deg or scale",
        ),
        ("[0.1, 0.2, 0.3]", "[0.1, -0.2, 0.3]", "scene.toml:29: \"zenith\" cannot be negative"),
    ];
    for (good, bad, expected) in cases {
        assert!(GOOD.contains(good), "{good}");
        assert_eq!(message(&GOOD.replacen(good, bad, 1)), expected, "{bad}");
    }
}

#[test]
fn row_major_matrix_is_noticed() {
    let text = GOOD.replace("7, 8, 9, 1]", "0, 0, 0, 1]").replace("[1, 0, 0, 0,", "[1, 0, 0, 7,");
    assert!(message(&text).contains("columns come first"), "{}", message(&text));
}

#[test]
fn syntax_errors_name_their_line() {
    let text = GOOD.replace("scale = 2", "scale = = 2");
    assert!(message(&text).starts_with("scene.toml:14: "), "{}", message(&text));
}

#[test]
fn scene_that_shows_nothing_is_refused() {
    assert!(message("").contains("no [[instance]]"));
    assert!(message("model = 3").contains("write [[model]]"), "{}", message("model = 3"));
}

#[test]
fn two_names_of_one_table_are_refused() {
    assert!(message(&format!("{GOOD}\n[environment]\nzenith = [0, 0, 0]")).contains("are synonyms"));
    assert!(parse(&GOOD.replace("[sky]", "[environment]"), "scene.toml").is_ok());
}

#[test]
fn old_name_of_the_stage_is_explained() {
    let text = GOOD.replace("[stage]", "[camera]");
    assert!(message(&text).starts_with("scene.toml:34: where the user starts is now called [stage]; "));
}

#[test]
fn sun_casts_shadows_unless_told_otherwise() {
    let shadows = |text: &str| parse(text, "scene.toml").expect("a good file").sun.casts_shadows;
    assert!(shadows(GOOD));
    assert!(!shadows(&GOOD.replace("[sun]", "[sun]\nshadows = false")));
}

// ---- what moves, shines and looks ----

const RICH: &str = r#"
[[model]]
name = "dragon"
file = "dragon"

[[path]]
name = "round"
interpolation = "cubic"
repetition = "ping-pong"
time_shift_s = 1
speed = 2
  [[path.key]]
  time_s = 0
  translation = [0, 0, 0]
  rotation_euler_deg = [0, 0, 0]
  [[path.key]]
  time_s = 1
  translation = [1, 0, 0]
  scale = 2
  [[path.key]]
  time_s = 3
  translation = [1, 2, 0]
  rotation_quaternion = [0, 1, 0, 0]

[[instance]]
model = "dragon"
path = "round"
path_time_shift_s = 0.5
repetition = "once"
casts_shadow = false

[[instance]]
model = "dragon"
path = { key = [{ time_s = 2, translation = [0, 5, 0] }] }

[[grid]]
model = "dragon"
name = "cell"
count = [2, 1, 3]
spacing = [2, 0, -1]
center = [0, 1, -5]
scale = 0.5
time_shift_s = 1
time_shifts_s = [0, 0.25]
path = "round"
path_time_shift_step_s = 0.1

[[light]]
kind = "spot"
name = "lamp"
color = [1, 0.5, 0]
intensity = 4
position = [0, 3, 0]
target = [0, 0, 0]
outer_cone_deg = 30
range_m = 8

[[light]]
kind = "directional"
direction = [1, 0, 0]

[[camera]]
name = "side"
position = [4, 1, 0]
look_at = [0, 1, 0]
fov_deg = 60

[[head_path]]
name = "nod"
repetition = "once"
  [[head_path.key]]
  time_s = 0
  position = [0, 1.7, 0]
  pitch_deg = 0
  [[head_path.key]]
  time_s = 2
  pitch_deg = -40
"#;

#[test]
fn everything_that_moves_shines_and_looks_arrives() {
    let scene = parse(RICH, "scene.toml").expect("a good file");
    let [still, own, cells @ ..] = &scene.instances[..] else { panic!("two instances and a grid") };
    let path = still.path.as_ref().expect("a path");
    assert_eq!((path.repetition, path.time_shift_s, path.speed), (Repetition::PingPong, 1.5, 2.0));
    assert_eq!((still.repetition, still.casts_shadow), (Repetition::Once, false));
    let raised = own.path.as_ref().expect("a path").transform(17.0).translation;
    assert_eq!(Vec3::from(raised), Vec3::new(0.0, 5.0, 0.0), "one key holds for ever");
    assert_eq!(cells.len(), 6);

    let [lamp, beam] = &scene.lights[..] else { panic!("two lights") };
    assert_eq!((lamp.light.name.as_str(), lamp.light.intensity), ("lamp", Vec3::new(4.0, 2.0, 0.0)));
    assert_eq!(lamp.light.range_m, Some(8.0));
    let outer_cone_rad = 30f32.to_radians();
    assert_eq!(lamp.light.kind, LightKind::Spot { inner_cone_rad: 0.0, outer_cone_rad });
    let shines = |light: &PlacedLight| light.world_from_light.transform_vector3(Vec3::NEG_Z);
    assert!(shines(lamp).abs_diff_eq(Vec3::NEG_Y, 1e-6) && shines(beam).abs_diff_eq(Vec3::X, 1e-6));
    assert_eq!(lamp.world_from_light.translation, glam::Vec3A::new(0.0, 3.0, 0.0));
    assert_eq!(beam.light.kind, LightKind::Directional);

    let camera = &scene.cameras[0];
    assert_eq!((camera.name.as_str(), camera.fov_deg), ("side", 60.0));
    assert!((camera.stage_from_eye.orientation * Vec3::NEG_Z).abs_diff_eq(Vec3::NEG_X, 1e-6));
}

#[test]
fn grid_places_each_instance_once_where_it_belongs() {
    let scene = parse(RICH, "scene.toml").expect("a good file");
    let found: Vec<(String, Vec3, f32)> = scene.instances[2..]
        .iter()
        .map(|cell| (cell.name.clone(), cell.world_from_model.translation.into(), cell.time_shift.seconds))
        .collect();
    let mut expected = Vec::new();
    for z in 0..3 {
        for x in 0..2 {
            let at = Vec3::new(-1.0 + 2.0 * x as f32, 1.0, -4.0 - z as f32);
            expected.push((format!("cell {x},0,{z}"), at, 1.0 + 0.25 * x as f32));
        }
    }
    assert_eq!(found, expected);
    let shifts = scene.instances[2..].iter().map(|cell| cell.path.as_ref().expect("shared").time_shift_s);
    for (index, shift_s) in shifts.enumerate() {
        assert!((shift_s - 1.0 - 0.1 * index as f32).abs() < 1e-5, "{index}: {shift_s}");
    }
    assert!(scene.instances[2..].iter().all(|cell| cell.world_from_model.matrix3.x_axis.length() == 0.5));
}

#[test]
fn grids_of_every_size_fill_their_box_evenly() {
    for count in [[1, 1, 1], [3, 1, 3], [4, 2, 5], [13, 1, 13]] {
        let [x, y, z] = count;
        let text = format!(
            "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[grid]]\nmodel = \"d\"\ncount = [{x}, {y}, {z}]\n\
             spacing = [1, 2, 3]\norigin = [10, 0, 0]\nyaw_jitter_deg = 30\ntime_shift_spread = true\n"
        );
        let scene = parse(&text, "s.toml").expect("good");
        let mut places: Vec<[i32; 3]> = Vec::new();
        for cell in &scene.instances {
            let at = Vec3::from(cell.world_from_model.translation) - Vec3::new(10.0, 0.0, 0.0);
            places.push((at / Vec3::new(1.0, 2.0, 3.0)).to_array().map(|place| place.round() as i32));
            let yaw_deg = (cell.world_from_model.matrix3.x_axis.x).acos().to_degrees();
            assert!(yaw_deg <= 30.01, "{yaw_deg}");
        }
        let mut expected: Vec<[i32; 3]> = cells(count).map(|cell| cell.map(|place| place as i32)).collect();
        assert_eq!(places, expected);
        expected.dedup();
        assert_eq!(expected.len() as u32, x * y * z);
        let mut shifts: Vec<f32> = scene.instances.iter().map(|cell| cell.time_shift.of_clip).collect();
        shifts.sort_by(f32::total_cmp);
        let most_apart = shifts.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f32::max);
        assert!(most_apart <= 3.0 / shifts.len() as f32, "{count:?}: a gap of {most_apart}");
    }
}

#[test]
fn spread_shifts_are_parts_of_what_the_clip_takes() {
    let shift = TimeShift { seconds: 1.0, of_clip: 0.5 };
    assert_eq!(shift.in_seconds(4.0, 1.0), 3.0);
    assert_eq!(shift.in_seconds(4.0, -2.0), 2.0, "twice as fast takes half as long");
    assert_eq!(shift.in_seconds(4.0, 0.0), 1.0);
}

#[test]
fn faults_of_the_rich_file_are_shown_where_they_stand() {
    let cases = [
        (
            "path = \"round\"\npath_time_shift_s",
            "path = \"ruond\"\npath_time_shift_s",
            "scene.toml:27: path \"ruond\" is not defined; did you mean \"round\"?",
        ),
        (
            "path = \"round\"\npath_time_shift_s = 0.5",
            "path_time_shift_s = 0.5",
            "scene.toml:27: \"path_time_shift_s\" needs a \"path\" to shift",
        ),
        (
            "\"cubic\"",
            "\"cubik\"",
            "scene.toml:8: \"interpolation\" of path cannot be \"cubik\"; did you mean \"cubic\"?",
        ),
        (
            "\"ping-pong\"",
            "\"forever\"",
            "scene.toml:9: \"repetition\" of path cannot be \"forever\"; it can be \"once\", \"loop\", \"ping-pong\"",
        ),
        ("time_s = 3", "time_s = 1", "scene.toml:21: time 1 s is not after 1 s; sort the keys"),
        ("time_s = 3", "time_s = -3", "scene.toml:21: \"time_s\" must be from 0 to 86400 seconds"),
        (
            "  translation = [1, 0, 0]\n  scale = 2",
            "",
            "scene.toml:16: key has only a time; give it translation, rotation_euler_deg, \
             rotation_quaternion, scale",
        ),
        (
            "  translation = [1, 0, 0]",
            "  tranlation = [1, 0, 0]",
            "scene.toml:18: key has no \"tranlation\"; did you mean \"translation\"?",
        ),
        ("scale = 2", "scale = -2", "scene.toml:19: \"scale\" of a path must be above 0 and at most 1000"),
        (
            "[0, 1, 0, 0]",
            "[0, 1, 0, 1]",
            "scene.toml:23: \"rotation_quaternion\" has length 1.4142; it is x, y, z, w of length 1",
        ),
        (
            "rotation_quaternion = [0, 1, 0, 0]",
            "rotation_euler_deg = [0, 270, 0]",
            "scene.toml:20: turns by 270 degrees in one step, which is shown along the shorter arc; put keys \
             between, at most 179 degrees apart",
        ),
        ("[2, 1, 3]", "[2, 1.5, 3]", "scene.toml:39: \"count\" must be three whole numbers from 1 to 4095"),
        ("[2, 1, 3]", "[100, 1, 100]", "scene.toml:39: this makes 10002 instances; a scene can have 4095"),
        ("[2, 0, -1]", "[2, 0, 0]", "scene.toml:40: \"spacing\" is 0 along z: instances would coincide"),
        (
            "center = ",
            "origin = [0, 0, 0]\ncenter = ",
            "scene.toml:42: \"center\" cannot be combined with \"origin\"; keep one",
        ),
        (
            "time_shifts_s = [0, 0.25]",
            "time_shifts_s = []",
            "scene.toml:44: \"time_shifts_s\" is empty; give at least one number",
        ),
        (
            "kind = \"spot\"",
            "kind = \"spt\"",
            "scene.toml:49: \"kind\" of light cannot be \"spt\"; did you mean \"spot\"?",
        ),
        (
            "kind = \"spot\"",
            "kind = \"point\"",
            "scene.toml:55: a point light has no \"outer_cone_deg\"; remove it",
        ),
        (
            "outer_cone_deg = 30",
            "outer_cone_deg = 30\ninner_cone_deg = 40",
            "scene.toml:56: the inner cone of 40 degrees must be narrower than the outer one of 30",
        ),
        ("color = [1", "colour = [1", "scene.toml:51: light has no \"colour\"; did you mean \"color\"?"),
        (
            "intensity = 4",
            "intensity = -4",
            "scene.toml:52: \"intensity\" must be from 0 to 1000000 (linear)",
        ),
        ("fov_deg = 60", "fov_deg = 200", "scene.toml:66: \"fov_deg\" must be from 1 to 150 degrees"),
        ("position = [4, 1, 0]", "", "scene.toml:65: \"look_at\" needs \"position\"; add it"),
        (
            "fov_deg = 60",
            "yaw_deg = 60",
            "scene.toml:65: \"look_at\" cannot be combined with \"yaw_deg\"; keep one",
        ),
        (
            "  position = [0, 1.7, 0]\n",
            "",
            "scene.toml:68: head path \"nod\" has no position; give its keys a \"position\"",
        ),
        ("[4, 1, 0]", "[4e9, 1, 0]", "scene.toml:64: \"position\" lies more than 1000000 m away"),
    ];
    for (good, bad, expected) in cases {
        assert!(RICH.contains(good), "{good}");
        assert_eq!(message(&RICH.replacen(good, bad, 1)), expected, "{bad}");
    }
}

#[test]
fn too_many_lights_are_refused_at_the_first_that_is_too_many() {
    let lamp = "[[light]]\nkind = \"point\"\nposition = [0, 1, 0]\n";
    let scene = parse(&format!("{GOOD}{}", lamp.repeat(16)), "scene.toml").expect("sixteen lights");
    assert_eq!(scene.lights.len(), MAX_LIGHTS as usize);
    let line = GOOD.lines().count() + 16 * 3 + 1;
    let expected = format!("scene.toml:{line}: there are 17 lights; a scene can have 16");
    assert_eq!(message(&format!("{GOOD}{}", lamp.repeat(17))), expected);
}

// ---- paths ----

/// A path of these keys, given as TOML, by the interpolation and repetition.
#[track_caller]
fn path_of(way: &str, repetition: &str, keys: &str) -> Path {
    let text = format!(
        "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\n\
         path = {{ interpolation = \"{way}\", repetition = \"{repetition}\", key = [{keys}] }}\n"
    );
    parse(&text, "s.toml").expect("a good path").instances[0].path.clone().expect("a path")
}

fn translation(path: &Path, time_s: f64) -> Vec3 {
    path.transform(time_s).translation.into()
}

/// Time, place, degrees about x, y and z, scale.
type UnevenKey = (f64, Vec3, [f32; 3], f32);

/// Keys at uneven times, and their TOML.
fn uneven_keys() -> (Vec<UnevenKey>, String) {
    let keys: Vec<UnevenKey> = (0..12)
        .map(|key| {
            let at = key as f32;
            let place = Vec3::new((at * 1.7).sin() * 3.0, at * 0.3, (at * 0.9).cos());
            let turn = [(at * 0.7).sin() * 80.0, at * 95.0, (at * 1.3).cos() * 60.0];
            (f64::from(at * 0.5 + (at * 2.1).sin() * 0.2), place, turn, 1.0 + (at * 0.8).sin() * 0.4)
        })
        .collect();
    let text: Vec<String> = keys
        .iter()
        .map(|(time_s, place, turn, scale)| {
            let (place, turn) = (place.to_array(), turn);
            format!(
                "{{ time_s = {time_s}, translation = {place:?}, rotation_euler_deg = {turn:?}, scale = {scale} }}"
            )
        })
        .collect();
    (keys, text.join(", "))
}

#[test]
fn every_interpolation_of_a_path_hits_its_keys() {
    let (keys, text) = uneven_keys();
    for way in ["step", "linear", "cubic"] {
        let path = path_of(way, "once", &text);
        for (time_s, place, turn_deg, scale) in &keys {
            let found = path.transform(f64::from(*time_s as f32));
            let (size, rotation, at) = found.to_scale_rotation_translation();
            assert!(at.abs_diff_eq(*place, 1e-4), "{way} at {time_s}: {at}");
            assert!(size.abs_diff_eq(Vec3::splat(*scale), 1e-4), "{way} at {time_s}: {size}");
            let [x, y, z] = turn_deg.map(f32::to_radians);
            let turn = Quat::from_rotation_y(y) * Quat::from_rotation_x(x) * Quat::from_rotation_z(z);
            assert!(rotation.dot(turn).abs() > 1.0 - 1e-5, "{way} at {time_s}: {rotation}");
        }
    }
}

#[test]
fn cubic_path_of_even_keys_on_a_line_is_the_line() {
    let path = path_of(
        "cubic",
        "once",
        "{ time_s = 0, translation = [0, 0, 0] }, { time_s = 0.5, translation = [1, 2, 0] }, \
         { time_s = 2, translation = [4, 8, 0] }, { time_s = 3, translation = [6, 12, 0] }",
    );
    for step in 0..=30 {
        let t = step as f32 * 0.1;
        let at = translation(&path, f64::from(t));
        assert!(at.abs_diff_eq(Vec3::new(2.0 * t, 4.0 * t, 0.0), 1e-4), "{t}: {at}");
    }
}

/// Largest change of velocity of the translation between steps of 1 ms, metres per second.
fn largest_jolt(path: &Path, from_s: f64, to_s: f64) -> f32 {
    let steps = ((to_s - from_s) * 1000.0) as usize;
    let at: Vec<Vec3> = (0..steps).map(|step| translation(path, from_s + step as f64 * 1e-3)).collect();
    at.windows(3).map(|a| (a[2] - 2.0 * a[1] + a[0]).length() * 1000.0).fold(0.0, f32::max)
}

#[test]
fn cubic_loop_that_closes_runs_smoothly_through_its_start() {
    let circle: Vec<String> = (0..=8)
        .map(|key| {
            let angle = std::f32::consts::FRAC_PI_4 * (key % 8) as f32;
            let turn = 45 * key;
            format!(
                "{{ time_s = {key}, translation = [{}, 0, {}], rotation_euler_deg = [0, {turn}, 0] }}",
                angle.cos(),
                angle.sin()
            )
        })
        .collect();
    let circle = circle.join(", ");
    let (closed, open) = (path_of("cubic", "loop", &circle), path_of("cubic", "once", &circle));
    let around_the_seam = largest_jolt(&closed, 7.0, 9.0);
    assert!(around_the_seam <= largest_jolt(&closed, 3.0, 5.0) * 1.3 + 1e-3, "{around_the_seam}");
    assert!(translation(&open, 7.9).distance(translation(&closed, 7.9)) > 1e-4, "the open end is straight");
    for step in 0..160 {
        let time_s = f64::from(step) * 0.1;
        let (_, rotation, at) = closed.transform(time_s).to_scale_rotation_translation();
        assert!((at.length() - 1.0).abs() < 0.01, "{time_s}: {at}");
        let turn = Quat::from_rotation_y((time_s * 45.0).to_radians() as f32);
        assert!(rotation.angle_between(turn) < 0.02, "{time_s}: {rotation}");
    }
}

#[test]
fn keys_that_leave_a_channel_out_do_not_disturb_it() {
    let path = path_of(
        "linear",
        "once",
        "{ time_s = 0, translation = [0, 0, 0] }, { time_s = 1, scale = 3 }, { time_s = 2, translation = [4, 0, 0] }",
    );
    assert!(translation(&path, 1.0).abs_diff_eq(Vec3::new(2.0, 0.0, 0.0), 1e-6));
    assert_eq!(path.scale_range(), (3.0, 3.0));
    assert_eq!(path.clip.duration_s, 2.0);
}

#[test]
fn path_is_applied_after_the_placement_and_repeats_as_it_says() {
    let keys =
        "{ time_s = 0, rotation_euler_deg = [0, 0, 0] }, { time_s = 2, rotation_euler_deg = [0, 90, 0] }";
    let placement = Affine3A::from_translation(Vec3::X);
    let at = |repetition: &str, time_s: f64| -> Vec3 {
        let path = path_of("linear", repetition, keys);
        let instance = crate::Instance { placement, path: Some(path), ..crate::Instance::new("i", 0) };
        instance.world_from_model(time_s).translation.into()
    };
    let turned = |degrees: f32| Quat::from_rotation_y(degrees.to_radians()) * Vec3::X;
    for (repetition, time_s, degrees) in [
        ("once", 1.0, 45.0),
        ("once", 9.0, 90.0),
        ("once", -1.0, 0.0),
        ("loop", 3.0, 45.0),
        ("loop", 4.0, 0.0),
        ("ping-pong", 3.0, 45.0),
        ("ping-pong", 2.0, 90.0),
        ("ping-pong", 3.5, 22.5),
    ] {
        let found = at(repetition, time_s);
        assert!(found.abs_diff_eq(turned(degrees), 1e-4), "{repetition} at {time_s}: {found}");
    }
}

#[test]
fn smooth_scale_that_falls_to_nothing_between_keys_is_refused() {
    let key = |time_s: f32, scale: f32| format!("{{ time_s = {time_s}, scale = {scale} }}");
    let keys = [key(0.0, 9.0), key(1.0, 0.1), key(2.0, 0.1), key(3.0, 9.0)].join(", ");
    let text =
        |way: &str| format!("{GOOD}\n[[path]]\nname = \"p\"\ninterpolation = \"{way}\"\nkey = [{keys}]\n");
    assert!(message(&text("cubic")).contains("use linear interpolation"), "{}", message(&text("cubic")));
    assert!(parse(&text("linear"), "s.toml").is_ok());
}

// ---- cameras and head paths ----

fn viewed(text: &str) -> Scene {
    let SceneFile { sun, lights, environment, world_from_stage, cameras, head_paths, .. } =
        parse(text, "scene.toml").expect("a good file");
    Scene {
        models: Vec::new(),
        instances: Vec::new(),
        events: Vec::new(),
        sun,
        lights,
        environment,
        world_from_stage,
        cameras,
        head_paths,
    }
}

#[test]
fn cameras_and_head_paths_are_found_by_name_or_suggested() {
    let scene = viewed(RICH);
    assert_eq!(scene.camera("side").expect("defined").fov_deg, 60.0);
    let message = |error: SceneError| error.to_string();
    let camera = |name| message(scene.camera(name).expect_err("unknown"));
    assert_eq!(camera("sid"), "the scene has no camera \"sid\"; did you mean \"side\"?");
    assert_eq!(camera("overview"), "the scene has no camera \"overview\"; it has \"side\"");
    let walk = message(scene.head_path("wlak").expect_err("unknown"));
    assert_eq!(walk, "the scene has no head path \"wlak\"; did you mean \"walk\"?");
}

#[test]
fn head_path_moves_the_head_and_holds_what_a_key_leaves_out() {
    let scene = viewed(RICH);
    let nod = scene.head_path("nod").expect("defined");
    for (time_s, pitch_deg) in [(0.0, 0.0f32), (1.0, -20.0), (2.0, -40.0), (5.0, -40.0)] {
        let pose = nod.stage_from_head(time_s);
        assert_eq!(pose.position, Vec3::new(0.0, 1.7, 0.0));
        let expected = Quat::from_rotation_x(pitch_deg.to_radians());
        assert!(pose.orientation.angle_between(expected) < 1e-3, "{time_s}: {pose:?}");
    }
}

#[test]
fn every_scene_has_the_built_in_head_paths_and_can_replace_them() {
    let scene = viewed(GOOD);
    for (name, height_m) in [
        ("still", 1.6),
        ("turn", 1.6),
        ("walk", 1.6),
        ("stride", 1.6),
        ("sit", 1.2),
        ("peek", 1.6),
        ("abrupt", 1.6),
    ] {
        let path = scene.head_path(name).expect("built in");
        for step in 0..100 {
            let pose = path.stage_from_head(f64::from(step) * 0.1);
            assert!(pose.is_valid() && (pose.position.y - height_m).abs() < 0.03, "{name}: {pose:?}");
        }
    }
    assert!(scene.head_path("walk").expect("built in").stage_from_head(1.25).position.x > 0.4);
    let own = RICH.replace("name = \"nod\"", "name = \"walk\"");
    let scene = viewed(&own);
    assert_eq!(scene.head_paths.iter().filter(|path| path.name == "walk").count(), 1);
    assert_eq!(scene.head_path("walk").expect("own").stage_from_head(1.25).position.x, 0.0);
}

#[test]
fn a_stride_goes_a_metre_and_turns_ninety_degrees_a_second() {
    let scene = viewed(GOOD);
    let stride = scene.head_path("stride").expect("built in");
    for (from_s, to_s) in [(0.05, 0.3), (0.7, 1.3), (1.7, 1.9), (2.05, 2.3)] {
        let (from, to) = (stride.stage_from_head(from_s), stride.stage_from_head(to_s));
        let passed_s = (to_s - from_s) as f32;
        let speed_m_s = from.position.distance(to.position) / passed_s;
        let turn_deg_s = from.orientation.angle_between(to.orientation).to_degrees() / passed_s;
        assert!((speed_m_s - 1.0).abs() < 0.03, "{from_s}: {speed_m_s} m/s");
        assert!((turn_deg_s - 90.0).abs() < 3.0, "{from_s}: {turn_deg_s} degrees/s");
    }
}

#[test]
fn no_cut_of_a_scene_file_panics() {
    for text in [GOOD, RICH] {
        for end in (0..text.len()).step_by(7).filter(|end| text.is_char_boundary(*end)) {
            let _ = parse(&text[..end], "cut.toml");
        }
    }
}

#[test]
fn extreme_numbers_never_panic_nor_make_a_path_that_is_not_finite() {
    let numbers = ["1e38", "-1e38", "1e-38", "0", "-0.0", "nan", "inf", "9223372036854775807", "86399.99"];
    for (at, _) in RICH.match_indices("= ") {
        let rest = &RICH[at + 2..];
        let end = rest.find('\n').unwrap_or(rest.len());
        for number in numbers {
            for value in [number.to_owned(), format!("[{number}, {number}, {number}]")] {
                let text = format!("{}= {value}{}", &RICH[..at], &rest[end..]);
                let Ok(scene) = parse(&text, "odd.toml") else { continue };
                for path in scene.instances.iter().filter_map(|instance| instance.path.as_ref()) {
                    assert!(path.transform(0.7).is_finite(), "{text}");
                }
            }
        }
    }
}

// ---- events ----

const EVENTS: &str = r#"
[[model]]
name = "dragon"
file = "dragon"

[[instance]]
model = "dragon"
name = "near"
live = true

[[grid]]
model = "dragon"
name = "far"
count = [2, 1, 1]
spacing = [2, 0, 0]

[[event]]
at = 4.1
instance = "near"
clip = ""
seek = -0.5
fade = 0.25

[[event]]
at = 2
instance = "near"
pause = true

[[event]]
at = 2
instance = "far 1,0,0"
clip = "fly"
speed = -0.5
repetition = "once"
"#;

#[test]
fn events_arrive_in_order_of_time() {
    let file = parse(EVENTS, "scene.toml").expect("a good file");
    assert_eq!(file.instances.iter().map(|i| i.live).collect::<Vec<_>>(), [true, false, false]);
    let [pause, back, rest] = &file.events[..] else { panic!("three events") };
    assert_eq!((pause.at, pause.instance, &pause.clip), (WorldTime(2_000_000_000), 0, &None));
    assert_eq!(pause.change, Change { speed: Some(0.0), ..Change::default() });
    assert_eq!((back.instance, &back.clip), (2, &Some(ClipChoice::Named("fly".into(), 32))));
    let backwards = Change { speed: Some(-0.5), repetition: Some(Repetition::Once), ..Change::default() };
    assert_eq!(back.change, backwards);
    assert_eq!((rest.at, &rest.clip), (WorldTime(4_100_000_000), &Some(ClipChoice::Rest)));
    let sought = Change { local_s: Some(-0.5), fade_ns: 250_000_000, ..Change::default() };
    assert_eq!(rest.change, sought);
}

#[test]
fn faults_of_events_are_shown_where_they_stand() {
    let cases = [
        (
            "instance = \"near\"\nclip",
            "instance = \"nera\"\nclip",
            "scene.toml:19: instance \"nera\" is not defined; did you mean \"near\"?",
        ),
        ("seek = -0.5", "sek = -0.5", "scene.toml:21: event has no \"sek\"; did you mean \"seek\"?"),
        ("at = 4.1", "at = 0", "scene.toml:18: \"at\" must be from 0.001 to 86400 seconds"),
        ("at = 4.1", "", "scene.toml:17: event needs \"at\""),
        ("fade = 0.25", "fade = 61", "scene.toml:22: \"fade\" must be from 0 to 60 seconds"),
        (
            "pause = true",
            "pause = false",
            "scene.toml:27: \"pause\" can only be true; to go on, give \"speed\"",
        ),
        (
            "pause = true",
            "pause = true\nspeed = 2",
            "scene.toml:27: \"pause\" cannot be combined with \"speed\"; keep one",
        ),
        (
            "pause = true",
            "fade = 1",
            "scene.toml:24: event changes nothing; give it clip, speed, pause, seek, repetition",
        ),
        (
            "\"once\"",
            "\"onec\"",
            "scene.toml:34: \"repetition\" of event cannot be \"onec\"; did you mean \"once\"?",
        ),
        (
            "[[grid]]",
            "[[instance]]\nmodel = \"dragon\"\nname = \"near\"\n[[grid]]",
            "scene.toml:22: several instances have the name \"near\"; give each its own",
        ),
        (
            "at = 2\ninstance = \"near\"",
            "at = 4.2\ninstance = \"near\"",
            "scene.toml:25: at 4.200 s the instance's event of 4.100 s is not over before 4.350 s; put this one \
             there or later, or shorten the fade of that one",
        ),
        (
            "at = 2\ninstance = \"near\"",
            "at = 4.1\ninstance = \"near\"",
            "scene.toml:25: at 4.100 s the instance's event of 4.100 s is not over before 4.350 s; put this one \
             there or later, or shorten the fade of that one",
        ),
    ];
    for (from, to, expected) in cases {
        assert_eq!(EVENTS.matches(from).count(), 1, "{from}");
        assert_eq!(message(&EVENTS.replace(from, to)), expected, "{from} -> {to}");
    }
    let event = "[[event]]\nat = 1\ninstance = \"near\"\npause = true\n";
    let many = EVENTS.to_owned() + &event.repeat(4094);
    assert_eq!(message(&many), "scene.toml:16407: a scene can have at most 4096 events");
}
