//! Value parsers for numbers with a valid range. Numbers that also appear in jobs have the same
//! range as there.

use std::{fmt::Display, ops::RangeInclusive, str::FromStr};

use picofarm_settings::{Resolution, Spots};

fn within<T: FromStr + PartialOrd + Display>(
    text: &str,
    range: RangeInclusive<T>,
    what: &str,
) -> Result<T, String> {
    let expected = || format!("expected {} to {} {what}", range.start(), range.end());
    let value: T = text.trim().parse().map_err(|_| expected())?;
    match range.contains(&value) {
        true => Ok(value),
        false => Err(expected()),
    }
}

/// Parses a seed, or a number that counts from 0.
pub fn whole(text: &str) -> Result<u64, String> {
    within(text, 0..=u64::MAX, "(a whole number)")
}

/// Parses the number of scenes of a job.
pub fn scenes(text: &str) -> Result<u64, String> {
    within(text, 1..=100_000_000, "scenes")
}

/// Parses the number of threads of a pool. More threads than cores are slow but work; thousands
/// exhaust the machine.
pub fn threads(text: &str) -> Result<usize, String> {
    within(text, 1..=1024, "threads; leave it out for all cores")
}

/// Parses the number of workers of one process.
pub fn workers(text: &str) -> Result<usize, String> {
    within(
        text,
        1..=1024,
        "workers; for a coordinator alone: picofarm coordinator",
    )
}

/// Parses the number of simulated workers.
pub fn simulated(text: &str) -> Result<usize, String> {
    within(text, 1..=100_000, "simulated workers")
}

/// Parses the memory of a worker.
pub fn gib(text: &str) -> Result<f64, String> {
    within(text, 0.05..=1e6, "GiB (of 1.07 GB)")
}

/// Parses a number of bytes: 500GB, 2 TB, or 1000000.
pub fn bytes(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, f64); 5] = [
        ("TB", 1e12),
        ("GB", 1e9),
        ("MB", 1e6),
        ("kB", 1e3),
        ("B", 1.0),
    ];
    let text = text.trim();
    let named = UNITS.iter().find_map(|(unit, of)| {
        let number = text.strip_suffix(unit)?;
        Some((number.trim_end(), *of))
    });
    let (number, unit) = named.unwrap_or((text, 1.0));
    let value = number.parse::<f64>().unwrap_or(f64::NAN) * unit;
    match (1.0..=9e15).contains(&value) {
        true => Ok(value as u64),
        false => Err("expected 1 B to 9000 TB, such as 500GB or 2TB".into()),
    }
}

/// Parses the size of an image: 256 is a square, or 320x240.
pub fn image(text: &str) -> Result<Resolution, String> {
    let size: Resolution = text.parse()?;
    match [size.width, size.height]
        .iter()
        .all(|n| (1..=4096).contains(n))
    {
        true => Ok(size),
        false => Err("expected 1 to 4096 pixels on each side".into()),
    }
}

/// Parses the width of a view.
pub fn degrees(text: &str) -> Result<f32, String> {
    within(text, 1.0..=170.0, "degrees")
}

/// Parses the photons of a peak.
pub fn photons(text: &str) -> Result<f64, String> {
    within(text, 1e-3..=1e6, "photons")
}

/// Parses the ambient photons per bin.
pub fn ambient(text: &str) -> Result<f64, String> {
    within(text, 0.0..=1e6, "photons a bin")
}

/// Parses a waiting time.
pub fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.0..=1e9, "seconds")
}

/// Parses the time to wait for answers of workers.
pub fn patience(text: &str) -> Result<f64, String> {
    within(text, 1.0..=60.0, "seconds")
}

/// Parses the duration of a lease. A lease shorter than a heartbeat's round trip would always
/// expire; one longer than a day would practically never.
pub fn lease(text: &str) -> Result<f64, String> {
    within(text, 0.1..=86_400.0, "seconds")
}

/// Parses the days for which jobs are retained.
pub fn days(text: &str) -> Result<f64, String> {
    within(text, 0.0..=36_500.0, "days")
}

