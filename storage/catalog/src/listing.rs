//! Many jobs at a time: a page of the list of them, and what is forgotten.

use picofarm_proto::model::{JobState, JobSummary};
use uuid::Uuid;

use crate::Sight;

/// Jobs or result sets looked at in one transaction of forgetting.
pub(crate) const JOBS: i64 = 200;
/// Rows removed in one, at most: some ten milliseconds.
pub(crate) const ROWS: i64 = 4_000;

/// Which jobs of the list.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct JobQuery {
    /// Whose.
    pub sight: Sight,
    /// Only those recorded before the last of another page ([`Page::next`]).
    pub before: Option<i64>,
    /// At most this many.
    pub limit: u32,
    /// Only those that stand so.
    pub state: Option<JobState>,
    /// Only this user's.
    pub user: Option<String>,
    /// Only those of this name, or whose id begins so.
    pub find: Option<String>,
}

/// Part of the list.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Page {
    /// The last recorded first.
    pub jobs: Vec<JobSummary>,
    /// Where the next page begins; `None` where this is the last.
    pub next: Option<i64>,
}

/// What one transaction of forgetting did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Forgotten {
    /// Jobs that are gone.
    pub jobs: u32,
    /// There may be more to forget.
    pub more: bool,
}

/// The first and the last id that begin with this text, if it begins one.
pub(crate) fn ids(text: &str) -> Option<(Uuid, Uuid)> {
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
        for end in 1..=text.len() {
            let (first, last) = ids(&text[..end]).unwrap();
            assert!((first..=last).contains(&id), "{end}");
        }
        assert_eq!(ids(&text), Some((id, id)));
        for none in ["", "-", "xyz", &"0".repeat(33), "été"] {
            assert_eq!(ids(none), None, "{none}");
        }
    }
}
