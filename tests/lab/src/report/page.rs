//! `index.html` of the demo: the pictures with a slider between client and truth, and the figures in words.
//!
//! The page knows files and figures by name only, so it can be rebuilt from any finished demo's folder.

use serde_json::Value;
use std::fmt::Write;

const TEMPLATE: &str = include_str!("page.html");

/// What the page tells of.
#[derive(Clone, Debug)]
pub struct Page {
    /// The scene, as on the command line.
    pub scene: String,
    /// Numbers of the display frames whose pictures `client-NNNNNN-left.png` and so on lie beside the page, in order.
    pub moments: Vec<u64>,
    /// Display frames per second of virtual time.
    pub refresh_hz: f64,
    /// `stats.json` of the run in virtual time.
    pub virtual_time: Value,
    /// `stats.json` of the run in real time.
    pub real_time: Value,
    /// `motion.json` of the run in virtual time; null where nothing moves.
    pub motion: Value,
}

/// A figure: its name, where it stands in `stats.json`, decimals, factor, unit, and what it says.
struct Figure {
    name: &'static str,
    pointer: &'static str,
    decimals: usize,
    factor: f64,
    unit: &'static str,
    meaning: &'static str,
}

const fn figure(
    name: &'static str,
    pointer: &'static str,
    decimals: usize,
    factor: f64,
    unit: &'static str,
    meaning: &'static str,
) -> Figure {
    Figure { name, pointer, decimals, factor, unit, meaning }
}

const FIGURES: &[Figure] = &[
    figure(
        "PSNR, animated",
        "/animated/psnr_db",
        1,
        1.0,
        " dB",
        "How close the colours of moving things are to the truth; above 30 is hard to tell apart side by side.",
    ),
    figure(
        "PSNR, moving shadows",
        "/shadowed/psnr_db",
        1,
        1.0,
        " dB",
        "The same where the shadow of a moving thing falls, or fell in the last second.",
    ),
    figure(
        "PSNR, everything",
        "/psnr_db",
        1,
        1.0,
        " dB",
        "The same over all geometry; mostly the ground, which is easy.",
    ),
    figure(
        "SSIM, animated",
        "/animated/ssim",
        4,
        1.0,
        "",
        "Whether edges and textures of moving things are where they belong; 1 is identical.",
    ),
    figure(
        "FLIP, animated",
        "/animated/flip",
        3,
        1.0,
        "",
        "What an eye would notice when flipping between picture and truth, at 67 pixels per degree; 0 is identical.",
    ),
    figure(
        "Holes",
        "/hole_fraction",
        3,
        100.0,
        " %",
        "Pixels where something is missing that the truth shows.",
    ),
    figure(
        "Updates",
        "/server_fps",
        1,
        1.0,
        " per second",
        "How often the server shades anew. The client does not wait for it.",
    ),
    figure(
        "Display frames",
        "/client_fps",
        1,
        1.0,
        " per second",
        "How often the client draws, from the newest head pose.",
    ),
    figure("Atlas", "/mbit_per_s/atlas", 2, 1.0, " Mbit/s", "Shaded surfaces, as H.264 video."),
    figure(
        "Geometry",
        "/mbit_per_s/geometry",
        2,
        1.0,
        " Mbit/s",
        "Visible triangles, and where animated vertices are going to be.",
    ),
    figure(
        "Clock error",
        "/clock_error_ms",
        3,
        1.0,
        " ms",
        "How far the client's idea of the server's time was off, at worst.",
    ),
    figure(
        "Clock error, known",
        "/clock_error_bound_ms",
        3,
        1.0,
        " ms",
        "How far it could be off, by what the client itself knew, at worst.",
    ),
];

impl Page {
    /// The page as HTML.
    pub fn html(&self) -> String {
        TEMPLATE
            .replace("@SUMMARY@", &self.summary())
            .replace("@MOMENTS@", &self.moment_options())
            .replace("@PAIRS@", &self.virtual_pairs())
            .replace("@FIGURES@", &self.figures())
            .replace("@REAL_TIME@", &self.in_real_time())
            .replace("@REAL_PAIRS@", &real_pairs())
            .replace("@COMMANDS@", &escaped(&commands(&self.scene)))
    }

    fn summary(&self) -> String {
        let device = self.virtual_time.get("device").and_then(Value::as_str).unwrap_or("an unknown device");
        let is_cpu = self.virtual_time.get("device_is_cpu").and_then(Value::as_bool).unwrap_or(false);
        let slow = if is_cpu { ", a CPU: correct, but slow" } else { "" };
        format!("Scene <code>{}</code>, rendered on {}{slow}.", escaped(&self.scene), escaped(device))
    }

    fn moment_options(&self) -> String {
        let last = self.moments.last();
        self.moments.iter().fold(String::new(), |mut text, moment| {
            let seconds = *moment as f64 / self.refresh_hz;
            let selected = if Some(moment) == last { " selected" } else { "" };
            let _ = write!(text, "<option value=\"{moment:06}\"{selected}>{seconds:.2} s</option>");
            text
        })
    }

    fn virtual_pairs(&self) -> String {
        let Some(last) = self.moments.last() else { return String::new() };
        ["left", "right"]
            .map(|side| {
                let [client, truth] = ["client", "truth"].map(|kind| format!("{kind}-NNNNNN-{side}.png"));
                let src = |pattern: &str| pattern.replace("NNNNNN", &format!("{last:06}"));
                pair(&format!("{side} eye"), [&src(&client), &src(&truth)], Some([&client, &truth]))
            })
            .concat()
    }