/// Parses the rows of a picture, each at least 20 pixels high.
pub fn rows(text: &str) -> Result<usize, String> {
    within(text, 1..=1000, "rows")
}

/// Parses the number of pictures of a model on a page.
pub fn pictures(text: &str) -> Result<usize, String> {
    within(text, 0..=100, "scenes of each model")
}

/// Parses a limit of at least one.
pub fn at_least_one(text: &str) -> Result<usize, String> {
    within(text, 1..=1_000_000_000, "").map_err(|said| said.trim_end().to_owned())
}

/// Parses laser spots: a grid, random ones, or positions.
pub fn spots(text: &str) -> Result<Spots, String> {
    text.parse()
}

/// Parses the number of laser spots of a grid.
pub fn grid(text: &str) -> Result<u32, String> {
    match text.parse()? {
        Spots::Grid(spots) => Ok(spots),
        _ => Err("expected a grid of 1, 4, 16, 25 or 100 spots".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use clap::error::ErrorKind;

    /// A command line, and the expected text of its error.
    const REFUSED: [(&str, &str); 34] = [
        ("up --workers 0", "expected 1 to 1024 workers"),
        ("demo --workers 0", "expected 1 to 1024 workers"),
        ("demo --samples 0", "2..=1048576"),
        ("demo --samples 1", "2..=1048576"),
        ("demo --resolution 0", "1..=4096"),
        ("demo --spots 9", "1, 4, 16, 25 and 100"),
        ("demo --spots random:0", "1 to 100 spots"),
        ("demo --spots 0.5,1.5", "from 0 up to 1"),
        ("demo --scenes 0", "expected 1 to 100000000 scenes"),
        ("demo --scenes -5", "expected 1 to 100000000 scenes"),
        ("demo --seed -1", "expected 0 to 18446744073709551615"),
        (
            "scene generate --seed one",
            "expected 0 to 18446744073709551615",
        ),
        ("dataset show rooms -1", "a whole number"),
        ("worker --threads 0", "expected 1 to 1024 threads"),
        ("worker --memory-gib 0", "expected 0.05 to 1000000 GiB"),
        ("worker --memory-gib nan", "GiB"),
        ("worker --gpus 5000", "0..=256"),
        ("worker --gpus cuda", "e.g. cuda:0"),
        ("up --gpus cuda:0,cuda:0", "cuda:0 is named twice"),
        ("scene generate --spots 9", "1, 4, 16, 25 and 100"),
        ("scene generate --resolution 99999", "1..=4096"),
        (
            "scene render a.glb --out b --error 10",
            "did you mean \"10%\"?",
        ),
        ("scene render a.glb --out b --threads 0", "threads"),
        (
            "scene export a.ply --out b.glb --spots 3",
            "1, 4, 16, 25 and 100",
        ),
        ("dataset picture rooms --rows 0", "expected 1 to 1000 rows"),
        ("dataset reprocess a b --threads 0", "threads"),
        ("dataset info s3:/b/x", "did you mean s3://b/x?"),
        ("dataset export rooms s3:b/x", "did you mean s3://b/x?"),
        ("events --last 0", "1..="),
        ("job logs j --last 0", "1..="),
        (
            "job wait j --timeout-s -1",
            "expected 0 to 1000000000 seconds",
        ),
        ("job wait j --timeout-s nan", "seconds"),
        ("model report s --pictures 101", "expected 0 to 100 scenes"),
        ("coordinator --lease-s 0", "expected 0.1 to 86400 seconds"),
    ];

    #[test]
    fn numbers_that_cannot_be_meant_are_refused_with_their_range() {
        for (line, part) in REFUSED {
            let words = ["picofarm"].into_iter().chain(line.split(' '));
            let error = super::super::command()
                .try_get_matches_from(words)
                .expect_err(line);
            assert_eq!(error.kind(), ErrorKind::ValueValidation, "{line}: {error}");
            let said = error.to_string();
            assert!(said.contains(part), "{line}: {part:?} is not in {said}");
        }
    }
}
