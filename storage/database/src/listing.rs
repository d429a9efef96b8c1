//! Code shared by both databases for the job list and for the deletion of old jobs.

use uuid::Uuid;

/// The number of jobs or result sets examined in one deletion transaction.
pub(crate) const JOBS: i64 = 200;
/// The maximum number of rows deleted in one transaction, which takes about ten milliseconds.
pub(crate) const ROWS: i64 = 4_000;

/// Returns the number of a job that a text gives: up to nine digits. The primary key of a job is
/// its number.
pub(crate) fn number(text: &str) -> Option<i64> {
    let digits = (1..=9).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    digits.then(|| text.parse().ok())?
}

/// Returns the first and the last id with this prefix, if it is a prefix of an id and no number.
pub(crate) fn ids(text: &str) -> Option<(Uuid, Uuid)> {
    if number(text).is_some() {
        return None;
    }
    let digits: String = text.chars().filter(|c| *c != '-').collect();
    let hex =
        !digits.is_empty() && digits.len() <= 32 && digits.chars().all(|c| c.is_ascii_hexdigit());
    let fill = |with: &str| {
        let whole = format!("{digits}{}", with.repeat(32 - digits.len()));
        Uuid::parse_str(&whole).ok()
    };
    hex.then(|| Some((fill("0")?, fill("f")?)))?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_beginning_of_an_id_stands_for_all_that_begin_so() {
        let id = Uuid::from_u128(0x0123_4567_89ab_cdef_0123_4567_89ab_cdef);
        let text = id.to_string();
        for end in 10..=text.len() {
            let (first, last) = ids(&text[..end]).unwrap();
            assert!((first..=last).contains(&id), "{end}");
        }
        assert_eq!(ids(&text), Some((id, id)));
        assert_eq!((number("12"), ids("12")), (Some(12), None));
        assert_eq!((number("1a"), number(""), number("-1")), (None, None, None));
        assert!(ids("0123-4").is_some() && ids("1a").is_some());
        for none in ["", "-", "xyz", &"0".repeat(33), "été"] {
            assert_eq!(ids(none), None, "{none}");
        }
    }
}
