//! Tables of a TOML text with the line of every value. This part of the reader knows TOML and no scenes.

use crate::SceneError;
use crate::suggest::{did_you_mean, did_you_mean_or_list};
use glam::Vec3;
use shadecast_model::limits::MAX_COORDINATE_M;
use shadecast_model::text::printable;
use std::ops::RangeInclusive;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The text, to find lines in.
pub(super) struct Source<'a> {
    pub(super) text: &'a str,
    file: &'a str,
    /// Offset of each line break.
    breaks: Vec<usize>,
}

impl<'a> Source<'a> {
    pub(super) fn new(text: &'a str, file: &'a str) -> Self {
        Self { text, file, breaks: text.match_indices('\n').map(|(at, _)| at).collect() }
    }

    /// Line of a byte offset, from 1.
    pub(super) fn line(&self, offset: usize) -> usize {
        1 + self.breaks.partition_point(|at| *at < offset)
    }

    pub(super) fn last_line(&self) -> usize {
        self.text.lines().count().max(1)
    }

    pub(super) fn error(&self, line: usize, problem: impl Into<String>) -> SceneError {
        SceneError::SceneFile { file: self.file.to_owned(), line, problem: problem.into() }
    }
}

/// A table whose keys are all known.
pub(super) struct Fields<'a> {
    pub(super) source: &'a Source<'a>,
    /// What the table is, in messages.
    pub(super) what: &'a str,
    table: &'a DeTable<'a>,
    /// Where it starts, from 1.
    pub(super) line: usize,
}

impl<'a> Fields<'a> {
    pub(super) fn new(
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
        Err(source.error(
            source.line(key.span().start),
            format!("{what} has no \"{}\"{hint}", printable(key.get_ref())),
        ))
    }

    pub(super) fn get(&self, key: &str) -> Option<&'a DeValue<'a>> {
        self.table.get(key).map(Spanned::get_ref)
    }

    pub(super) fn has(&self, key: &str) -> bool {
        self.get(key).is_some()
    }

