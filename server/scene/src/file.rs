//! The scene file: TOML to a [`SceneFile`], with the line of everything, so that what turns out to be wrong later
//! (a model that is not there, a clip that it does not have) can still be shown where it stands.
//!
//! Read by hand rather than through serde: its errors name the key, but not what the user may have meant.

use super::error::SceneError;
use super::suggest::did_you_mean;
use super::{Environment, Sun, ground};
use glam::{Affine3A, EulerRot, Mat4, Quat, Vec3};
use shadecast_protocol::pose::Pose;
use std::path::PathBuf;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Name of the built-in model, usable wherever a model's file is named.
pub const BUILT_IN_DRAGON: &str = "dragon";

/// A scene file, read and checked in itself; no other file has been opened yet.
#[derive(Clone, Debug)]
pub struct SceneFile {
    /// In the order of the file; names are unique.
    pub models: Vec<ModelEntry>,
    /// In the order of the file; at least one.
    pub instances: Vec<InstanceEntry>,
    /// The light.
    pub sun: Sun,
    /// The sky.
    pub environment: Environment,
    /// Side of the ground in metres, `None` for no ground.
    pub ground_size_m: Option<f32>,
    /// Where the stage starts.
    pub world_from_stage: Pose,
}

/// A `[[model]]`.
#[derive(Clone, Debug)]
pub struct ModelEntry {
    /// What instances call it.
    pub name: String,
    /// Where it comes from.
    pub file: ModelFile,
    /// Line of the file name, from 1.
    pub line: usize,
}

/// Where a model comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelFile {
    /// The generated dragon.
    BuiltInDragon,
    /// A path, relative to the scene file.
    Path(PathBuf),
}

/// An `[[instance]]`.
#[derive(Clone, Debug)]
pub struct InstanceEntry {
    /// Given, or made from the model's name.
    pub name: String,
    /// Index into [`SceneFile::models`].
    pub model: usize,
    /// Placement.
    pub world_from_model: Affine3A,
    /// Seconds added to the scene's time.
    pub time_shift_s: f32,
    /// Factor on time.
    pub speed: f32,
    /// Which clip plays, and the line that says so.
    pub clip: ClipChoice,
}

/// Which clip of its model an instance plays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ClipChoice {
    /// Nothing was said: the first that moves anything.
    First,
    /// `clip = ""`: the rest pose.
    Rest,
    /// The named one, on this line.
    Named(String, usize),
}

/// Sun and sky of scenes that do not set their own.
pub fn default_light() -> (Sun, Environment) {
    let sun = Sun {
        // High, from behind the user's left shoulder: what faces the user is lit, and shapes show.
        to_sun: Vec3::new(-0.45, 0.75, 0.5).normalize(),
        irradiance: Vec3::new(2.9, 2.7, 2.4),
        casts_shadows: true,
    };
    let environment = Environment {
        zenith: Vec3::new(0.22, 0.38, 0.68),
        horizon: Vec3::new(0.66, 0.74, 0.82),
        nadir: Vec3::new(0.24, 0.23, 0.21),
    };
    (sun, environment)
}

/// Reads the text of a scene file. `file` is its name, for messages.
pub fn parse(text: &str, file: &str) -> Result<SceneFile, SceneError> {
    let source = Source { text, file };
    let document = DeTable::parse(text).map_err(|error| {
        let at = error.span().map_or(0, |span| span.start);
        source.error(source.line(at), error.message().trim().replace('\n', "; "))
    })?;
    let root = Fields::new(&source, "a scene", document.get_ref(), 1, &ROOT_KEYS)?;
    let models = read_models(&root)?;
    let instances = read_instances(&root, &models)?;
    let (sun, environment) = default_light();
    Ok(SceneFile {
        models,
        instances,
        sun: read_sun(&root, sun)?,
        environment: read_environment(&root, environment)?,
        ground_size_m: read_ground(&root)?,
        world_from_stage: read_stage(&root)?,
    })
}

const ROOT_KEYS: [&str; 8] = ["model", "instance", "sun", "sky", "environment", "ground", "stage", "camera"];
const INSTANCE_KEYS: [&str; 9] = [
    "name",
    "model",
    "translation",
    "rotation_euler_deg",
    "scale",
    "matrix",
    "time_shift_s",
    "speed",
    "clip",
];

