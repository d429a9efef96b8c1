//! `picofarm usage`: shows what jobs consumed.

use std::time::{Duration, SystemTime};

use picofarm_proto::{
    messages::{UsageBy, UsageRow},
    show,
};
use serde_json::{Value, json};

use crate::{
    args::Usage,
    client::Client,
    error::{CliError, Result},
    output::{Output, bytes, table},
    settings::Settings,
};

/// Shows the usage by user, project or day.
///
/// # Errors
/// Fails if the coordinator cannot be reached or refuses, or if the days are in the wrong order.
pub async fn run(args: &Usage, settings: &Settings, output: Output) -> Result<()> {
    let since = args.since.unwrap_or(0);
    if args.until.is_some_and(|until| until < since) {
        return Err(CliError::input("--until: the day is before --since"));
    }
    // The wire's last day is excluded, and 0 is no bound.
    let until = args.until.map_or(0, |day| day + 1);
    let by = args.by.into();
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    let rows = client.usage(by, (since, until)).await?;
    let document: Vec<Value> = rows.iter().map(|row| document(row, by)).collect();
    output.result(&document, || {
        let mut lines = vec![
            [by.name(), "core hours", "tasks", "failures", "written"]
                .map(str::to_owned)
                .to_vec(),
        ];
        lines.extend(rows.iter().map(|row| line(row, by)));
        table(&lines)
    });
    Ok(())
}

fn document(row: &UsageRow, by: UsageBy) -> Value {
    let usage = &row.usage;
    json!({by.name(): name(row, by), "core_seconds": usage.core_ms as f64 / 1000.0,
        "tasks": usage.tasks, "failures": usage.failures, "bytes": usage.bytes})
}

fn line(row: &UsageRow, by: UsageBy) -> Vec<String> {
    let usage = &row.usage;
    let name = match name(row, by) {
        none if none.is_empty() => "-".to_owned(),
        name => show::line(&name).into_owned(),
    };
    vec![
        name,
        format!("{:.3}", usage.core_ms as f64 / 3.6e6),
        usage.tasks.to_string(),
        usage.failures.to_string(),
        bytes(usage.bytes),
    ]
}

/// Returns the name of a row; that of a day is its date.
fn name(row: &UsageRow, by: UsageBy) -> String {
    let day = match by {
        UsageBy::Day => row.name.parse::<u64>().ok(),
        UsageBy::User | UsageBy::Project => None,
    };
    let date = day.and_then(|day| {
        let since = Duration::from_secs(day.checked_mul(86_400)?);
        let time = SystemTime::UNIX_EPOCH.checked_add(since)?;
        let text = humantime::format_rfc3339_seconds(time).to_string();
        text.get(..10).map(str::to_owned)
    });
    date.unwrap_or_else(|| row.name.clone())
}
