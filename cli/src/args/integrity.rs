//! Arguments of commands that check and repair data sets: `dataset verify`, `repair`, `gc`,
//! `snapshot` and `show`.

use std::{path::PathBuf, time::Duration};

use clap::{Args, Subcommand};

#[derive(Args)]
pub struct DatasetVerify {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Check manifests and sizes only; otherwise every object is hashed and decoded
    #[arg(long)]
    pub fast: bool,
    /// Count unfinished scenes as problems
    #[arg(long)]
    pub complete: bool,
    /// Check only the scenes of this snapshot, against the snapshot
    #[arg(long, value_name = "NAME", conflicts_with = "complete")]
    pub snapshot: Option<String>,
}

#[derive(Args)]
pub struct DatasetRepair {
    /// Folder or URL of the data set
    #[arg(value_parser = crate::args::location::parse)]
    pub dataset: String,
    /// Check manifests and sizes only; this misses flipped bits
    #[arg(long)]
    pub fast: bool,
    /// Also make unfinished scenes
    #[arg(long)]
    pub complete: bool,
    /// Restore only the scenes of this snapshot, as they were then
    #[arg(long, value_name = "NAME", conflicts_with = "complete")]
    pub snapshot: Option<String>,
    /// List the damage and its repair; change nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Job file that made the data set, if the data set has no recipe
    #[arg(long, value_name = "FILE")]
    pub job: Option<PathBuf>,
    /// Data set that this one was reprocessed from, if it moved
    #[arg(long, value_name = "DATASET", value_parser = crate::args::location::parse)]
    pub source: Option<String>,
    /// Folder with the files that the data set was imported from
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
    /// Keep younger objects, because a worker may still be writing them, e.g. 90m, 24h or 7d
    #[arg(long, default_value = "24h", value_name = "AGE", value_parser = age)]
    pub older_than: Duration,
    /// Delete the objects; otherwise they are only listed
    #[arg(long)]
    pub delete: bool,
    /// Only list the objects, as without --delete
    #[arg(long, conflicts_with = "delete")]
    pub dry_run: bool,
    /// Allow ages under an hour, because no worker runs on this data set
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
    /// Pin the finished scenes under a name
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
    /// Show the scenes of a snapshot
    Show {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the snapshot
        name: String,
    },
    /// Check that the scenes of a snapshot are unchanged; exit code 6 if not
    Verify {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the snapshot
        name: String,
        /// Check manifests and sizes only; otherwise every object is hashed and decoded
        #[arg(long)]
        fast: bool,
    },
    /// List scenes that differ between a snapshot and another, or the current data set
    Diff {
        /// Folder or URL of the data set
        #[arg(value_parser = crate::args::location::parse)]
        dataset: String,
        /// Name of the first snapshot
        from: String,
        /// Name of the second snapshot [default: the current data set]
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