fn read_models(root: &Fields) -> Result<Vec<ModelEntry>, SceneError> {
    let mut models: Vec<ModelEntry> = Vec::new();
    for fields in root.tables("model", &["name", "file"])? {
        let (name, line) = fields.required_string("name")?;
        if models.iter().any(|model| model.name == name) {
            return Err(fields.source.error(line, format!("there are two models of the name \"{name}\"")));
        }
        let (file, line) = fields.required_string("file")?;
        let file = if file == BUILT_IN_DRAGON {
            ModelFile::BuiltInDragon
        } else {
            ModelFile::Path(PathBuf::from(file))
        };
        models.push(ModelEntry { name, file, line });
    }
    Ok(models)
}

fn read_instances(root: &Fields, models: &[ModelEntry]) -> Result<Vec<InstanceEntry>, SceneError> {
    let mut instances = Vec::new();
    for fields in root.tables("instance", &INSTANCE_KEYS)? {
        let (model_name, line) = fields.required_string("model")?;
        let names = || models.iter().map(|model| model.name.as_str());
        let model = names().position(|name| name == model_name).ok_or_else(|| {
            let hint = did_you_mean(&model_name, names());
            fields.source.error(line, format!("model \"{model_name}\" is not defined{hint}"))
        })?;
        let name = fields.string("name")?.map(|(name, _)| name);
        let clip = match fields.string("clip")? {
            None => ClipChoice::First,
            Some((name, _)) if name.is_empty() => ClipChoice::Rest,
            Some((name, line)) => ClipChoice::Named(name, line),
        };
        instances.push(InstanceEntry {
            name: name.unwrap_or_else(|| format!("{model_name} {}", instances.len())),
            model,
            world_from_model: read_placement(&fields)?,
            time_shift_s: fields.number("time_shift_s")?.unwrap_or(0.0),
            speed: fields.number("speed")?.unwrap_or(1.0),
            clip,
        });
    }
    if instances.is_empty() {
        let line = root.source.text.lines().count().max(1);
        return Err(root.source.error(line, "there is no [[instance]]: the scene shows nothing"));
    }
    Ok(instances)
}

fn read_placement(fields: &Fields) -> Result<Affine3A, SceneError> {
    const PARTS: [&str; 3] = ["translation", "rotation_euler_deg", "scale"];
    let placement = match fields.numbers::<16>("matrix")? {
        Some(_) if PARTS.iter().any(|key| fields.get(key).is_some()) => {
            let problem = "\"matrix\" cannot be combined with translation, rotation_euler_deg or scale";
            return Err(fields.source.error(fields.line_of("matrix"), problem));
        }
        Some(matrix) => affine_of(&Mat4::from_cols_array(&matrix)).ok_or_else(|| {
            let problem =
                "the last row of \"matrix\" (numbers 4, 8, 12, 16) must be 0, 0, 0, 1: columns come first";
            fields.source.error(fields.line_of("matrix"), problem)
        })?,
        None => {
            let [x, y, z] =
                fields.numbers::<3>("rotation_euler_deg")?.unwrap_or_default().map(f32::to_radians);
            let rotation = Quat::from_euler(EulerRot::YXZ, y, x, z);
            let translation = Vec3::from_array(fields.numbers("translation")?.unwrap_or_default());
            Affine3A::from_scale_rotation_translation(read_scale(fields)?, rotation, translation)
        }
    };
    let determinant = placement.matrix3.determinant();
    if !determinant.is_finite() || determinant <= 0.0 {
        let key = if fields.get("matrix").is_some() { "matrix" } else { "scale" };
        // A mirroring placement would turn the front of every triangle to the back.
        let problem = if determinant < 0.0 {
            "mirrors the model; mirror the asset instead"
        } else {
            "flattens the model to nothing"
        };
        return Err(fields.source.error(fields.line_of(key), format!("\"{key}\" {problem}")));
    }
    Ok(placement)
}

fn affine_of(matrix: &Mat4) -> Option<Affine3A> {
    (matrix.row(3) == glam::Vec4::W).then(|| Affine3A::from_mat4(*matrix))
}

/// One number for all axes, or three.
fn read_scale(fields: &Fields) -> Result<Vec3, SceneError> {
    match fields.get("scale").map(Spanned::get_ref) {
        Some(DeValue::Array(_)) => Ok(Vec3::from_array(fields.numbers("scale")?.unwrap_or([1.0; 3]))),
        _ => Ok(Vec3::splat(fields.number("scale")?.unwrap_or(1.0))),
    }
}

