//! The least of a list, in order, for as long as they are wanted: of a long list of which few are, without sorting the rest.

/// What is sorted at first.
const FIRST: usize = 256;

/// Sorts a list ascending by `key` as far as `is_wanted` holds, which is asked of one after the other. Gives how many are wanted: these come
/// first. No two keys are alike.
pub(crate) fn sort_while<T, K: Ord>(
    list: &mut [T],
    key: impl Fn(&T) -> K,
    mut is_wanted: impl FnMut(&T) -> bool,
) -> usize {
    let (mut wanted, mut next) = (0, FIRST);
    while wanted < list.len() {
        let rest = &mut list[wanted..];
        let count = next.min(rest.len());
        if count < rest.len() {
            rest.select_nth_unstable_by_key(count, &key);
        }
        rest[..count].sort_unstable_by_key(&key);
        let among = rest[..count].iter().take_while(|item| is_wanted(item)).count();
        wanted += among;
        if among < count {
            break;
        }
        next *= 2;
    }
    wanted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_are_wanted_as_of_a_sorted_list_and_they_come_first() {
        let list: Vec<u32> = (0..2000u32).map(|number| number.wrapping_mul(2_654_435_761)).collect();
        let mut sorted = list.clone();
        sorted.sort_unstable();
        for most in [0, 1, FIRST, FIRST + 1, 3 * FIRST, 3 * FIRST + 7, 2000, 5000] {
            let (mut some, mut left) = (list.clone(), most);
            let is_wanted = |_: &u32| {
                left = left.wrapping_sub(1);
                left != usize::MAX
            };
            let wanted = sort_while(&mut some, |number| *number, is_wanted);
            assert_eq!(wanted, most.min(2000));
            assert_eq!(some[..wanted], sorted[..wanted]);
            some.sort_unstable();
            assert_eq!(some, sorted, "the same list");
        }
    }
}