    /// The first of `keys` that the table has.
    pub(super) fn first_of<'k>(&self, keys: &[&'k str]) -> Option<&'k str> {
        keys.iter().copied().find(|key| self.has(key))
    }

    /// The line of a key's value, or of the table where it has no such key.
    pub(super) fn line_of(&self, key: &str) -> usize {
        self.table.get(key).map_or(self.line, |value| self.source.line(value.span().start))
    }

    /// A fault of a key's value.
    pub(super) fn error(&self, key: &str, problem: impl Into<String>) -> SceneError {
        self.source.error(self.line_of(key), problem)
    }

    fn wrong_type(&self, key: &str, wanted: &str) -> SceneError {
        let found = self.get(key).map_or("nothing", DeValue::type_str);
        self.error(key, format!("\"{key}\" of {} must be {wanted}, not {found}", self.what))
    }

    /// At most one of `keys` may be there: they say the same thing in different ways.
    pub(super) fn only_one_of(&self, keys: &[&str]) -> Result<(), SceneError> {
        let mut given = keys.iter().copied().filter(|key| self.has(key));
        match (given.next(), given.next()) {
            (Some(first), Some(second)) => {
                Err(self.error(second, format!("\"{second}\" cannot be combined with \"{first}\"; keep one")))
            }
            _ => Ok(()),
        }
    }

    fn missing(&self, key: &str) -> SceneError {
        self.source.error(self.line, format!("{} needs \"{key}\"", self.what))
    }

    /// The value of a key that must be there, as one of the readers below found it.
    pub(super) fn required<T>(&self, key: &str, found: Option<T>) -> Result<T, SceneError> {
        found.ok_or_else(|| self.missing(key))
    }

    /// A text and its line.
    pub(super) fn string(&self, key: &str) -> Result<Option<(String, usize)>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let text = value.as_str().ok_or_else(|| self.wrong_type(key, "a text in quotes"))?;
        Ok(Some((text.to_owned(), self.line_of(key))))
    }

    /// A text that is not empty, and its line.
    pub(super) fn required_string(&self, key: &str) -> Result<(String, usize), SceneError> {
        self.required(key, self.string(key)?.filter(|(text, _)| !text.is_empty()))
    }

    /// The required "name", which no earlier table of the kind may have.
    pub(super) fn unique_name<'n>(
        &self,
        kind: &str,
        mut taken: impl Iterator<Item = &'n str>,
    ) -> Result<String, SceneError> {
        let (name, line) = self.required_string("name")?;
        match taken.any(|other| other == name) {
            true => Err(self
                .source
                .error(line, format!("two {kind} have the name \"{}\"; rename one", printable(&name)))),
            false => Ok(name),
        }
    }

    /// One of a few words, as what it stands for.
    pub(super) fn choice<T: Copy>(&self, key: &str, choices: &[(&str, T)]) -> Result<Option<T>, SceneError> {
        let Some((word, line)) = self.string(key)? else { return Ok(None) };
        let words = choices.iter().map(|(word, _)| *word);
        let found = choices.iter().find(|(known, _)| *known == word).map(|(_, choice)| *choice);
        found.map(Some).ok_or_else(|| {
            let hint = did_you_mean_or_list(&word, words, "it can be");
            self.source
                .error(line, format!("\"{key}\" of {} cannot be \"{}\"{hint}", self.what, printable(&word)))
        })
    }

    pub(super) fn flag(&self, key: &str) -> Result<Option<bool>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.as_bool().map(Some).ok_or_else(|| self.wrong_type(key, "true or false"))
    }

    pub(super) fn number(&self, key: &str) -> Result<Option<f32>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        finite_number(value).map(Some).ok_or_else(|| self.wrong_type(key, "a finite number"))
    }

    /// A number of the unit within a range.
    pub(super) fn number_within(
        &self,
        key: &str,
        range: RangeInclusive<f32>,
        unit: &str,
    ) -> Result<Option<f32>, SceneError> {
        let number = self.number(key)?;
        if number.is_none_or(|number| range.contains(&number)) {
            return Ok(number);
        }
        let (low, high) = (range.start(), range.end());
        Err(self.error(key, format!("\"{key}\" must be from {low} to {high} {unit}")))
    }

    /// A time in seconds within a range, as nanoseconds.
    pub(super) fn nanoseconds(
        &self,
        key: &str,
        range: RangeInclusive<f32>,
    ) -> Result<Option<i64>, SceneError> {
        self.number_within(key, range, "seconds")?;
        Ok(self.get(key).and_then(finite_double).map(|seconds| (seconds * 1e9).round() as i64))
    }

    /// Any number of numbers.
    pub(super) fn number_list(&self, key: &str) -> Result<Option<Vec<f32>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let wrong = || self.wrong_type(key, "finite numbers in brackets");
        let array = value.as_array().ok_or_else(wrong)?;
        let numbers: Option<Vec<f32>> = array.iter().map(|item| finite_number(item.get_ref())).collect();
        numbers.map(Some).ok_or_else(wrong)
    }

    pub(super) fn numbers<const N: usize>(&self, key: &str) -> Result<Option<[f32; N]>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let wrong = || self.wrong_type(key, &format!("{N} finite numbers in brackets"));
        let array = value.as_array().ok_or_else(wrong)?;
        let count = array.iter().count();
        if count != N {
            let problem = format!("\"{key}\" of {} has {count} numbers; it must have {N}", self.what);
            return Err(self.error(key, problem));
        }
        let numbers: Option<Vec<f32>> = array.iter().map(|item| finite_number(item.get_ref())).collect();
        numbers.and_then(|numbers| numbers.try_into().ok()).map(Some).ok_or_else(wrong)
    }

    /// A place or a step in metres.
    pub(super) fn vector_m(&self, key: &str) -> Result<Option<Vec3>, SceneError> {
        let vector = self.numbers::<3>(key)?.map(Vec3::from_array);
        match vector {
            Some(vector) if vector.abs().max_element() > MAX_COORDINATE_M => {
                Err(self.error(key, format!("\"{key}\" lies more than {MAX_COORDINATE_M} m away")))
            }
            other => Ok(other),
        }
    }

    /// A direction, made unit length; `meaning` says which way it points.
    pub(super) fn direction(&self, key: &str, meaning: &str) -> Result<Option<Vec3>, SceneError> {
        let Some(vector) = self.numbers::<3>(key)?.map(Vec3::from_array) else { return Ok(None) };
        let problem = || self.error(key, format!("\"{key}\" has no length; it is {meaning}"));
        vector.try_normalize().map(Some).ok_or_else(problem)
    }

    /// Linear RGB, not negative.
    pub(super) fn colour(&self, key: &str) -> Result<Option<Vec3>, SceneError> {
        let colour = self.numbers::<3>(key)?.map(Vec3::from_array);
        match colour {
            Some(colour) if colour.min_element() < 0.0 => {
                Err(self.error(key, format!("\"{key}\" cannot be negative")))
            }
            other => Ok(other),
        }
    }

    pub(super) fn table(&self, key: &'a str, known: &[&str]) -> Result<Option<Fields<'a>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let table = value.as_table().ok_or_else(|| self.wrong_type(key, "a table"))?;
        Fields::new(self.source, key, table, self.line_of(key), known).map(Some)
    }

    pub(super) fn table_by_either_name(
        &self,
        key: &'a str,
        other: &'a str,
        known: &[&str],
    ) -> Result<Option<Fields<'a>>, SceneError> {
        if self.has(key) && self.has(other) {
            let problem = format!("[{key}] and [{other}] are synonyms; keep one");
            return Err(self.error(other, problem));
        }
        Ok(self.table(key, known)?.or(self.table(other, known)?))
    }

    /// An array of tables, `[[key]]`.
    pub(super) fn tables(&self, key: &'a str, known: &[&str]) -> Result<Vec<Fields<'a>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(Vec::new()) };
        let wrong = || self.wrong_type(key, &format!("a list: write [[{key}]]"));
        let mut tables = Vec::new();
        for item in value.as_array().ok_or_else(wrong)?.iter() {
            let table = item.get_ref().as_table().ok_or_else(wrong)?;
            tables.push(Fields::new(self.source, key, table, self.source.line(item.span().start), known)?);
        }
        Ok(tables)
    }
}

fn finite_number(value: &DeValue) -> Option<f32> {
    let number = finite_double(value)? as f32;
    number.is_finite().then_some(number)
}

fn finite_double(value: &DeValue) -> Option<f64> {
    let number: f64 = match value {
        DeValue::Float(float) => float.as_str().parse().ok()?,
        DeValue::Integer(integer) => i64::from_str_radix(integer.as_str(), integer.radix()).ok()? as f64,
        _ => return None,
    };
    number.is_finite().then_some(number)
}