fn read_sun(root: &Fields, default: Sun) -> Result<Sun, SceneError> {
    let Some(fields) = root.table("sun", &["direction", "irradiance", "shadows"])? else {
        return Ok(default);
    };
    let to_sun = match fields.numbers::<3>("direction")?.map(Vec3::from_array) {
        None => default.to_sun,
        Some(direction) => direction.try_normalize().ok_or_else(|| {
            let problem = "\"direction\" has no length; it is the vector towards the sun";
            fields.source.error(fields.line_of("direction"), problem)
        })?,
    };
    Ok(Sun {
        to_sun,
        irradiance: fields.colour("irradiance")?.unwrap_or(default.irradiance),
        casts_shadows: fields.flag("shadows")?.unwrap_or(default.casts_shadows),
    })
}

fn read_environment(root: &Fields, default: Environment) -> Result<Environment, SceneError> {
    let keys = ["zenith", "horizon", "nadir"];
    let Some(fields) = root.table_by_either_name("sky", "environment", &keys)? else { return Ok(default) };
    Ok(Environment {
        zenith: fields.colour("zenith")?.unwrap_or(default.zenith),
        horizon: fields.colour("horizon")?.unwrap_or(default.horizon),
        nadir: fields.colour("nadir")?.unwrap_or(default.nadir),
    })
}

fn read_ground(root: &Fields) -> Result<Option<f32>, SceneError> {
    let Some(fields) = root.table("ground", &["enabled", "size_m"])? else {
        return Ok(Some(ground::DEFAULT_SIZE_M));
    };
    let size_m = fields.number("size_m")?.unwrap_or(ground::DEFAULT_SIZE_M);
    if !(1.0..=ground::MAX_SIZE_M).contains(&size_m) {
        let problem = format!("\"size_m\" must be from 1 to {} metres", ground::MAX_SIZE_M);
        return Err(fields.source.error(fields.line_of("size_m"), problem));
    }
    Ok(fields.flag("enabled")?.unwrap_or(true).then_some(size_m))
}

fn read_stage(root: &Fields) -> Result<Pose, SceneError> {
    let Some(fields) = root.table_by_either_name("stage", "camera", &["position", "yaw_deg"])? else {
        return Ok(Pose::IDENTITY);
    };
    let yaw = fields.number("yaw_deg")?.unwrap_or(0.0).to_radians();
    Ok(Pose {
        position: Vec3::from_array(fields.numbers("position")?.unwrap_or_default()),
        orientation: Quat::from_rotation_y(yaw),
    })
}

/// The text, to find lines in.
struct Source<'a> {
    text: &'a str,
    file: &'a str,
}

impl Source<'_> {
    /// Line of a byte offset, from 1.
    fn line(&self, offset: usize) -> usize {
        1 + self.text.bytes().take(offset).filter(|byte| *byte == b'\n').count()
    }

    fn error(&self, line: usize, problem: impl Into<String>) -> SceneError {
        SceneError::SceneFile { file: self.file.to_owned(), line, problem: problem.into() }
    }
}

/// A table whose keys are all known.
struct Fields<'a> {
    source: &'a Source<'a>,
    what: &'a str,
    table: &'a DeTable<'a>,
    line: usize,
}

impl<'a> Fields<'a> {
    fn new(
        source: &'a Source<'a>,
        what: &'a str,
        table: &'a DeTable<'a>,
        line: usize,
        known: &[&str],
    ) -> Result<Self, SceneError> {
        let mut unknown: Vec<_> =
            table.keys().filter(|key| !known.contains(&key.get_ref().as_ref())).collect();
        unknown.sort_by_key(|key| key.span().start);
        let Some(key) = unknown.first() else { return Ok(Self { source, what, table, line }) };
        let hint = did_you_mean(key.get_ref(), known.iter().copied());
        let hint = if hint.is_empty() { format!("; it can have {}", known.join(", ")) } else { hint };
        Err(source.error(source.line(key.span().start), format!("{what} has no \"{}\"{hint}", key.get_ref())))
    }

    fn get(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.get(key)
    }

    fn line_of(&self, key: &str) -> usize {
        self.get(key).map_or(self.line, |value| self.source.line(value.span().start))
    }

    fn wrong_type(&self, key: &str, wanted: &str) -> SceneError {
        let found = self.get(key).map_or("nothing", |value| value.get_ref().type_str());
        let problem = format!("\"{key}\" of {} must be {wanted}, not {found}", self.what);
        self.source.error(self.line_of(key), problem)
    }

