//! The page as a whole: it is well-formed, needs no network, is small, and says what the records say.

use super::versus::tests::record;
use super::*;
use serde_json::json;
use std::collections::BTreeSet;

/// Elements that have no end.
const VOID: [&str; 5] = ["meta", "img", "input", "br", "link"];

fn committed_results() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/results")
}

/// Names of tags with their attributes, in order; text and what scripts and styles say are left out.
fn tags(html: &str) -> Vec<&str> {
    let mut found = Vec::new();
    let mut rest = html;
    while let Some((_, after)) = rest.split_once('<') {
        let (tag, after) = after.split_once('>').expect("a tag is closed");
        found.push(tag);
        rest = match tag {
            "script" | "style" => &after[after.find("</").expect("it ends")..],
            _ => after,
        };
    }
    found
}

/// Every element ends, in the order in which they nest; no id is there twice, and each that is named is there.
#[track_caller]
fn assert_well_formed(html: &str) {
    let (mut open, mut ids, mut named) = (Vec::new(), BTreeSet::new(), BTreeSet::new());
    for tag in tags(html) {
        let name = tag.trim_start_matches('/').split_whitespace().next().unwrap_or("").trim_end_matches('/');
        if let Some(id) = tag.split(" id=\"").nth(1).and_then(|rest| rest.split('"').next()) {
            assert!(ids.insert(id), "two elements are #{id}");
        }
        named.extend(tag.split(" href=\"#").nth(1).and_then(|rest| rest.split('"').next()));
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name), "elements do not nest");
        } else if !tag.starts_with('!') && !tag.ends_with('/') && !VOID.contains(&name) {
            open.push(name);
        }
        let has = |attribute: &str| tag.contains(&format!(" {attribute}=\""));
        assert!(name != "img" || has("alt"), "a picture has no words: {}", &tag[..60.min(tag.len())]);
        assert!(name != "input" || has("aria-label"), "a control has no name: {tag}");
    }
    assert!(open.is_empty(), "{open:?} do not end");
    assert!(named.is_subset(&ids), "{named:?} are not all among {ids:?}");
}

#[track_caller]
fn assert_needs_no_network(html: &str) {
    for word in ["http:", "https:", "//cdn", "url(", "@import", "<link"] {
        assert!(!html.contains(word), "{word} is on the page");
    }
    for source in html.split(" src=\"").skip(1) {
        assert!(source.starts_with("data:"), "{}", &source[..40]);
    }
}

#[test]
fn the_page_of_the_committed_results_is_whole_and_small() {
    let html = page(&committed_results(), None).expect("a page");
    assert_well_formed(&html);
    assert_needs_no_network(&html);
    assert!(html.len() < MOST_BYTES, "{} bytes", html.len());
    for part in [
        "What is better",
        "data:image/png",
        "Figure 4",
        "the paper's server",
        "Bits by cause",
        "Bars that are missed",
    ] {
        assert!(html.contains(part), "{part} is missing");
    }
    for place in ["CASE", "PICTURE", "CONTENTS", "SECTIONS", "FRESHNESS"] {
        assert!(!html.contains(&format!("@{place}@")), "{place} was left open");
    }
    let has_comparison =
        crate::results::records(&committed_results()).keys().any(|name| versus::is_comparison(name));
    assert!(has_comparison || html.contains("<h2>Beside video</h2>\n<p>Not measured yet.</p>"));
}

#[test]
fn a_page_of_comparisons_has_curves_tables_and_commands() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, record) in [
        ("quality-dragons9-5ms", record(5.0, 6.0, 0.08, 0.07)),
        ("quality-dragons9-20ms", record(20.0, 6.0, 0.061, 0.072)),
        ("quality-dragons9-20ms-12mbit", record(20.0, 12.0, 0.05, 0.06)),
    ] {
        std::fs::write(folder.path().join(format!("{name}.json")), record.to_string()).expect("written");
    }
    let html = page(folder.path(), None).expect("a page");
    assert_well_formed(&html);
    assert_needs_no_network(&html);
    for part in [
        "class=\"plot\"",
        "video with depth",
        "in 2 of 3 comparisons",
        "At 5 ms video is closer",
        "--bitrate 12",
        "abc1234",
    ] {
        assert!(html.contains(part), "{part} is missing");
    }
}

#[test]
fn a_page_without_records_says_that_nothing_is_measured() {
    let folder = tempfile::tempdir().expect("a folder");
    let html = page(folder.path(), None).expect("a page");
    assert_well_formed(&html);
    assert!(html.matches("Not measured yet.").count() >= 6, "{html}");
    let gone = folder.path().join("gone");
    assert!(write(&gone, None, &folder.path().join("a.html")).is_err());
}

#[test]
fn records_with_markup_in_them_stay_text() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut record = record(20.0, 6.0, 0.06, 0.07);
    record["scene"] = json!("<script>alert(1)</script>");
    record["commit"] = json!("\"><b>");
    std::fs::write(folder.path().join("quality-x.json"), record.to_string()).expect("written");
    let html = page(folder.path(), None).expect("a page");
    assert_well_formed(&html);
    assert!(!html.contains("<script>alert") && !html.contains("\"><b>"));
}
