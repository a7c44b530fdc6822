use super::*;
use crate::split::{SplitStats, split_long_edges};

fn shared_asset(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
    if path.is_file() {
        return Some(path);
    }
    eprintln!("SKIPPED: {} does not exist", path.display());
    None
}

/// Bounds of an instance in the world over its clip.
fn world_bounds(scene: &Scene, index: usize) -> (Vec3, Vec3) {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let duration_s = model.duration_s(instance.clip);
    let mut found = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for moment in 0..16 {
        let t_s = f64::from(duration_s) * f64::from(moment) / 16.0;
        for vertex in pose::source_skin(model, instance.clip, t_s, instance.world_from_model(0.0)) {
            found = (found.0.min(vertex.position), found.1.max(vertex.position));
        }
    }
    found
}

fn longest_edge_m(scene: &Scene, index: usize) -> f32 {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let skinned = pose::source_skin(model, None, 0.0, instance.world_from_model(0.0));
    let edges = model.indices.chunks_exact(3).flat_map(|triangle| {
        let [a, b, c] = [0, 1, 2].map(|corner| skinned[triangle[corner] as usize].position);
        [a.distance(b), b.distance(c), c.distance(a)]
    });
    edges.fold(0.0, f32::max)
}

#[test]
fn scene_arguments_are_understood() {
    let parse = |argument: &str| argument.parse::<SceneSource>();
    assert_eq!(parse("dragon").expect("good"), SceneSource::Dragons(1));
    assert_eq!(parse("dragons:9").expect("good"), SceneSource::Dragons(9));
    assert_eq!(parse("courtyard").expect("good"), SceneSource::Courtyard);
    assert_eq!(parse("dragons").expect("good"), SceneSource::default());
    assert_eq!(parse("dragons:3x1x2").expect("good"), SceneSource::DragonGrid([3, 1, 2]));
    assert_eq!(parse("a/b.glb").expect("good"), SceneSource::File("a/b.glb".into()));
    for bad in
        ["dragons:0", "dragons:x", "dragons:4000", "dragons:3x3", "dragons:0x1x1", "dragons:99x99x99", ""]
    {
        assert!(parse(bad).is_err(), "{bad}");
    }
    for source in ["courtyard", "dragon", "dragons:9", "dragons:13x1x13", "a/b.glb"] {
        assert_eq!(parse(source).expect("good").to_string(), source);
    }
}

#[test]
fn a_clip_of_an_event_is_one_of_its_instances_model() {
    let text = |clip: &str| {
        format!(
            "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\n\
             [[event]]\nat = 1\ninstance = \"d 0\"\nclip = \"{clip}\"\n"
        )
    };
    let own = scene_from_text(&text("fly"), "s.toml", Path::new("")).expect("a clip of the dragon");
    assert_eq!(own.events[0].change.clip, Some(Some(0)));
    let error = scene_from_text(&text("fyl"), "s.toml", Path::new("")).expect_err("no such clip");
    assert_eq!(error.to_string(), "s.toml:9: model \"d\" has no clip \"fyl\"; did you mean \"fly\"?");
}

#[test]
fn unknown_files_are_refused_with_advice() {
    let message = |path: &str| load_scene(&SceneSource::File(path.into())).expect_err(path).to_string();
    assert!(message("x.obj").contains("files of type .obj are not supported"), "{}", message("x.obj"));
    assert!(message("dragn").contains("did you mean \"dragon\"?"), "{}", message("dragn"));
    assert!(message("nowhere.glb").starts_with("nowhere.glb: cannot be read"), "{}", message("nowhere.glb"));
    assert!(
        message("nowhere.toml").starts_with("nowhere.toml: cannot be read"),
        "{}",
        message("nowhere.toml")
    );
}

#[test]
fn real_assets_stand_in_front_of_the_user_at_a_sensible_size() {
    for name in ["CesiumMan.glb", "Fox.glb", "DamagedHelmet.glb", "RiggedSimple.glb", "MorphStressTest.gltf"]
    {
        let Some(path) = shared_asset(name) else { return };
        let scene = load_scene(&SceneSource::File(path)).expect(name);
        let (low, high) = world_bounds(&scene, 0);
        let extent = (high - low).max_element();
        eprintln!("{name}: from {low:.2} to {high:.2}, clip {:?}", scene.instances[0].clip);
        assert!((0.85..=2.05).contains(&extent), "{name}: {extent} m");
        assert!(low.y.abs() < 0.02, "{name}: stands at {}", low.y);
        let middle = (low + high) * 0.5;
        assert!(middle.x.abs() < 0.05 && ASSET_DISTANCE_M.contains(&-middle.z), "{name}: {middle}");
        assert!(longest_edge_m(&scene, 0) <= MAX_EDGE_M * 1.01, "{name}");
        assert_eq!(scene.instances[1].name, "ground");
        assert_eq!(scene.instances[0].clip.is_some(), name != "DamagedHelmet.glb", "{name} moves");
    }
}