    fn figures(&self) -> String {
        let mut text = String::new();
        for figure in FIGURES {
            let [in_virtual, in_real] = [&self.virtual_time, &self.real_time].map(|stats| figure.of(stats));
            row(&mut text, figure.name, &in_virtual, &in_real, figure.meaning);
        }
        let worst = self.motion.get("max_error_mm").and_then(Value::as_f64);
        let worst = worst.map_or_else(|| "-".into(), |mm| format!("{mm:.2} mm"));
        let meaning = "How far any animated vertex that the client drew was from where the model's own animation has it.";
        row(&mut text, "Motion error, worst", &worst, "-", meaning);
        text
    }

    fn in_real_time(&self) -> String {
        let number = |key| self.real_time.get(key).and_then(Value::as_f64).unwrap_or(0.0);
        format!(
            "First, server and client ran as two processes over the loopback network, as you would run them: {:.1} updates \
             and {:.1} display frames per second on this machine. Where updates are this rare, a picture is as old as \
             that, so holes and blur are those of a slow machine.",
            number("server_fps"),
            number("client_fps"),
        )
    }
}

impl Figure {
    fn of(&self, stats: &Value) -> String {
        let value = stats.pointer(self.pointer).and_then(Value::as_f64);
        value.map_or_else(|| "-".into(), |v| format!("{:.*}{}", self.decimals, v * self.factor, self.unit))
    }
}

fn row(text: &mut String, name: &str, in_virtual: &str, in_real: &str, meaning: &str) {
    let _ = writeln!(
        text,
        "<tr><td>{name}</td><td class=\"figure\">{in_virtual}</td><td class=\"figure\">{in_real}</td><td>{meaning}</td></tr>"
    );
}

fn real_pairs() -> String {
    ["left", "right"]
        .map(|side| {
            let [client, truth] = ["client", "truth"].map(|kind| format!("real-time/{kind}-{side}.png"));
            pair(&format!("{side} eye, real time"), [&client, &truth], None)
        })
        .concat()
}

/// Two pictures above each other with a slider; `patterns` are their names for other moments.
fn pair(name: &str, [client, truth]: [&str; 2], patterns: Option<[&str; 2]>) -> String {
    let moments = |at: usize| patterns.map_or_else(String::new, |p| format!(" data-moments=\"{}\"", p[at]));
    format!(
        "<figure><div class=\"pair\"><img src=\"{truth}\"{} alt=\"Ground truth, {name}\">\
         <img class=\"top\" src=\"{client}\"{} alt=\"Client, {name}\"></div>\
         <input type=\"range\" min=\"0\" max=\"100\" value=\"50\" aria-label=\"Client or truth, {name}\">\
         <div class=\"ends\"><span>all truth</span><span>all client</span></div>\
         <figcaption>{name}</figcaption></figure>\n",
        moments(1),
        moments(0),
    )
}

fn commands(scene: &str) -> String {
    format!(
        "# your own model, in the same test bench\n\
         target/release/shadecast-lab run model.glb --link latency=20ms,jitter=5ms,rate=100mbit --out out/model\n\n\
         # the server for a headset or a simulator in your network, and the client beside an OpenXR runtime\n\
         target/release/shadecast-server stream {scene} --listen 0.0.0.0:7400\n\
         target/release/shadecast-client --connect ADDRESS:7400\n\n\
         # the ground truth, live in a window\n\
         target/release/shadecast-server forward {scene} --window\n"
    )
}

/// Text that cannot be taken for markup.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn page(scene: &str) -> String {
        let stats = |psnr_db: f64| {
            json!({ "device": "a <device>", "device_is_cpu": true, "server_fps": 29.4, "client_fps": 72.0,
                    "psnr_db": psnr_db, "animated": { "psnr_db": 30.25 }, "hole_fraction": 0.0005 })
        };
        Page {
            scene: scene.into(),
            moments: vec![24, 48],
            refresh_hz: 72.0,
            virtual_time: stats(33.75),
            real_time: stats(24.5),
            motion: json!({ "max_error_mm": 0.456 }),
        }
        .html()
    }

    #[test]
    fn page_shows_both_runs_and_says_which_is_which() {
        let html = page("dragon");
        for text in [
            "33.8 dB</td><td class=\"figure\">24.5 dB",
            "30.2 dB",
            "0.050 %",
            "0.46 mm",
            "virtual time",
            "29.4 updates",
        ] {
            assert!(html.contains(text), "{text} is missing in {html}");
        }
        assert!(!html.contains('@'), "a place was left open: {html}");
    }

    #[test]
    fn every_moment_can_be_chosen_and_the_last_is_shown() {
        let html = page("dragon");
        assert!(html.contains("<option value=\"000024\">0.33 s</option>"));
        assert!(html.contains("<option value=\"000048\" selected>0.67 s</option>"));
        assert!(html.contains("src=\"client-000048-left.png\" data-moments=\"client-NNNNNN-left.png\""));
    }

    #[test]
    fn foreign_text_is_never_markup() {
        let html = page("<script>alert(1)</script>.toml");
        assert!(!html.contains("<script>alert") && html.contains("a &lt;device&gt;"));
    }

    #[test]
    fn figure_that_was_not_measured_shows_a_dash() {
        let html = page("dragon");
        assert!(html.contains("Clock error</td><td class=\"figure\">-</td>"));
    }
}
