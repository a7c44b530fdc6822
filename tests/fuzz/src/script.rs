//! Sequences of operations as bytes: recorded traffic, and what libFuzzer makes of it.
//!
//! A step is an operation (one byte), the length of its bytes (`u32`, little-endian), and these. A length beyond the end
//! means what is left, so that a script that was cut is one too.

/// Steps of a script that are looked at: longer ones only cost time.
const MAX_STEPS: usize = 2000;

/// One operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step<'a> {
    /// Which.
    pub operation: u8,
    /// With what.
    pub bytes: &'a [u8],
}

/// The steps of a script.
pub fn steps(script: &[u8]) -> impl Iterator<Item = Step<'_>> {
    let mut rest = script;
    let next = move || {
        let (&operation, after) = rest.split_first()?;
        let (length, after) = after.split_first_chunk::<4>()?;
        let length = (u32::from_le_bytes(*length) as usize).min(after.len());
        let (bytes, after) = after.split_at(length);
        rest = after;
        Some(Step { operation, bytes })
    };
    std::iter::from_fn(next).take(MAX_STEPS)
}

/// Appends a step to a script.
pub fn put_step(script: &mut Vec<u8>, operation: u8, bytes: &[u8]) {
    script.push(operation);
    script.extend((bytes.len() as u32).to_le_bytes());
    script.extend(bytes);
}

/// The first bytes of a step as a number; missing ones are zero.
pub(crate) fn number(bytes: &[u8]) -> u64 {
    let mut word = [0; 8];
    let count = bytes.len().min(8);
    word[..count].copy_from_slice(&bytes[..count]);
    u64::from_le_bytes(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_put_comes_back_and_a_cut_script_is_one() {
        let mut script = Vec::new();
        put_step(&mut script, 3, b"abc");
        put_step(&mut script, 0, b"");
        put_step(&mut script, 255, &[7; 300]);
        let read: Vec<_> = steps(&script).map(|step| (step.operation, step.bytes.len())).collect();
        assert_eq!(read, [(3, 3), (0, 0), (255, 300)]);
        let cut: Vec<_> = steps(&script[..script.len() - 1]).collect();
        assert_eq!(cut[2], Step { operation: 255, bytes: &[7; 299] });
        assert_eq!(steps(&[]).count(), 0);
    }
}