#[test]
fn assets_take_a_third_of_the_picture() {
    for name in ["CesiumMan.glb", "Fox.glb", "maya_kenney_character_7700_binary.fbx", "MorphStressTest.gltf"]
    {
        let Some(path) = shared_asset(name) else { return };
        let scene = load_scene(&SceneSource::File(path)).expect(name);
        let instance = &scene.instances[0];
        let model = &scene.models[0];
        let places = places_over_time(model, instance.clip, instance.placement);
        let (low, high, _) = seen_at_start(&places, 0.0).expect("in front");
        let part = (high.y - low.y) * 0.5;
        let widest = low.abs().max(high.abs()).max_element();
        eprintln!("{name}: {part:.3} of the height, {low} to {high}, {}", instance.placement.translation);
        assert!(part <= ASSET_PART_OF_HEIGHT + 0.005, "{name}: {part}");
        // What does not take a third would leave the picture if it did.
        assert!(part > ASSET_PART_OF_HEIGHT - 0.01 || widest > ASSET_PART_OF_SIDES - 0.02, "{name}: {part}");
        let walk = scene.head_path("walk").expect("every scene has it");
        for step in 0..20 {
            let eye_from_stage = walk.stage_from_head(f64::from(step) * 0.25).inverse().affine();
            let is_seen = |place: &&Vec3| {
                let at = eye_from_stage.transform_point3(**place);
                at.z < -0.1 && (at.truncate() / -at.z).abs().max_element() <= 1.0
            };
            let seen = places.iter().filter(is_seen).count();
            assert!(seen * 10 >= places.len() * 9, "{name}, step {step}: {seen} of {}", places.len());
        }
    }
}

#[test]
fn a_pole_is_framed_by_its_height_and_a_beam_by_its_width() {
    let pole = [Vec3::ZERO, Vec3::Y * 1.5];
    let distance_m = framing_distance_m(&pole);
    let (low, high, _) = seen_at_start(&pole, distance_m).expect("in front");
    assert!(((high.y - low.y) * 0.5 - ASSET_PART_OF_HEIGHT).abs() < 0.003, "{low} to {high}");
    let beam = [Vec3::new(-1.5, 1.2, 0.0), Vec3::new(1.5, 1.3, 0.0)];
    let distance_m = framing_distance_m(&beam);
    let (low, high, _) = seen_at_start(&beam, distance_m).expect("in front");
    assert!((high.x - ASSET_PART_OF_SIDES).abs() < 0.003 && (low.x + high.x).abs() < 0.01, "{low} to {high}");
    assert_eq!(framing_distance_m(&[Vec3::new(0.0, 1.3, 0.0)]), *ASSET_DISTANCE_M.start());
}

#[test]
fn dragons_stand_apart_in_front_of_the_user() {
    for count in [1, 2, 3, 5, 9, 25] {
        let scene = load_scene(&SceneSource::Dragons(count)).expect("dragons");
        assert_eq!(scene.instances.len(), count as usize + 1);
        assert_eq!(scene.models.len(), 2, "one dragon however many are shown, and the ground");
        let places: Vec<Vec3> = (0..count as usize)
            .map(|index| {
                let (low, high) = world_bounds(&scene, index);
                assert!(low.y.abs() < 0.05, "dragon {index} of {count} stands at {}", low.y);
                assert!(high.z < -0.6, "dragon {index} of {count} touches the user: {high}");
                (low + high) * 0.5
            })
            .collect();
        for (a, first) in places.iter().enumerate() {
            assert!(places[a + 1..].iter().all(|other| first.distance(*other) > 0.8), "{count}: {places:?}");
        }
        if count <= 3 {
            let group = places.iter().sum::<Vec3>() / count as f32;
            assert!((3.0..=3.6).contains(&-group.z) && group.x.abs() < 0.3, "{count}: centre {group}");
        }
        let mut shifts: Vec<f32> = scene.instances[..count as usize].iter().map(|i| i.time_shift_s).collect();
        shifts.sort_by(f32::total_cmp);
        assert!(shifts.windows(2).all(|pair| pair[1] - pair[0] > 0.01), "{shifts:?}");
    }
}

