//! The time at which a caller's access ends.

use std::{
    fmt,
    str::FromStr,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The time from which an entry of the token file is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Expiry(SystemTime);

const EXPECTED: &str = "expected a time from now, e.g. 90d or 12h, a date, e.g. 2027-03-01, or e.g. 2027-03-01T08:00:00Z";

impl Expiry {
    /// Parses `90d`, `2027-03-01` (its beginning, UTC) or `2027-03-01T08:00:00Z`.
    ///
    /// # Errors
    /// Returns an error if the text has none of these forms, or names a time that `now` has passed.
    pub fn parse(text: &str, now: SystemTime) -> Result<Self, String> {
        let at = match humantime::parse_duration(text) {
            Ok(after) => now.checked_add(after),
            Err(_) => Some(text.parse::<Self>()?.0),
        };
        // Later dates cannot be formatted.
        let last = UNIX_EPOCH + Duration::from_secs(253_402_300_799);
        let at = at
            .filter(|at| *at <= last)
            .ok_or_else(|| format!("{text:?} is after the year 9999; leave the expiry out"))?;
        if at <= now {
            return Err(format!("{text:?} is in the past; choose a later time"));
        }
        Ok(Self(at))
    }

    /// Creates an expiry from seconds since 1970.
    pub(crate) fn from_seconds(seconds: i64) -> Self {
        let distance = Duration::from_secs(seconds.unsigned_abs());
        let at = match seconds {
            0.. => UNIX_EPOCH.checked_add(distance),
            _ => UNIX_EPOCH.checked_sub(distance),
        };
        Self(at.unwrap_or(UNIX_EPOCH))
    }

    /// Returns whether access has ended.
    pub fn is_over(self, now: SystemTime) -> bool {
        now >= self.0
    }

    /// Waits until access has ended. The clock is read every half minute, because it may be set.
    pub(super) async fn passed(self) {
        while let Ok(left) = self.0.duration_since(SystemTime::now()) {
            if left.is_zero() {
                return;
            }
            tokio::time::sleep(left.min(Duration::from_secs(30))).await;
        }
    }
}

impl fmt::Display for Expiry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The formatter refuses times before 1970, which have passed in any case.
        humantime::format_rfc3339_seconds(self.0.max(UNIX_EPOCH)).fmt(f)
    }
}

impl FromStr for Expiry {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let midnight = format!("{text}T00:00:00Z");
        humantime::parse_rfc3339(text)
            .or_else(|_| humantime::parse_rfc3339(&midnight))
            .map(Self)
            .map_err(|_| format!("{text:?} is not a time; {EXPECTED}"))
    }
}

impl Serialize for Expiry {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Expiry {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        /// TOML has its own time type, which is written without quotes.
        #[derive(Deserialize)]
        #[serde(
            untagged,
            expecting = "expires must be a time, e.g. \"2027-03-01T08:00:00Z\""
        )]
        enum Written {
            Text(String),
            Toml(toml::value::Datetime),
        }
        let text = match Written::deserialize(deserializer)? {
            Written::Text(text) => text,
            Written::Toml(time) => time.to_string(),
        };
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_expiry_is_a_time_from_now_or_a_date() {
        let now = UNIX_EPOCH + Duration::from_secs(1_795_255_530);
        for (text, means) in [
            ("90d", "2027-02-19T10:05:30Z"),
            ("12h", "2026-11-21T22:05:30Z"),
            ("2027-03-01", "2027-03-01T00:00:00Z"),
            ("2027-03-01T08:00:00Z", "2027-03-01T08:00:00Z"),
        ] {
            let expiry = Expiry::parse(text, now).unwrap();
            assert_eq!(expiry.to_string(), means, "{text}");
            assert!(!expiry.is_over(now));
        }
        for (text, says) in [
            ("2020-01-01", "in the past"),
            ("0s", "in the past"),
            ("soon", "expected a time from now"),
            ("-3d", "expected a time from now"),
            ("9000y", "year 9999"),
        ] {
            let said = Expiry::parse(text, now).unwrap_err();
            assert!(said.contains(says), "{said}");
        }
    }
}
