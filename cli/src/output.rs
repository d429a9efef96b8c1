//! What a command prints: text for people or JSON for programs, and progress on a terminal or as lines.

use std::{
    io::{IsTerminal, Write},
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

/// Where results go.
#[derive(Clone, Copy)]
pub struct Output {
    pub json: bool,
}

impl Output {
    /// Prints a result: `text` for people, or the value as JSON.
    pub fn result(&self, value: &impl Serialize, text: impl FnOnce() -> String) {
        let line = if self.json {
            serde_json::to_string(value).expect("results are plain data")
        } else {
            text()
        };
        // A closed pipe (`| head`) is not an error worth a message.
        let _ = writeln!(std::io::stdout(), "{}", line.trim_end());
    }

    /// A remark for people on stderr; silent with --json.
    pub fn say(&self, text: impl AsRef<str>) {
        if !self.json {
            eprintln!("{}", text.as_ref());
        }
    }
}

/// Progress of one thing: a bar on a terminal, a line now and then elsewhere.
pub struct Meter {
    bar: Option<ProgressBar>,
    quiet: bool,
    last: Option<(Instant, String)>,
}

impl Meter {
    const BETWEEN_LINES: Duration = Duration::from_secs(10);

    pub fn new(output: Output) -> Self {
        let bar = (!output.json && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(1000);
            bar.set_style(
                ProgressStyle::with_template("{bar:32.cyan/dim} {msg}")
                    .expect("a constant template"),
            );
            bar.enable_steady_tick(Duration::from_millis(200));
            bar
        });
        Self {
            bar,
            quiet: output.json,
            last: None,
        }
    }

    /// Shows `fraction` in [0, 1] and a message.
    pub fn at(&mut self, fraction: f64, message: String) {
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
                    eprintln!("[{:3.0}%] {message}", fraction * 100.0);
                    self.last = Some((Instant::now(), message));
                }
            }
        }
    }

    /// Prints a line above the bar.
    pub fn line(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None if self.quiet => {}
            None => eprintln!("{text}"),
        }
    }

    pub fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Plain text columns, aligned; the first row is the header.
pub fn table(rows: &[Vec<String>]) -> String {
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

/// "1.5 s", "2 min 05 s", "3 h 10 min".
pub fn duration(seconds: f64) -> String {
    let s = seconds.max(0.0);
    let whole = s.round() as u64;
    match whole {
        0..=59 => format!("{s:.1} s"),
        60..=3599 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// "512 B", "20.1 MB", "1.9 TB" (powers of ten).
pub fn bytes(n: u64) -> String {
    let mut value = n as f64;
    for unit in ["B", "kB", "MB", "GB"] {
        if value < 1000.0 {
            return if unit == "B" {
                format!("{n} B")
            } else {
                format!("{value:.1} {unit}")
            };
        }
        value /= 1000.0;
    }
    format!("{value:.2} TB")
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
