//! Pieces of pages: escaped texts, times, numbers, states and bars.

use std::time::{SystemTime, UNIX_EPOCH};

use maud::{Markup, PreEscaped, html};
use picofarm_figures::{number, text::Safe};
use picofarm_proto::{
    ids::JobId,
    messages::{JobState, JobStatus, StageState, StageStatus, TaskCounts},
};

/// Escapes a text, also the characters that change the order of others.
pub fn safe(text: impl std::fmt::Display) -> PreEscaped<String> {
    PreEscaped(Safe(text).to_string())
}

/// Milliseconds since 1970.
pub fn now_ms() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |now| now.as_millis() as i64)
}

/// A length of time.
pub fn seconds(seconds: f64) -> String {
    match seconds {
        s if s < 0.0 => "0 s".into(),
        s if s < 10.0 => format!("{s:.1} s"),
        s if s < 60.0 => format!("{s:.0} s"),
        s => number::duration(s),
    }
}

/// A time: UTC, of today without the date.
pub fn time(at_ms: i64) -> Markup {
    let (date, clock) = date_and_clock(at_ms);
    let today = date_and_clock(now_ms()).0 == date;
    html! {
        time datetime={ (date) "T" (clock) "Z" } title={ (date) " " (clock) " UTC" } {
            @if !today { (date) " " }
            (clock)
        }
    }
}

/// Date and time of day, UTC (days to civil date: Hinnant, "chrono-compatible low-level date
/// algorithms").
fn date_and_clock(at_ms: i64) -> (String, String) {
    let seconds = at_ms.div_euclid(1000);
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let z = days + 719_468;
    let (era, doe) = (z.div_euclid(146_097), z.rem_euclid(146_097));
    let yoe = (doe - doe / 1460 + doe / 36_524 - doe / 146_096) / 365;
    let doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
    let mp = (5 * doy + 2) / 153;
    let day = doy - (153 * mp + 2) / 5 + 1;
    let month = if mp < 10 { mp + 3 } else { mp - 9 };
    let year = yoe + era * 400 + i64::from(month <= 2);
    let (hour, minute) = (second / 3600, second / 60 % 60);
    (
        format!("{year:04}-{month:02}-{day:02}"),
        format!("{hour:02}:{minute:02}:{:02}", second % 60),
    )
}

/// A number of bytes.
pub fn bytes(count: u64) -> String {
    match count {
        0..1000 => format!("{count} B"),
        count => format!("{}B", number::prefixed_short(count as f64)),
    }
}

/// The beginning of a job's id, as a link.
pub fn job_link(job: JobId) -> Markup {
    let id = job.to_string();
    // The first twelve digits are a time, so that fewer would be equal within a minute.
    let short = id.get(..13).unwrap_or(&id);
    html! { a.id href={ "/jobs/" (id) } title=(id) { (short) } }
}

/// The state of a job in a word, with its class.
pub fn job_state(
    state: JobState,
    paused: bool,
    counts: &TaskCounts,
) -> (&'static str, &'static str) {
    match state {
        JobState::Active if paused => ("paused", "wait"),
        JobState::Active if counts.leased > 0 => ("running", "run"),
        JobState::Active => ("waiting", "wait"),
        JobState::Done => ("done", "done"),
        JobState::Failed => ("failed", "bad"),
        JobState::Cancelled => ("cancelled", "off"),
    }
}

/// The state of a job's stage in a word, with its class.
pub fn stage_state(job: &JobStatus, stage: &StageStatus) -> (&'static str, &'static str) {
    match stage.state {
        StageState::Done => ("done", "done"),
        StageState::Failed => ("failed", "bad"),
        _ if job.state == JobState::Cancelled => ("cancelled", "off"),
        StageState::Open if stage.tasks.leased > 0 => ("running", "run"),
        _ if job.paused => ("paused", "wait"),
        StageState::Blocked => ("blocked", "wait"),
        StageState::Open => ("waiting", "wait"),
    }
}

/// The state of a job's tasks that are neither done nor dead and do not run, in a word.
pub fn rest_state(job: &JobStatus) -> &'static str {
    match job.state {
        JobState::Cancelled => "cancelled",
        JobState::Active if job.paused => "paused",
        _ => "pending",
    }
}

/// A state with a mark in its colour. The word says the same as the colour.
pub fn badge((word, class): (&'static str, &'static str)) -> Markup {
    html! { span.badge.(class) { (word) } }
}

/// A bar of finished, running and dead tasks.
pub fn bar(counts: &TaskCounts) -> Markup {
    let total = counts.total.max(1) as f64;
    let share = |n: u64| 100.0 * n as f64 / total;
    let [reused, done, leased, dead] = [
        counts.reused,
        counts.done - counts.reused.min(counts.done),
        counts.leased,
        counts.dead,
    ]
    .map(share);
    let label = format!(
        "{} of {} tasks done, {} running, {} dead",
        counts.done, counts.total, counts.leased, counts.dead
    );
    let mut at = 0.0;
    let parts = [
        ("reused", reused),
        ("done", done),
        ("bad", dead),
        ("run", leased),
    ];
    let parts = parts.map(|(class, width)| {
        let start = at;
        at += width;
        (class, start, width)
    });
    html! {
        svg.bar viewBox="0 0 100 4" preserveAspectRatio="none" role="img" aria-label=(label) {
            @for (class, start, width) in parts.iter().filter(|part| part.2 > 0.0) {
                rect.(class) x=(format!("{start:.2}")) y="0" width=(format!("{width:.2}")) height="4" {}
            }
        }
    }
}

/// A wide table that scrolls within itself.
pub fn scroll(label: &str, table: Markup) -> Markup {
    html! { div.scroll tabindex="0" role="region" aria-label=(label) { (table) } }
}

/// Done and all tasks.
pub fn count(counts: &TaskCounts) -> String {
    format!(
        "{} / {}",
        number::thousands(counts.done),
        number::thousands(counts.total)
    )
}

/// About how long the rest takes, if tasks have been measured and some run.
pub fn remaining(counts: &TaskCounts, mean: Option<f64>, running: usize) -> Option<f64> {
    let left = (counts.pending + counts.leased) as f64;
    let at_once = running.max(1) as f64;
    (left > 0.0 && running > 0).then(|| mean.map(|mean| left * mean / at_once))?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (ms, date, clock) in [
            (0, "1970-01-01", "00:00:00"),
            (951_827_696_000, "2000-02-29", "12:34:56"),
            (1_795_975_200_500, "2026-11-29", "18:00:00"),
            (-1_000, "1969-12-31", "23:59:59"),
        ] {
            assert_eq!(date_and_clock(ms), (date.to_owned(), clock.to_owned()));
        }
    }

    #[test]
    fn texts_of_others_are_escaped() {
        assert_eq!(safe("<b>\u{202e}&").into_string(), "&lt;b&gt;\u{fffd}&amp;");
    }

    #[test]
    fn the_parts_of_a_bar_fit_its_width() {
        let counts = TaskCounts {
            total: 8,
            done: 4,
            reused: 2,
            leased: 1,
            pending: 1,
            dead: 2,
        };
        let bar = bar(&counts).into_string();
        let widths = bar.split(" width=\"").skip(1);
        let sum: f64 = widths
            .map(|w| w.split('"').next().unwrap().parse::<f64>().unwrap())
            .sum();
        assert!((sum - 87.5).abs() < 0.1, "{bar}");
    }
}