#[test]
fn grid_of_dragons_fills_rows_columns_and_layers_without_touching() {
    let scene = load_scene(&SceneSource::DragonGrid([3, 2, 2])).expect("dragons");
    assert_eq!((scene.instances.len(), scene.models.len()), (13, 2));
    let (low, high) = world_bounds(&scene, 0);
    let moved = |instance: &Instance| {
        assert_eq!(instance.placement.matrix3, scene.instances[0].placement.matrix3);
        let by = Vec3::from(instance.placement.translation - scene.instances[0].placement.translation);
        (low + by, high + by)
    };
    let bounds: Vec<(Vec3, Vec3)> = scene.instances[..12].iter().map(moved).collect();
    for (a, (low, high)) in bounds.iter().enumerate() {
        assert!(high.z < -0.6, "dragon {a} touches the user: {high}");
        for (b, other) in bounds.iter().enumerate().skip(a + 1) {
            let apart = low.cmpgt(other.1) | other.0.cmpgt(*high);
            assert!(apart.any(), "dragons {a} and {b} overlap");
        }
    }
    assert!(bounds[0].0.y.abs() < 0.05 && bounds[3].0.y > bounds[0].1.y, "layers stand on each other");
    let middle_x = bounds.iter().map(|(low, high)| low.x + high.x).sum::<f32>() / 24.0;
    assert!(middle_x.abs() < 0.05, "{middle_x}");
}

fn courtyard() -> Scene {
    load_scene(&SceneSource::Courtyard).expect("built in")
}

#[test]
fn the_courtyard_has_dragons_at_different_moments_cutouts_and_lamps() {
    let scene = courtyard();
    let is_dragon = |instance: &&Instance| scene.models[instance.model].name == "dragon";
    let dragons: Vec<&Instance> = scene.instances.iter().filter(is_dragon).collect();
    assert!((3..=5).contains(&dragons.len()) && dragons.iter().all(|dragon| dragon.clip.is_some()));
    let mut shifts: Vec<f32> = dragons.iter().map(|dragon| dragon.time_shift_s).collect();
    shifts.sort_by(f32::total_cmp);
    assert!(shifts.windows(2).all(|pair| pair[1] - pair[0] > 0.2), "{shifts:?}");
    let near = dragons.iter().map(|dragon| dragon.world_from_model(0.0).translation.length());
    assert!(near.fold(f32::INFINITY, f32::min) < 4.0);
    let cutouts = scene.models.iter().flat_map(|model| &model.materials).filter(|m| m.alpha_cutoff.is_some());
    assert!(cutouts.count() >= 3);
    let lamps = scene.instances.iter().map(|instance| scene.models[instance.model].lights.len());
    assert_eq!((lamps.sum::<usize>(), scene.lights.len()), (2, 0));
    assert!(scene.sun.to_sun.y < 0.5 && scene.sun.irradiance.x > 2.0 * scene.sun.irradiance.z, "evening");
}

#[test]
fn the_courtyard_has_fewer_triangles_than_nine_dragons() {
    let triangles = |scene: &Scene| -> usize {
        scene.instances.iter().map(|instance| scene.models[instance.model].indices.len() / 3).sum()
    };
    let (courtyard, nine) =
        (triangles(&courtyard()), triangles(&load_scene(&SceneSource::Dragons(9)).expect("dragons")));
    assert!(courtyard * 3 > nine && courtyard < nine, "{courtyard} against {nine}");
}

#[test]
fn nothing_of_the_courtyard_stands_below_its_floor() {
    let scene = courtyard();
    for (index, instance) in scene.instances.iter().enumerate() {
        let (low, high) = world_bounds(&scene, index);
        assert!(low.y > -0.15 && high.y < 6.5, "{}: {low} to {high}", instance.name);
    }
}

