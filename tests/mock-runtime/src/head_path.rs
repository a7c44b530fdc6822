//! The scripted head: a CSV file of poses over time, and the pose at any time between its rows.
//!
//! Pure: text in, poses out. The runtime plays it, and the lab asks the same path for the true pose of a frame.

use std::fmt;

use glam::{Quat, Vec3};
use shadecast_protocol::pose::Pose;

/// The columns of a head path, in order; a first line with these names is allowed and skipped.
pub const COLUMNS: &str = "t_s,x,y,z,qx,qy,qz,qw";

/// Height of the head above the stage's floor where no path is given, metres.
pub const STANDING_HEIGHT_M: f32 = 1.6;

/// Poses of the head in the stage's frame (metres, y up, -z forward) at strictly increasing times.
#[derive(Clone, Debug, PartialEq)]
pub struct HeadPath {
    rows: Vec<Row>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    t_s: f64,
    stage_from_head: Pose,
}

/// Why a head path was refused: the file, the line, the reason and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name}:{line}: {fault}")]
pub struct HeadPathError {
    /// Name of the file as it was given to the parser.
    pub name: String,
    /// Line number, from 1.
    pub line: usize,
    fault: RowFault,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum RowFault {
    Empty,
    Columns(usize),
    Number { column: &'static str, text: String },
    Time { previous: String, this: String },
    Rotation(String),
}

impl fmt::Display for RowFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(f, "the head path has no rows; write at least one line of {COLUMNS}"),
            Self::Columns(found) => write!(f, "{found} columns where 8 are needed; write {COLUMNS}"),
            Self::Number { column, text } => {
                write!(f, "column {column} is {text:?}, which is not a finite number; write it like 1.25")
            }
            Self::Time { previous, this } => {
                write!(
                    f,
                    "time {this} s does not come after {previous} s; sort the rows by t_s, without repeats"
                )
            }
            Self::Rotation(length) => {
                write!(
                    f,
                    "the quaternion qx,qy,qz,qw has length {length}; it must be 1 within 1 %, normalise it"
                )
            }
        }
    }
}

impl HeadPath {
    /// Reads the CSV text of a head path; `name` is the file's name for error messages.
    /// Blank lines and lines that begin with `#` are skipped.
    pub fn parse(text: &str, name: &str) -> Result<Self, HeadPathError> {
        let mut rows: Vec<Row> = Vec::new();
        for (index, line) in text.lines().enumerate() {
            let line = line.trim();
            let blank = line.is_empty() || line.starts_with('#');
            if blank || (rows.is_empty() && is_header(line)) {
                continue;
            }
            let row = parse_row(line, rows.last()).map_err(|fault| HeadPathError {
                name: name.to_owned(),
                line: index + 1,
                fault,
            })?;
            rows.push(row);
        }
        if rows.is_empty() {
            return Err(HeadPathError { name: name.to_owned(), line: 1, fault: RowFault::Empty });
        }
        Ok(Self { rows })
    }

    /// A head that stands still at the stage's origin, [`STANDING_HEIGHT_M`] above the floor, looking along -z.
    pub fn standing() -> Self {
        let position = Vec3::new(0.0, STANDING_HEIGHT_M, 0.0);
        let stage_from_head = Pose { position, orientation: Quat::IDENTITY };
        Self { rows: vec![Row { t_s: 0.0, stage_from_head }] }
    }

    /// Pose of the head in the stage at `t_s` seconds of the path. Between rows positions are interpolated
    /// linearly and rotations along the shortest arc; before the first and after the last row the pose holds.
    pub fn pose_at(&self, t_s: f64) -> Pose {
        let after = self.rows.partition_point(|row| row.t_s <= t_s);
        let (Some(before), Some(next)) = (after.checked_sub(1).map(|i| self.rows[i]), self.rows.get(after))
        else {
            return self.rows[after.min(self.rows.len() - 1)].stage_from_head;
        };
        let share = ((t_s - before.t_s) / (next.t_s - before.t_s)) as f32;
        let (a, b) = (before.stage_from_head, next.stage_from_head);
        Pose {
            position: a.position.lerp(b.position, share),
            orientation: a.orientation.slerp(b.orientation, share).normalize(),
        }
    }

    /// Time of the last row, seconds.
    pub fn end_s(&self) -> f64 {
        self.rows.last().map_or(0.0, |row| row.t_s)
    }
}

/// True for a line that names its columns: its first field is a word.
fn is_header(line: &str) -> bool {
    let first = line.split(',').next().unwrap_or_default().trim();
    first.starts_with(|c: char| c.is_ascii_alphabetic()) && first.parse::<f64>().is_err()
}