    fn string(&self, key: &str) -> Result<Option<(String, usize)>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let text = value.get_ref().as_str().ok_or_else(|| self.wrong_type(key, "a text in quotes"))?;
        Ok(Some((text.to_owned(), self.line_of(key))))
    }

    fn required_string(&self, key: &str) -> Result<(String, usize), SceneError> {
        let missing = || self.source.error(self.line, format!("{} needs \"{key}\"", self.what));
        self.string(key)?.filter(|(text, _)| !text.is_empty()).ok_or_else(missing)
    }

    fn flag(&self, key: &str) -> Result<Option<bool>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.get_ref().as_bool().map(Some).ok_or_else(|| self.wrong_type(key, "true or false"))
    }

    fn number(&self, key: &str) -> Result<Option<f32>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        finite_number(value.get_ref()).map(Some).ok_or_else(|| self.wrong_type(key, "a finite number"))
    }

    fn numbers<const N: usize>(&self, key: &str) -> Result<Option<[f32; N]>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let wrong = || self.wrong_type(key, &format!("{N} finite numbers in brackets"));
        let array = value.get_ref().as_array().ok_or_else(wrong)?;
        let numbers: Option<Vec<f32>> = array.iter().map(|item| finite_number(item.get_ref())).collect();
        let count = array.iter().count();
        if count != N {
            let problem = format!("\"{key}\" of {} has {count} numbers; it must have {N}", self.what);
            return Err(self.source.error(self.line_of(key), problem));
        }
        numbers.and_then(|numbers| numbers.try_into().ok()).map(Some).ok_or_else(wrong)
    }

    /// Linear RGB, not negative.
    fn colour(&self, key: &str) -> Result<Option<Vec3>, SceneError> {
        let colour = self.numbers::<3>(key)?.map(Vec3::from_array);
        match colour {
            Some(colour) if colour.min_element() < 0.0 => {
                Err(self.source.error(self.line_of(key), format!("\"{key}\" cannot be negative")))
            }
            other => Ok(other),
        }
    }

    fn table(&self, key: &'a str, known: &[&str]) -> Result<Option<Fields<'a>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let table = value.get_ref().as_table().ok_or_else(|| self.wrong_type(key, "a table"))?;
        Fields::new(self.source, key, table, self.line_of(key), known).map(Some)
    }

    fn table_by_either_name(
        &self,
        key: &'a str,
        other: &'a str,
        known: &[&str],
    ) -> Result<Option<Fields<'a>>, SceneError> {
        if self.get(key).is_some() && self.get(other).is_some() {
            let problem = format!("[{key}] and [{other}] are two names of one thing; keep one");
            return Err(self.source.error(self.line_of(other), problem));
        }
        Ok(self.table(key, known)?.or(self.table(other, known)?))
    }

    /// An array of tables, `[[key]]`.
    fn tables(&self, key: &'a str, known: &[&str]) -> Result<Vec<Fields<'a>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(Vec::new()) };
        let wrong = || self.wrong_type(key, &format!("a list: write [[{key}]]"));
        let mut tables = Vec::new();
        for item in value.get_ref().as_array().ok_or_else(wrong)?.iter() {
            let table = item.get_ref().as_table().ok_or_else(wrong)?;
            tables.push(Fields::new(self.source, key, table, self.source.line(item.span().start), known)?);
        }
        Ok(tables)
    }
}

fn finite_number(value: &DeValue) -> Option<f32> {
    let number: f64 = match value {
        DeValue::Float(float) => float.as_str().parse().ok()?,
        DeValue::Integer(integer) => i64::from_str_radix(integer.as_str(), integer.radix()).ok()? as f64,
        _ => return None,
    };
    let number = number as f32;
    number.is_finite().then_some(number)
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(scene.models[0].file, ModelFile::BuiltInDragon);
        assert_eq!(scene.models[1].file, ModelFile::Path("models/Fox.glb".into()));
        let [dragon, fox] = &scene.instances[..] else { panic!("two instances") };
        let front = dragon.world_from_model.transform_point3(Vec3::Z);
        assert!(front.abs_diff_eq(Vec3::new(3.0, 2.5, -3.0), 1e-5), "yaw turns +z to +x: {front}");
        assert_eq!((dragon.time_shift_s, dragon.speed, &dragon.clip), (0.5, -1.5, &ClipChoice::First));
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
            ("scale = 2", "scale = 0", "scene.toml:14: \"scale\" flattens the model to nothing"),
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
                "scene.toml:7: there are two models of the name \"dragon\"",
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
    fn sun_casts_shadows_unless_told_otherwise() {
        let shadows = |text: &str| parse(text, "scene.toml").expect("a good file").sun.casts_shadows;
        assert!(shadows(GOOD));
        assert!(!shadows(&GOOD.replace("[sun]", "[sun]\nshadows = false")));
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
        assert!(message(&format!("{GOOD}\n[camera]\nyaw_deg = 1")).contains("two names"));
        assert!(parse(&GOOD.replace("[stage]", "[camera]"), "scene.toml").is_ok());
    }
}