#[test]
fn a_peek_passes_the_gates_edge_twice_in_three_seconds() {
    /// The gate's right edge, metres.
    const EDGE_M: f32 = 0.9;
    let peek = load_head_path(&SceneSource::Courtyard, "peek").expect("its own");
    let x = |step: u32| peek.stage_from_head(f64::from(step) * 0.01).position.x;
    let all: Vec<f32> = (0..=300).map(x).collect();
    let passed = all.windows(2).filter(|pair| pair[0] >= EDGE_M && pair[1] < EDGE_M).count();
    assert_eq!(passed, 2);
    let (low, high) = all.iter().fold((f32::MAX, f32::MIN), |(low, high), x| (low.min(*x), high.max(*x)));
    assert!((0.38..0.45).contains(&(high - low)), "{low} to {high}");
    let fastest = all.windows(2).map(|pair| (pair[1] - pair[0]).abs() * 100.0).fold(0.0, f32::max);
    assert!((0.7..1.3).contains(&fastest), "{fastest} m/s");
}

#[test]
fn example_in_the_documentation_loads() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/scene.example.toml");
    let source = SceneSource::File(path);
    let scene = load_scene(&source).expect("the example");
    let names: Vec<&str> = scene.instances.iter().map(|i| i.name.as_str()).collect();
    assert_eq!(names[..4], ["the near one", "dragon 1", "the moving one", "flock 0,0,0"]);
    assert_eq!((names.len(), names[9]), (10, "ground"));
    assert!(scene.instances[0].clip.is_some() && scene.instances[2].path.is_some());
    assert_eq!((scene.lights.len(), scene.cameras.len()), (2, 2));
    let aside = scene.head_path("step aside").expect("defined").stage_from_head(1.0);
    let alone = load_head_path(&source, "step aside").expect("defined");
    assert_eq!(alone.stage_from_head(1.0), aside);
    let (low, high) = world_bounds(&scene, 2);
    assert!(low.y > -0.05 && high.y < 2.0, "the moving one flies low: {low} to {high}");
}

#[test]
fn unknown_clip_is_shown_with_its_line() {
    let text = "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\nclip = \"swim across the lake\"\n";
    let message = scene_from_text(text, "s.toml", Path::new("")).expect_err("no such clip").to_string();
    assert!(
        message.starts_with("s.toml:6: model \"d\" has no clip \"swim across the lake\"; it has \""),
        "{message}"
    );
    let rest = scene_from_text(&text.replace("swim across the lake", ""), "s.toml", Path::new(""))
        .expect("rest pose");
    assert_eq!(rest.instances[0].clip, None);
}

#[test]
fn missing_model_file_is_shown_with_its_line() {
    let text = "[[model]]\nname = \"d\"\nfile = \"gone.glb\"\n[[instance]]\nmodel = \"d\"\n";
    let message =
        |text: &str| scene_from_text(text, "s.toml", Path::new("x")).expect_err("fault").to_string();
    assert!(
        message(text).starts_with("s.toml:3: model \"d\": x/gone.glb: cannot be read"),
        "{}",
        message(text)
    );
    let typo = message(&text.replace("gone.glb", "dragno"));
    assert_eq!(typo, "s.toml:3: \"dragno\" is not a .glb, .gltf or .fbx file; did you mean \"dragon\"?");
}

#[test]
fn edges_are_split_by_their_length_in_the_world() {
    let mut small = ground::ground(4.0);
    small.name = "sheet".into();
    let instance = |scale: f32| Instance {
        placement: Affine3A::from_scale(Vec3::splat(scale)),
        ..Instance::new("i", 0)
    };
    let split = |scale: f32| {
        let scene =
            around(vec![small.clone()], vec![instance(0.1), instance(scale)], &Loading::plain()).unwrap();
        (scene.models[0].indices.len() / 3, longest_edge_m(&scene, 1))
    };
    let SplitStats { triangles_before, .. } = split_long_edges(&mut small.clone(), 100.0);
    assert_eq!(split(0.5).0, triangles_before, "diagonals of 0.35 m stay");
    let keys = "{ time_s = 0, scale = 1 }, { time_s = 1, scale = 4 }";
    let text = format!(
        "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\npath = {{ key = [{keys}] }}\n"
    );
    let growing = scene_from_text(&text, "s.toml", Path::new("")).expect("good").instances.remove(0);
    let scene =
        around(vec![small.clone()], vec![Instance { model: 0, ..growing }], &Loading::plain()).unwrap();
    assert!(scene.models[0].indices.len() / 3 > triangles_before, "a path that grows it counts");
    let (triangles, longest_m) = split(4.0);
    assert!(triangles > triangles_before && longest_m <= MAX_EDGE_M, "{triangles} triangles, {longest_m} m");
}
