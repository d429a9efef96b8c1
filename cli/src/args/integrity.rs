//! Arguments of commands that check and repair data sets: `dataset verify`, `repair`, `gc`,
//! `snapshot` and `show`.

use std::{path::PathBuf, time::Duration};

use clap::{Args, Subcommand};

#[derive(Args)]
pub struct DatasetVerify {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Manifests and sizes only; otherwise every object is hashed and decoded
    #[arg(long)]
    pub fast: bool,
    /// Expect every scene that there is room for: one that is not finished is a problem
    #[arg(long)]
    pub complete: bool,
    /// Check the scenes of this snapshot alone, which must be as they were then
    #[arg(long, value_name = "NAME", conflicts_with = "complete")]
    pub snapshot: Option<String>,
}

#[derive(Args)]
pub struct DatasetRepair {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Compare manifests and sizes only; this does not find a flipped bit
    #[arg(long)]
    pub fast: bool,
    /// Make the scenes that are not finished, too
    #[arg(long)]
    pub complete: bool,
    /// Bring the scenes of this snapshot back to what they were then, and no others
    #[arg(long, value_name = "NAME", conflicts_with = "complete")]
    pub snapshot: Option<String>,
    /// List the damage and its repair; change nothing
    #[arg(long)]
    pub dry_run: bool,
    /// The job that made the data set, where the data set does not say itself how
    #[arg(long, value_name = "FILE")]
    pub job: Option<PathBuf>,
    /// Where the data set is now that this one was reprocessed from
    #[arg(long, value_name = "DATASET", value_parser = crate::args::location::parse)]
    pub source: Option<String>,
    /// Where the files are that the data set was imported from
    #[arg(long, value_name = "DIR")]
    pub files: Option<PathBuf>,
    /// Threads [default: all cores]
    #[arg(long, value_parser = super::ranges::threads)]
    pub threads: Option<usize>,
}

#[derive(Args)]
pub struct DatasetGc {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Keep younger objects, e.g. 90m, 24h or 7d; a worker may still be writing them
    #[arg(long, default_value = "24h", value_name = "AGE", value_parser = age)]
    pub older_than: Duration,
    /// Delete them; otherwise only say what would be deleted
    #[arg(long)]
    pub delete: bool,
    /// Only say what would be deleted, which is what happens without --delete
    #[arg(long, conflicts_with = "delete")]
    pub dry_run: bool,
    /// Allow ages under an hour: no worker runs on this data set now, nor will until this ends
    #[arg(long)]
    pub nothing_runs: bool,
}

#[derive(Args)]
pub struct DatasetShow {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// The scene's number
    #[arg(value_parser = super::ranges::whole)]
    pub scene: u64,
}

#[derive(Subcommand)]
pub enum Snapshot {
    /// Pin the finished scenes under a name, for good
    Create {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the snapshot, e.g. v1
        name: String,
    },
    /// List the snapshots
    List {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
    },
    /// Say what a snapshot pins
    Show {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the snapshot
        name: String,
    },
    /// Check that the scenes of a snapshot are as they were; exit code 6 if not
    Verify {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the snapshot
        name: String,
        /// Manifests and sizes only; otherwise every object is hashed and decoded
        #[arg(long)]
        fast: bool,
    },
    /// Say which scenes differ between a snapshot and another, or the data set as it is now
    Diff {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the first snapshot
        from: String,
        /// Name of the second snapshot [default: the data set as it is now]
        to: Option<String>,
    },
}

/// Parses an age with its unit: `30s`, `90m`, `24h`, `7d`.
fn age(text: &str) -> Result<Duration, String> {
    let expected = || format!("expected a number with s, m, h or d, e.g. 24h, found {text:?}");
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[digits.len()..] {
        "s" => 1,
        "m" => 60,
        "h" => 3600,
        "d" => 86_400,
        _ => return Err(expected()),
    };
    let number: u64 = digits.parse().map_err(|_| expected())?;
    let seconds = number.checked_mul(unit).ok_or_else(expected)?;
    Ok(Duration::from_secs(seconds))
}

#[cfg(test)]
mod tests {
    #[test]
    fn an_age_has_a_unit() {
        for (text, seconds) in [
            ("30s", 30),
            ("90m", 5400),
            ("24h", 86_400),
            ("7d", 604_800),
            ("0s", 0),
        ] {
            assert_eq!(super::age(text).unwrap().as_secs(), seconds);
        }
        for text in [
            "",
            "24",
            "h",
            "-1h",
            "1.5h",
            "1w",
            "1 h",
            "99999999999999999999d",
            "9999999999999999999d",
        ] {
            let error = super::age(text).unwrap_err();
            assert!(error.contains("e.g. 24h"), "{error}");
        }
    }
}
