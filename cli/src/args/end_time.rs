//! End time of a worker: from its own option, or from the Slurm job in which it runs.

use std::time::{Duration, SystemTime};

use crate::error::{CliError, Result};

/// Environment variable with the end of the Slurm job, in Unix seconds.
const SLURM: &str = "SLURM_JOB_END_TIME";
/// Time before the end of the Slurm job at which a worker stops, as with `--signal=B:TERM@60`.
const BEFORE: Duration = Duration::from_secs(60);

/// A time, or a duration from the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndAt {
    /// Ends at this time.
    Time(SystemTime),
    /// Ends after this duration.
    After(Duration),
}

/// Parses `--end-at`.
///
/// # Errors
/// Fails if the text is neither a time nor a duration.
pub fn parse(text: &str) -> std::result::Result<EndAt, String> {
    if let Ok(time) = humantime::parse_rfc3339(text) {
        return Ok(EndAt::Time(time));
    }
    humantime::parse_duration(text)
        .map(EndAt::After)
        .map_err(|_| {
            "expected a time such as 2026-12-01T18:00:00Z or a duration such as 3h 50m".to_owned()
        })
}

/// Returns when the worker must end: as given, or a minute before its Slurm job ends.
///
/// # Errors
/// Fails if the time has passed, or if Slurm's end time is not a number.
pub fn ends_at(given: Option<EndAt>, now: SystemTime) -> Result<Option<SystemTime>> {
    if given.is_some() {
        return own(given, now);
    }
    slurms(std::env::var(SLURM).ok().as_deref(), now)
}

fn own(given: Option<EndAt>, now: SystemTime) -> Result<Option<SystemTime>> {
    let at = match given {
        None => return Ok(None),
        Some(EndAt::After(long)) => now.checked_add(long),
        Some(EndAt::Time(time)) => Some(time),
    };
    match at {
        Some(at) if at > now => Ok(Some(at)),
        Some(at) => Err(CliError::input(format!(
            "--end-at: {} has passed; give a time to come, or a duration such as 3h 50m",
            humantime::format_rfc3339_seconds(at)
        ))),
        None => Err(CliError::input(
            "--end-at: the duration is too long; give less, or leave it out",
        )),
    }
}

fn slurms(text: Option<&str>, now: SystemTime) -> Result<Option<SystemTime>> {
    let Some(text) = text.map(str::trim).filter(|t| !t.is_empty()) else {
        return Ok(None);
    };
    let seconds: u64 = text.parse().map_err(|_| {
        CliError::input(format!(
            "{SLURM}={text:?}: expected the end of the Slurm job in Unix seconds; unset it, or give --end-at"
        ))
    })?;
    let end = SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(seconds));
    // A Slurm job with an end in the past was extended; its new end is unknown here.
    let end = end.filter(|at| *at > now);
    if end.is_none() {
        tracing::warn!(
            seconds,
            "{SLURM} is no time to come; the end of the worker is not known"
        );
    }
    Ok(end.map(|at| at.checked_sub(BEFORE).map_or(now, |at| at.max(now))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unix_time(seconds: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(seconds)
    }

    #[test]
    fn the_end_is_a_time_or_a_duration_to_come() {
        let now = unix_time(1_000_000);
        let end = |text: &str| own(Some(parse(text).unwrap()), now);
        assert_eq!(end("3h 50m").unwrap(), Some(unix_time(1_000_000 + 13_800)));
        assert_eq!(
            end("1970-01-13T00:00:00Z").unwrap(),
            Some(unix_time(1_036_800))
        );
        assert_eq!(own(None, now).unwrap(), None);
        let late = end("1970-01-01T00:00:00Z").unwrap_err();
        assert!(late.message.contains("has passed"), "{}", late.message);
        assert!(parse("tomorrow").unwrap_err().contains("expected a time"));
    }

    #[test]
    fn a_slurm_job_ends_its_worker_a_minute_before() {
        let now = unix_time(1_000_000);
        assert_eq!(
            slurms(Some("1003600"), now).unwrap(),
            Some(unix_time(1_003_540))
        );
        assert_eq!(slurms(Some("1000030"), now).unwrap(), Some(now));
        assert_eq!(slurms(Some("999999"), now).unwrap(), None);
        assert_eq!(slurms(None, now).unwrap(), None);
        let error = slurms(Some("soon"), now).unwrap_err();
        assert!(
            error.message.contains("SLURM_JOB_END_TIME"),
            "{}",
            error.message
        );
    }
}
