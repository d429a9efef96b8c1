//! Log lines of tasks, and their limits. Worker and coordinator count by the same rule:
//! the worker to avoid sending more, the coordinator because it trusts no worker.

use std::fmt;

use crate::{ids::LeaseRef, spec::bounds::steers};

/// Most lines kept for a task.
pub const LINES: usize = 200;
/// Most bytes of text kept for a task.
pub const BYTES: usize = 16 << 10;
/// Longest line, bytes.
pub const LINE_BYTES: usize = 2 << 10;

/// Prefix of a line that states the quality of a task's result. `job watch` shows such lines when
/// the job ends.
pub const VERDICT: &str = "verdict: ";

/// How a task's line begins that says why its scene is without light; where a job ends, such scenes
/// are counted.
pub const DARK: &str = "dark: ";

/// What a line of a task's history says behind its level and one of these marks: whether it is a
/// warning, and the rest.
pub fn marked<'a>(message: &'a str, mark: &str) -> Option<(bool, &'a str)> {
    let (level, rest) = message.split_once(": ")?;
    let warns = level == LogLevel::Warn.name();
    Some((warns, rest.strip_prefix(mark)?))
}

/// How grave a line is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogLevel {
    /// The task cannot continue.
    Error,
    /// The task continues, but somebody should know.
    Warn,
    /// Information about the task.
    Info,
}

impl LogLevel {
    /// Its name, with which a line in a history begins.
    pub fn name(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
        }
    }
}

impl fmt::Display for LogLevel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogLine {
    /// Milliseconds between writing and sending the line.
    pub ago_ms: u32,
    /// Severity.
    pub level: LogLevel,
    /// Text.
    pub text: String,
}

/// Lines of one task, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskLog {
    /// Lease of the task.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// The lines.
    pub lines: Vec<LogLine>,
}

/// The remaining log allowance of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogAllowance {
    lines: usize,
    bytes: usize,
}

impl Default for LogAllowance {
    fn default() -> Self {
        Self {
            lines: LINES,
            bytes: BYTES,
        }
    }
}

impl LogAllowance {
    /// Deducts a line of `bytes` bytes. Returns `false` if the allowance is too small, and then for
    /// every later line.
    #[must_use]
    pub fn take(&mut self, bytes: usize) -> bool {
        if self.lines == 0 || bytes > self.bytes {
            self.lines = 0;
            return false;
        }
        self.lines -= 1;
        self.bytes -= bytes;
        true
    }
}

/// Returns a printable text: characters that control a terminal become spaces.
pub fn printable(text: &str) -> String {
    let shown = |c: char| if steers(c) { ' ' } else { c };
    text.chars().map(shown).collect()
}

/// Cuts a text between two characters so that it fits into a line.
pub fn cut(text: &mut String) {
    if text.len() > LINE_BYTES {
        const MARK: &str = " …";
        text.truncate(text.floor_char_boundary(LINE_BYTES - MARK.len()));
        text.push_str(MARK);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_allowance_ends_with_the_lines_or_with_the_bytes_and_never_begins_again() {
        let mut many = LogAllowance::default();
        assert_eq!((0..1000).filter(|_| many.take(1)).count(), LINES);
        let mut long = LogAllowance::default();
        assert_eq!(
            (0..1000).filter(|_| long.take(LINE_BYTES)).count(),
            BYTES / LINE_BYTES
        );
        let mut gap = LogAllowance::default();
        assert!(
            !gap.take(BYTES + 1) && !gap.take(1),
            "no line from behind a gap"
        );
    }

    #[test]
    fn a_line_that_is_too_long_is_cut_between_characters() {
        let mut text = "ü".repeat(LINE_BYTES);
        cut(&mut text);
        assert!(
            text.len() <= LINE_BYTES && text.ends_with(" …"),
            "{}",
            text.len()
        );
        assert_eq!(printable("\u{1b}[31mred\r\nü"), " [31mred  ü");
    }
}
