//! Parts of the page: text that is no markup, tables from the documents' Markdown, boxes that scroll by themselves.
//!
//! Text enters, HTML leaves. Nothing here knows results.

use crate::report::page::escaped;
use std::fmt::Write;

/// Longer cells break into lines, bytes.
const LONG_CELL: usize = 40;

/// Pictures inside a page need no namespace, and the page names no address.
pub(super) const SVG_NAMESPACE: &str = " xmlns=\"http://www.w3.org/2000/svg\"";

/// Escaped text, with code between backticks.
pub(super) fn inline(text: &str) -> String {
    let parts = text.split('`').enumerate();
    parts.fold(String::new(), |mut out, (place, part)| {
        let part = escaped(part);
        let _ = if place % 2 == 1 { write!(out, "<code>{part}</code>") } else { write!(out, "{part}") };
        out
    })
}

/// A paragraph.
pub(super) fn paragraph(text: &str) -> String {
    format!("<p>{}</p>\n", inline(text))
}

/// What may be wider than a phone, in a box that scrolls, also by keys.
pub(super) fn scrolling(label: &str, content: &str) -> String {
    format!(
        "<div class=\"scroll\" role=\"region\" tabindex=\"0\" aria-label=\"{}\">{content}</div>\n",
        escaped(label)
    )
}

/// What a reader opens who wants it.
pub(super) fn folded(summary: &str, content: &str) -> String {
    format!("<details><summary>{}</summary>\n{content}</details>\n", inline(summary))
}

/// Lines of text as they are.
pub(super) fn preformatted(label: &str, text: &str) -> String {
    scrolling(label, &format!("<pre>{}</pre>", escaped(text.trim_end())))
}

/// Tables, text between fences and paragraphs of Markdown; `label` is what tables are called.
pub(super) fn markdown(label: &str, text: &str) -> String {
    let mut out = String::new();
    let mut lines = text.lines().peekable();
    while let Some(line) = lines.next() {
        if line.starts_with('|') {
            let mut rows = vec![cells(line)];
            while let Some(line) = lines.next_if(|line| line.starts_with('|')) {
                rows.push(cells(line));
            }
            out += &scrolling(label, &table(label, &rows));
        } else if line.starts_with("```") {
            let inside: Vec<&str> = lines.by_ref().take_while(|line| !line.starts_with("```")).collect();
            out += &preformatted(label, &inside.join("\n"));
        } else if !line.trim().is_empty() {
            out += &paragraph(line);
        }
    }
    out
}

fn cells(line: &str) -> Vec<&str> {
    line.trim().trim_start_matches('|').trim_end_matches('|').split('|').map(str::trim).collect()
}

/// The first row has the heads, the second is the line below them.
fn table(label: &str, rows: &[Vec<&str>]) -> String {
    let mut out = format!("<table><caption>{}</caption>\n<thead><tr>", inline(label));
    for head in &rows[0] {
        let _ = write!(out, "<th scope=\"col\">{}</th>", inline(head));
    }
    out += "</tr></thead>\n<tbody>\n";
    for row in rows.iter().skip(2) {
        out += "<tr>";
        for (column, cell) in row.iter().enumerate() {
            let text = inline(cell);
            let _ = if column == 0 {
                write!(out, "<th scope=\"row\">{text}</th>")
            } else {
                let class = if cell.len() > LONG_CELL { " class=\"long\"" } else { "" };
                write!(out, "<td{class}>{text}</td>")
            };
        }
        out += "</tr>\n";
    }
    out + "</tbody></table>"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_of_markdown_is_one_of_html() {
        let html = markdown("sizes", "| a | b |\n| --- | --- |\n| `x` | 1 < 2 |\n\nAfter.\n");
        for part in [
            "aria-label=\"sizes\"",
            "<th scope=\"col\">b</th>",
            "<th scope=\"row\"><code>x</code></th><td>1 &lt; 2</td>",
            "<p>After.</p>",
        ] {
            assert!(html.contains(part), "{part} is missing in {html}");
        }
        assert!(!html.contains("---") && html.matches("<tr>").count() == 2, "{html}");
    }

    #[test]
    fn fenced_text_is_kept_as_it_is() {
        let html = markdown("text", "```text\na  <b>\n| c |\n```\n");
        assert!(html.contains("<pre>a  &lt;b&gt;\n| c |</pre>"), "{html}");
    }
}
