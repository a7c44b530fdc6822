//! "Did you mean": the known word nearest to a mistyped one.

use shadecast_model::text::printable;

/// The candidate within a third of the word's length in edits (at least one), the nearest first; `None` if all
/// are further away, since a wild guess helps nobody.
pub fn closest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let limit = (word.chars().count() / 3).max(1);
    candidates
        .into_iter()
        .map(|candidate| (edit_distance(word, candidate), candidate))
        .filter(|(distance, _)| *distance <= limit)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// `; did you mean "x"?`, or nothing; to be appended to a message.
pub fn did_you_mean<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> String {
    closest(word, candidates)
        .map(|best| format!("; did you mean \"{}\"?", printable(best)))
        .unwrap_or_default()
}

/// As [`did_you_mean`], or where nothing is near: `; {lead} "a", "b"`.
pub fn did_you_mean_or_list<'a>(
    word: &str,
    candidates: impl Iterator<Item = &'a str> + Clone,
    lead: &str,
) -> String {
    let hint = did_you_mean(word, candidates.clone());
    if !hint.is_empty() {
        return hint;
    }
    let list: Vec<String> = candidates.map(|name| format!("\"{}\"", printable(name))).collect();
    format!("; {lead} {}", if list.is_empty() { "none".into() } else { list.join(", ") })
}

/// Levenshtein distance with transpositions of neighbours (optimal string alignment), in characters, ASCII case
/// ignored.
fn edit_distance(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.to_ascii_lowercase().chars().collect();
    let b: Vec<char> = b.to_ascii_lowercase().chars().collect();
    let mut rows = vec![(0..=b.len()).collect::<Vec<_>>()];
    for i in 1..=a.len() {
        let mut row = vec![i];
        for j in 1..=b.len() {
            let substitution = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
            let mut best = substitution.min(rows[i - 1][j] + 1).min(row[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                best = best.min(rows[i - 2][j - 2] + 1);
            }
            row.push(best);
        }
        rows.push(row);
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_typing_error_finds_the_word_that_was_meant() {
        assert_eq!(closest("dragn", ["fox", "dragon"]), Some("dragon"));
        assert_eq!(closest("tranlsation", ["translation", "rotation_euler_deg"]), Some("translation"));
    }

    #[test]
    fn an_unrelated_word_gets_no_suggestion() {
        assert_eq!(closest("castle", ["fox", "dragon"]), None);
        assert_eq!(did_you_mean("castle", ["fox"]), "");
    }

    #[test]
    fn distance_counts_single_edits() {
        for (a, b, distance) in
            [("", "abc", 3), ("abc", "abc", 0), ("abc", "acb", 1), ("kitten", "sitting", 3)]
        {
            assert_eq!(edit_distance(a, b), distance, "{a} {b}");
        }
    }
}
