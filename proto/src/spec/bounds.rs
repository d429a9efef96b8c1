//! Bounds on the length of texts and the size of numbers from outside, and their checks. All bounds
//! are in this module.
//!
//! There are two rules. A *name* (of a job, a data set, a worker, a store; any text of a job)
//! beyond its bound is refused with the name of its field, because the sender can send another. A
//! *free text* (an error message, a log line, a reason) is made printable and cut, because refusing
//! it would lose an honest worker's report.

/// Bytes of a name: of a job, stage, data set, split, model, report, worker, user. A store's place
/// and two names with a few letters between them form one index entry of the catalog, and Postgres
/// allows at most 2,704 bytes there.
pub const NAME_BYTES: usize = 200;
/// Bytes of a store's place, or of another path or URL that the catalog indexes.
pub const PLACE_BYTES: usize = 1024;
/// Bytes of any other text of a job: a path's limit on Linux.
pub const TEXT_BYTES: usize = 4096;
/// Bytes of a message. It is stored for each failed task and repeated in the history.
pub const MESSAGE_BYTES: usize = 4096;
/// Labels, assets or kinds that a worker names, and labels that a stage requires.
pub const LIST: usize = 256;
/// Leases that a worker names at a time. A message of 1 MiB has room for some 20,000.
pub const LEASES: usize = 16_384;
/// Running tasks of a job with a full description in its status, some 1 MB with the longest texts.
/// Further tasks only show their worker and progress. A status is sent a few times a second.
pub const RUNNING: usize = 1_000;
/// Seconds that a task may have taken: some thirty years.
pub const SECONDS: f64 = 1e9;
/// Bytes that a task may have published. The databases' integers are signed.
pub const BYTES: u64 = i64::MAX as u64;

/// Returns whether a character controls a terminal: control characters, line separators, and
/// characters that change the direction of writing.
pub fn steers(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Checks a name.
///
/// # Errors
/// Returns a description of the fault.
pub fn name(text: &str, most: usize) -> Result<(), String> {
    if let Some(c) = text.chars().find(|c| steers(*c)) {
        return Err(control(c));
    }
    length(text.len(), most)
}

/// Returns the error for a text with a control character.
pub(super) fn control(c: char) -> String {
    format!(
        "holds the control character U+{:04X}; remove it",
        u32::from(c)
    )
}

/// Checks the length of a text.
pub(super) fn length(bytes: usize, most: usize) -> Result<(), String> {
    match bytes > most {
        true => Err(format!("is {bytes} bytes long; at most {most} are allowed")),
        false => Ok(()),
    }
}

/// Returns a free text as it is stored: printable, and at most [`MESSAGE_BYTES`].
pub fn message(text: &str) -> String {
    cut(text, MESSAGE_BYTES)
}

/// Quotes a name from elsewhere for use in a message.
pub fn quoted(text: &str) -> String {
    format!("{:?}", cut(text, NAME_BYTES))
}

/// Returns the beginning of a text in at most `most` bytes (at least 8), printable.
pub fn cut(text: &str, most: usize) -> String {
    const MARK: &str = " …";
    let shown = |c: char| if steers(c) { ' ' } else { c };
    // A control character becomes a space, so the text only gets shorter.
    if text.len() <= most {
        return text.chars().map(shown).collect();
    }
    let end = text.floor_char_boundary(most - MARK.len());
    let mut short: String = text[..end].chars().map(shown).collect();
    short.push_str(MARK);
    short
}

/// Checks the duration of a task.
///
/// # Errors
/// Returns a description of the fault.
pub fn seconds(value: f64) -> Result<f64, String> {
    match (0.0..=SECONDS).contains(&value) {
        true => Ok(value),
        false => Err(format!(
            "{value:e} is no time that a task can take; expected 0 to {SECONDS:e} seconds"
        )),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn what_is_cut_is_printable_and_no_longer_than_allowed(text in ".*", most in 8usize..40) {
            let short = cut(&text, most);
            prop_assert!(short.len() <= most.max(8));
            prop_assert!(!short.chars().any(steers));
            if text.len() <= most && !text.chars().any(steers) {
                prop_assert_eq!(short, text);
            }
        }

        #[test]
        fn only_times_that_can_be_are_taken(value in any::<f64>()) {
            prop_assert_eq!(seconds(value).is_ok(), (0.0..=1e9).contains(&value));
        }
    }
}
