//! `shadecast-lab report`: one page of HTML from the committed results, with all pictures and curves in it.
//!
//! A folder of records enters, and pictures where they are at hand. A file leaves that needs no network. Nothing here measures, and
//! a missing record makes its section say so.

mod case;
mod html;
mod plot;
mod provenance;
mod sections;
mod stills;
mod versus;
mod video;

use super::bars::{BARS, Bars};
use anyhow::Context;
use provenance::Committed;
use std::fmt::Write;
use std::path::Path;

const TEMPLATE: &str = include_str!("page.html");
/// The README's picture, beside the folder of results.
const FIRST_PICTURE: &str = "../courtyard.png";
/// What a page should not exceed, bytes.
pub const MOST_BYTES: usize = 1_500_000;

/// A part of the page.
struct Section {
    id: &'static str,
    title: &'static str,
    content: String,
    /// Records that its figures are of.
    records: Vec<String>,
}

/// Writes the page of `results` into `out`; `pictures` has stills. Says how large it is, in bytes.
///
/// # Errors
/// There are no results, a picture cannot be read, or the page cannot be written.
pub fn write(results: &Path, pictures: Option<&Path>, out: &Path) -> anyhow::Result<usize> {
    anyhow::ensure!(results.is_dir(), "{} is no folder of results", results.display());
    let html = page(results, pictures)?;
    if let Some(folder) = out.parent() {
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    }
    shadecast_system::write_atomically(out, html.as_bytes())
        .with_context(|| format!("writing {}", out.display()))?;
    Ok(html.len())
}

fn page(results: &Path, pictures: Option<&Path>) -> anyhow::Result<String> {
    let committed = Committed::read(results);
    let groups = versus::groups(&committed.records)?;
    let bars = Bars::parse(BARS)?.check(results);
    let picture = match pictures {
        Some(folder) => stills::stills(folder)?,
        None => stills::first_picture(&results.join(FIRST_PICTURE))?,
    };
    let sections = sections(&committed, &groups, &bars)?;
    let contents: String = sections
        .iter()
        .map(|section| format!("<li><a href=\"#{}\">{}</a></li>\n", section.id, section.title))
        .collect();
    let body = sections.iter().fold(String::new(), |mut body, section| {
        let Section { id, title, content, records } = section;
        let provenance = committed.provenance(records);
        let _ = writeln!(body, "<section id=\"{id}\">\n<h2>{title}</h2>\n{content}{provenance}</section>");
        body
    });
    let parts = [
        ("@CASE@", case::case(&groups, &committed, &bars)),
        ("@PICTURE@", picture),
        ("@CONTENTS@", contents),
        ("@SECTIONS@", body),
        ("@FRESHNESS@", committed.freshness()),
    ];
    Ok(parts.iter().fold(TEMPLATE.to_owned(), |page, (place, part)| page.replacen(place, part, 1)))
}

fn sections(
    committed: &Committed,
    groups: &[versus::Group],
    bars: &super::bars::Report,
) -> anyhow::Result<Vec<Section>> {
    let section = |id, title, content, starts: &[&str]| Section {
        id,
        title,
        content,
        records: starts.iter().flat_map(|start| committed.names(start)).collect(),
    };
    Ok(vec![
        section("video", "Beside video", video::section(groups)?, &["quality"]),
        section("table1", "The paper's Table 1 and Figure 4", sections::table1(committed)?, &["table1"]),
        section("motion", "Motion", sections::motion(committed), &["motion-auto-", "motion-dragon-kinds"]),
        section("links", "Links", sections::links(committed), &["links-"]),
        section("pictures", "Pictures of a headset's size", sections::pictures(committed)?, &["picture-"]),
        section("bits", "Bits by cause", sections::bits(committed), &["picture-"]),
        section("memory", "Memory and its traffic", sections::memory(committed)?, &[]),
        section("bars", "Bars", sections::bars(bars), &sections::records_of_missed(bars)),
    ])
}

#[cfg(test)]
mod tests;
