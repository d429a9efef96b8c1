//! Output of commands: text for people or JSON for programs, and progress as a bar on a terminal or
//! as lines.

pub mod describe;
pub mod files;
pub mod pace;

use std::{
    io::{ErrorKind, IsTerminal, Write},
    sync::OnceLock,
    time::{Duration, Instant},
};

use console::Term;
use indicatif::{ProgressBar, ProgressStyle};
use picofarm_proto::show;
use serde::Serialize;

use crate::error::{CliError, Result, io};

/// The error of the first failed write to stdout.
static UNPRINTED: OnceLock<std::io::Error> = OnceLock::new();

/// Writes to stdout. The command reports a failure at its end, by calling [`printed`].
pub fn print(bytes: &[u8]) {
    let mut stdout = std::io::stdout().lock();
    if let Err(error) = stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        // Only the first error is reported, because it is probably the cause of the others.
        let _ = UNPRINTED.set(error);
    }
}

/// Checks that all output has reached stdout.
///
/// # Errors
/// Fails if some output was lost, e.g. because the disk is full. A closed pipe (`| head`) is not
/// reported.
pub fn printed() -> Result<()> {
    match UNPRINTED.get() {
        Some(error) if error.kind() != ErrorKind::BrokenPipe => Err(unprinted(error)),
        _ => Ok(()),
    }
}

fn unprinted(error: &std::io::Error) -> CliError {
    CliError {
        message: format!("the result could not be written to standard output: {error}"),
        ..io("standard output", error)
    }
}

/// Writes a line to stderr. A failure is ignored, because it cannot be reported and the work
/// continues.
pub fn tell(line: impl std::fmt::Display) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Destination and format of results.
#[derive(Clone, Copy)]
pub struct Output {
    pub json: bool,
}

impl Output {
    /// Prints a result: `text` for people, or the value as JSON. Control characters are escaped in
    /// both. Text from others must pass through [`show::line`] before it becomes part of a line.
    pub fn result(&self, value: &impl Serialize, text: impl FnOnce() -> String) {
        let shown = if self.json {
            let document = serde_json::to_string(value).expect("results are plain data");
            show::json(&document).into_owned()
        } else {
            show::lines(&text()).into_owned()
        };
        print(format!("{}\n", shown.trim_end()).as_bytes());
    }

    /// Prints a warning on stderr: a line that begins with "warning: ", or an object {"warning": …}
    /// with --json.
    pub fn warn(&self, text: impl AsRef<str>) {
        let text = text.as_ref();
        if self.json {
            let warning = text.strip_prefix("warning: ").unwrap_or(text);
            let object = serde_json::json!({ "warning": warning });
            tell(show::json(&object.to_string()));
        } else {
            self.say(text);
        }
    }

    /// Prints a remark on stderr; does nothing with --json.
    pub fn say(&self, text: impl AsRef<str>) {
        if !self.json {
            tell(show::lines(text.as_ref()));
        }
    }
}

/// A writer of log lines, one per call, that escapes control characters.
pub struct Escaped<W>(pub W);

impl<W: Write> Write for Escaped<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let text = String::from_utf8_lossy(bytes);
        let (text, end) = match text.strip_suffix('\n') {
            Some(text) => (text, "\n"),
            None => (&*text, ""),
        };
        self.0
            .write_all(format!("{}{end}", show::line(text)).as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

/// Progress of one operation: a bar on a terminal, a line at intervals elsewhere.
pub struct Meter {
    bar: Option<ProgressBar>,
    quiet: bool,
    last: Option<(Instant, String)>,
    /// Number of terminal columns that the bar is fitted to.
    columns: u16,
}

/// Returns the layout of bar and message for a terminal with `columns` columns. The message is cut
/// to the remaining width.
fn template(columns: u16) -> &'static str {
    match columns {
        0..60 => "{percent:>3} % {wide_msg}",
        60..100 => "{bar:16.cyan/dim} {wide_msg}",
        _ => "{bar:32.cyan/dim} {wide_msg}",
    }
}

impl Meter {
    const BETWEEN_LINES: Duration = Duration::from_secs(10);

