//! Arguments of `picofarm catalog` and `picofarm usage`.

use std::{path::PathBuf, time::SystemTime};

use clap::{Args, Subcommand, ValueEnum};
use picofarm_database::CatalogPlace;
use picofarm_proto::messages::UsageBy;

/// What can be done with a catalog.
#[derive(Subcommand)]
pub enum Catalog {
    /// Copy the catalog to a file, also while the coordinator runs. The copy is checked before it
    /// gets its name
    Backup {
        /// The file of the copy
        file: PathBuf,
        /// Replace the file if it exists
        #[arg(long)]
        force: bool,
        #[command(flatten)]
        place: CatalogArg,
    },
    /// Make the catalog of a stopped coordinator from a backup
    Restore {
        /// The backup
        file: PathBuf,
        /// Replace the catalog if it exists
        #[arg(long)]
        force: bool,
        #[command(flatten)]
        place: CatalogArg,
    },
}

/// Where the catalog is.
#[derive(Args)]
pub struct CatalogArg {
    /// The catalog, as given to the coordinator
    #[arg(
        long,
        default_value = "picofarm-data/catalog.sqlite",
        value_name = "FILE|URL",
        env = "PICOFARM_CATALOG",
        hide_env_values = true
    )]
    pub catalog: CatalogPlace,
}

/// What usage is shown, and by what it is summed.
#[derive(Args)]
pub struct Usage {
    /// Sum by the user who submitted the jobs, by their `project`, or by day (UTC)
    #[arg(long, value_name = "WHAT", default_value = "user")]
    pub by: UsageByArg,
    /// The first day, e.g. 2026-11-01, or a number of days before today, e.g. 30d [default: the
    /// first recorded]
    #[arg(long, value_name = "DAY", value_parser = day)]
    pub since: Option<i64>,
    /// The last day [default: today]
    #[arg(long, value_name = "DAY", value_parser = day)]
    pub until: Option<i64>,
}

/// The names of [`UsageBy`] as an option.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum UsageByArg {
    User,
    Project,
    Day,
}

impl From<UsageByArg> for UsageBy {
    fn from(by: UsageByArg) -> Self {
        match by {
            UsageByArg::User => Self::User,
            UsageByArg::Project => Self::Project,
            UsageByArg::Day => Self::Day,
        }
    }
}

/// Returns a day as its number since 1970-01-01.
fn day(text: &str) -> Result<i64, String> {
    const EXPECTED: &str = "expected a day such as 2026-11-01, or days before today such as 30d";
    let days = |time: SystemTime| {
        let since = time.duration_since(SystemTime::UNIX_EPOCH);
        let seconds = since.map_or(0, |since| since.as_secs());
        i64::try_from(seconds / 86_400).unwrap_or(i64::MAX)
    };
    if let Some(count) = text.strip_suffix('d') {
        let count: u32 = count.parse().map_err(|_| EXPECTED)?;
        return Ok((days(SystemTime::now()) - i64::from(count)).max(0));
    }
    let midnight = format!("{text}T00:00:00Z");
    let time = humantime::parse_rfc3339(&midnight).map_err(|_| EXPECTED)?;
    Ok(days(time))
}

#[cfg(test)]
mod tests {
    use super::day;

    #[test]
    fn a_day_is_a_date_or_a_number_of_days_ago() {
        assert_eq!(day("1970-01-03"), Ok(2));
        assert_eq!(day("2026-11-30"), Ok(20_787));
        assert_eq!(day("0d").unwrap() - day("30d").unwrap(), 30);
        for text in ["yesterday", "2026-13-01", "-3d", "3h", ""] {
            assert!(day(text).unwrap_err().contains("2026-11-01"), "{text}");
        }
    }
}
