//! Writes small ASCII FBX files: objects and connections are text, free to be changed before it is written.

use std::fmt::Write;

/// FBX's ticks in a second.
pub(super) const TICKS: i64 = 46_186_158_000;

/// A file under construction.
#[derive(Clone)]
pub(super) struct Ascii {
    pub(super) creator: &'static str,
    /// Name, type and value of global settings.
    pub(super) settings: String,
    pub(super) objects: String,
    pub(super) connections: String,
}

/// `*3 { a: 1,2,3 }`.
pub(super) fn list<T: std::fmt::Display>(numbers: &[T]) -> String {
    let text: Vec<String> = numbers.iter().map(ToString::to_string).collect();
    format!("*{} {{\na: {}\n}}", numbers.len(), text.join(","))
}

/// A property of three numbers.
pub(super) fn vector(name: &str, [x, y, z]: [f64; 3]) -> String {
    format!("P: \"{name}\", \"{name}\", \"\", \"A\",{x},{y},{z}\n")
}

pub(super) fn number(name: &str, value: f64) -> String {
    format!("P: \"{name}\", \"double\", \"Number\", \"\",{value}\n")
}

pub(super) fn integer(name: &str, value: i64) -> String {
    format!("P: \"{name}\", \"int\", \"Integer\", \"\",{value}\n")
}

/// Rows of a 4x4 matrix with a translation.
pub(super) fn moved_by([x, y, z]: [f64; 3]) -> String {
    list(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, y, z, 1.0])
}

impl Ascii {
    /// Centimetres, y up.
    pub(super) fn new() -> Self {
        let axes = [("Up", 1), ("Front", 2), ("Coord", 0)];
        let mut settings = number("UnitScaleFactor", 1.0);
        for (axis, index) in axes {
            settings += &integer(&format!("{axis}Axis"), index);
            settings += &integer(&format!("{axis}AxisSign"), 1);
        }
        Self { creator: "test", settings, objects: String::new(), connections: String::new() }
    }

    pub(super) fn object(&mut self, kind: &str, id: u32, name: &str, class: &str, body: &str) {
        let _ = writeln!(self.objects, "{kind}: {id}, \"{name}\", \"{class}\" {{\n{body}\n}}");
    }

    pub(super) fn model(&mut self, id: u32, name: &str, class: &str, parent: u32, properties: &str) {
        let body = format!("Version: 232\nProperties70: {{\n{properties}}}");
        self.object("Model", id, &format!("Model::{name}"), class, &body);
        if class == "LimbNode" {
            self.object("NodeAttribute", id + 50_000, "NodeAttribute::", class, "TypeFlags: \"Skeleton\"");
            self.connect(id + 50_000, id);
        }
        self.connect(id, parent);
    }

    pub(super) fn connect(&mut self, child: u32, parent: u32) {
        let _ = writeln!(self.connections, "C: \"OO\",{child},{parent}");
    }

    pub(super) fn connect_to_property(&mut self, child: u32, parent: u32, property: &str) {
        let _ = writeln!(self.connections, "C: \"OP\",{child},{parent}, \"{property}\"");
    }

    /// A curve node with id `id` and a curve (from `id + 1` on) for each list of keys (seconds, value), on a property
    /// of an object and a layer. `flags` is FBX's: 2 steps, 4 lines, 8 splines.
    pub(super) fn animate(
        &mut self,
        id: u32,
        (layer, target, property): (u32, u32, &str),
        flags: u32,
        curves: &[(&str, &[(f64, f64)])],
    ) {
        self.object("AnimationCurveNode", id, "AnimCurveNode::n", "", "");
        self.connect(id, layer);
        self.connect_to_property(id, target, property);
        for (index, (channel, keys)) in curves.iter().enumerate() {
            let curve = id + 1 + index as u32;
            let times: Vec<i64> = keys.iter().map(|(time, _)| (time * TICKS as f64).round() as i64).collect();
            let values: Vec<f64> = keys.iter().map(|(_, value)| *value).collect();
            let body = format!(
                "Default: 0\nKeyVer: 4008\nKeyTime: {}\nKeyValueFloat: {}\nKeyAttrFlags: {}\nKeyAttrDataFloat: {}\nKeyAttrRefCount: {}",
                list(&times),
                list(&values),
                list(&[flags]),
                list(&[0, 0, 0, 0]),
                list(&[keys.len()]),
            );
            self.object("AnimationCurve", curve, "AnimCurve::", "", &body);
            self.connect_to_property(curve, id, channel);
        }
    }

    /// A stack with id `id`, a layer `id + 1`, over a range of seconds.
    pub(super) fn stack(&mut self, id: u32, name: &str, [start, stop]: [f64; 2]) {
        let time = |name: &str, time: f64| {
            format!("P: \"{name}\", \"KTime\", \"Time\", \"\",{}\n", (time * TICKS as f64).round() as i64)
        };
        let body = format!("Properties70: {{\n{}{}}}", time("LocalStart", start), time("LocalStop", stop));
        self.object("AnimationStack", id, &format!("AnimStack::{name}"), "", &body);
        self.object("AnimationLayer", id + 1, "AnimLayer::base", "", "");
        self.connect(id + 1, id);
    }

    pub(super) fn text(&self) -> String {
        format!(
            "; FBX 7.4.0 project file\nFBXHeaderExtension:  {{\nFBXHeaderVersion: 1003\nFBXVersion: 7400\nCreator: \"{}\"\n}}\nCreator: \"{}\"\nGlobalSettings:  {{\nVersion: 1000\nProperties70:  {{\n{}}}\n}}\nObjects:  {{\n{}}}\nConnections:  {{\n{}}}\n",
            self.creator, self.creator, self.settings, self.objects, self.connections
        )
    }
}