    pub fn new(output: Output) -> Self {
        let bar = (!output.json && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(1000);
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        let mut meter = Self {
            bar,
            quiet: output.json,
            last: None,
            columns: 0,
        };
        meter.fit();
        meter
    }

    /// Fits the bar to the current width of the terminal. A line wider than the terminal would
    /// wrap, and each redraw would leave a piece of it behind.
    fn fit(&mut self) {
        let Some(bar) = &self.bar else { return };
        let (_, columns) = Term::stderr().size();
        if columns != self.columns {
            self.columns = columns;
            let style = ProgressStyle::with_template(template(columns));
            bar.set_style(style.expect("a constant template"));
        }
    }

    /// Shows `fraction` in [0, 1] and a message.
    pub fn update(&mut self, fraction: f64, message: String) {
        let message = show::line(&message).into_owned();
        self.fit();
        match &self.bar {
            Some(bar) => {
                bar.set_position((fraction * 1000.0) as u64);
                bar.set_message(message);
            }
            None if self.quiet => {}
            None => {
                let due = self.last.as_ref().is_none_or(|(at, text)| {
                    at.elapsed() >= Self::BETWEEN_LINES || (fraction >= 1.0 && *text != message)
                });
                if due {
                    tell(format_args!("[{:3.0}%] {message}", fraction * 100.0));
                    self.last = Some((Instant::now(), message));
                }
            }
        }
    }

    /// Prints a line above the bar.
    pub fn line(&self, text: &str) {
        let text = show::line(text);
        match &self.bar {
            Some(bar) => bar.println(text),
            None if self.quiet => {}
            None => tell(text),
        }
    }

    pub fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Formats aligned text columns; the first row is the header. Each cell is escaped to one line.
pub fn table(rows: &[Vec<String>]) -> String {
    let cells = |row: &Vec<String>| {
        row.iter()
            .map(|cell| show::line(cell).into_owned())
            .collect()
    };
    let rows: Vec<Vec<String>> = rows.iter().map(cells).collect();
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| {
        rows.iter()
            .filter_map(|r| r.get(c))
            .map(|s| s.chars().count())
            .max()
            .unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    rows.iter()
        .map(|row| {
            let cells: Vec<String> = row
                .iter()
                .zip(&widths)
                .map(|(s, &w)| format!("{s:<w$}"))
                .collect();
            cells.join("  ").trim_end().to_owned() + "\n"
        })
        .collect()
}

/// Formats a duration: "1.5 s", "2 min 05 s", "3 h 10 min", "42 days", "more than 1,000 years".
pub fn duration(seconds: f64) -> String {
    const DAY: u64 = 86_400;
    const THOUSAND_YEARS: u64 = 365_250 * DAY;
    let s = seconds.max(0.0);
    let whole = s.round() as u64;
    match whole {
        0..=59 => format!("{s:.1} s"),
        60..=3599 => format!("{} min {:02} s", whole / 60, whole % 60),
        3600..864_000 => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
        864_000..THOUSAND_YEARS => format!("{} days", whole / DAY),
        _ => "more than 1,000 years".to_owned(),
    }
}

/// Returns the word that starts this program in the caller's shell: the path it was called by, such
/// as `target/release/picofarm` under `cargo run`, or its name if the shell found it by `PATH`.
pub fn program() -> String {
    let called = std::env::args().next().unwrap_or_default();
    // In another program, that is the other program's path.
    match called.contains('/') && !crate::has_host() {
        true => show::argument(&called).to_string(),
        false => "picofarm".to_owned(),
    }
}

/// Formats a size with powers of ten: "512 B", "20.1 MB", "1.9 TB".
pub fn bytes(n: u64) -> String {
    show::size(n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_read_well() {
        assert_eq!(bytes(512), "512 B");
        assert_eq!(bytes(20_100_000), "20.1 MB");
        assert_eq!(bytes(1_900_000_000_000), "1.90 TB");
        assert_eq!(duration(1.54), "1.5 s");
        assert_eq!(duration(125.0), "2 min 05 s");
        assert_eq!(duration(11_400.0), "3 h 10 min");
        assert_eq!(duration(864_000.0), "10 days");
        assert_eq!(duration(1e15), "more than 1,000 years");
    }

    #[test]
    fn bars_fit_their_terminal() {
        for columns in [0, 20, 59, 60, 80, 99, 100, 300] {
            let template = template(columns);
            let bar = template.split_once("{bar:").map_or(0, |(_, rest)| {
                rest[..2].parse().expect("a width of two digits")
            });
            assert!(bar < 60 || columns > bar + 20, "{columns}: {template}");
            assert!(bar + 20 <= columns.max(20), "{columns}: {template}");
            // Without it, a message would wrap.
            assert!(template.ends_with("{wide_msg}"));
            ProgressStyle::with_template(template).unwrap();
        }
    }

    #[test]
    fn a_cell_of_a_table_is_one_line_without_control_characters() {
        let evil = "w\u{1b}]0;t\u{7}\nforged  row\u{202e}".to_owned();
        let shown = table(&[vec!["worker".into()], vec![evil]]);
        assert_eq!(shown.lines().count(), 2, "{shown}");
        assert!(!shown.replace('\n', "").contains(char::is_control));
    }

    #[test]
    fn a_log_line_stays_one_line() {
        let mut written = Escaped(Vec::new());
        written
            .write_all("WARN worker=\u{1b}[31mx\nERROR forged\n".as_bytes())
            .unwrap();
        let text = String::from_utf8(written.0).unwrap();
        assert_eq!(text, "WARN worker=\\u{1b}[31mx\\nERROR forged\n");
    }

    #[test]
    fn tables_align() {
        let rows = vec![
            vec!["id".into(), "state".into()],
            vec!["longer".into(), "done".into()],
        ];
        assert_eq!(table(&rows), "id      state\nlonger  done\n");
    }
}
