//! Two ascending lists as one, without a list of its own.

use std::cmp::Ordering;

/// Two ascending iterators as one; of what both have that of the second.
pub(crate) fn merged<T>(
    first: impl Iterator<Item = T>,
    second: impl Iterator<Item = T>,
    order: impl Fn(&T, &T) -> Ordering,
) -> impl Iterator<Item = T> {
    let (mut first, mut second) = (first.peekable(), second.peekable());
    std::iter::from_fn(move || match (first.peek(), second.peek()) {
        (Some(a), Some(b)) => match order(a, b) {
            Ordering::Less => first.next(),
            Ordering::Equal => {
                first.next();
                second.next()
            }
            Ordering::Greater => second.next(),
        },
        (Some(_), None) => first.next(),
        (None, _) => second.next(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_what_both_have_that_of_the_second_is_given() {
        let of = |number: &'static [u32], name: char| number.iter().map(move |number| (*number, name));
        let both = |a, b| merged(of(a, 'a'), of(b, 'b'), |a, b| a.0.cmp(&b.0)).collect::<Vec<_>>();
        assert_eq!(both(&[1, 3, 4], &[2, 3, 9]), [(1, 'a'), (2, 'b'), (3, 'b'), (4, 'a'), (9, 'b')]);
        assert_eq!(both(&[], &[5]), [(5, 'b')]);
        assert_eq!(both(&[5, 6], &[]), [(5, 'a'), (6, 'a')]);
    }
}