fn parse_row(line: &str, previous: Option<&Row>) -> Result<Row, RowFault> {
    let fields: Vec<&str> = line.split(',').map(str::trim).collect();
    if fields.len() != 8 {
        return Err(RowFault::Columns(fields.len()));
    }
    let mut values = [0f64; 8];
    for ((value, column), text) in values.iter_mut().zip(COLUMNS.split(',')).zip(&fields) {
        *value = finite(text).ok_or_else(|| RowFault::Number { column, text: (*text).to_owned() })?;
    }
    let [t_s, x, y, z, qx, qy, qz, qw] = values;
    if let Some(previous) = previous.filter(|previous| previous.t_s >= t_s) {
        return Err(RowFault::Time { previous: previous.t_s.to_string(), this: t_s.to_string() });
    }
    let orientation = Quat::from_xyzw(qx as f32, qy as f32, qz as f32, qw as f32);
    let length = orientation.length();
    if (length - 1.0).abs() > 0.01 {
        return Err(RowFault::Rotation(format!("{length:.4}")));
    }
    let position = Vec3::new(x as f32, y as f32, z as f32);
    Ok(Row { t_s, stage_from_head: Pose { position, orientation: orientation.normalize() } })
}

/// A number that stays finite as an `f32`, which is what poses are made of.
fn finite(text: &str) -> Option<f64> {
    text.parse::<f64>().ok().filter(|value| (*value as f32).is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_ROWS: &str = "t_s,x,y,z,qx,qy,qz,qw\n0,0,1.6,0,0,0,0,1\n2,1,1.6,-2,0,0.70710678,0,0.70710678\n";

    #[track_caller]
    fn refused(text: &str) -> String {
        HeadPath::parse(text, "walk.csv").expect_err("must be refused").to_string()
    }

    #[test]
    fn halfway_between_two_rows_is_half_the_way_and_half_the_turn() {
        let path = HeadPath::parse(TWO_ROWS, "walk.csv").expect("valid");
        let pose = path.pose_at(1.0);
        assert!((pose.position - Vec3::new(0.5, 1.6, -1.0)).length() < 1e-6, "{pose:?}");
        let turn = pose.orientation.angle_between(Quat::IDENTITY);
        assert!((turn - 45f32.to_radians()).abs() < 1e-3, "{turn}");
    }

    #[test]
    fn the_pose_holds_before_the_first_and_after_the_last_row() {
        let path = HeadPath::parse(TWO_ROWS, "walk.csv").expect("valid");
        assert_eq!(path.pose_at(-5.0), path.pose_at(0.0));
        assert_eq!(path.pose_at(99.0), path.pose_at(2.0));
        assert_eq!(path.pose_at(2.0).position, Vec3::new(1.0, 1.6, -2.0));
        assert_eq!(path.end_s(), 2.0);
    }

    #[test]
    fn rotations_of_opposite_sign_take_the_shortest_arc() {
        let text = "0,0,0,0,0,0,0,1\n1,0,0,0,0,-0.1736482,0,-0.9848078";
        let pose = HeadPath::parse(text, "p").expect("valid").pose_at(0.5);
        assert!(pose.orientation.angle_between(Quat::IDENTITY) < 11f32.to_radians(), "{pose:?}");
    }

    #[test]
    fn header_comments_and_blank_lines_are_optional() {
        let bare = "0,0,1.6,0,0,0,0,1\r\n\r\n# a comment\r\n2,1,1.6,-2,0,0.70710678,0,0.70710678";
        assert_eq!(HeadPath::parse(bare, "a"), HeadPath::parse(TWO_ROWS, "b"));
    }

    #[test]
    fn errors_name_the_file_the_line_and_the_remedy() {
        assert!(refused("").starts_with("walk.csv:1: the head path has no rows; write"));
        assert!(
            refused("t_s,x\n0,0,0\n").starts_with("walk.csv:2: 3 columns where 8 are needed; write t_s,x")
        );
        let number = refused("0,0,0,0,0,0,0,1\n1,0,up,0,0,0,0,1");
        assert!(number.starts_with("walk.csv:2: column y is \"up\""), "{number}");
        assert!(refused("0,nan,0,0,0,0,0,1").contains("column x"));
        assert!(refused("0,1e300,0,0,0,0,0,1").contains("column x"));
        let order = refused("1,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1");
        assert!(order.starts_with("walk.csv:2: time 1 s does not come after 1 s; sort"), "{order}");
        assert!(refused("0,0,0,0,0,0,0,2").contains("length 2.0000; it must be 1"));
    }

    #[test]
    fn a_second_header_is_an_error() {
        assert!(refused("0,0,0,0,0,0,0,1\nt_s,x,y,z,qx,qy,qz,qw").starts_with("walk.csv:2: column t_s"));
    }
}
