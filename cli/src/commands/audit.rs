//! `picofarm audit`: shows the audit log.

use picofarm_proto::{messages::AuditEntry, show};

use crate::{
    args::Audit,
    client::Client,
    error::{CliError, Result},
    output::{Output, describe::clock, table},
    settings::Settings,
};

/// Number of lines per request.
const PAGE: u32 = 1_000;

/// Shows the last lines of the audit log, oldest first.
///
/// # Errors
/// Fails if the coordinator cannot be reached or refuses, or if `--job` is not an id.
pub async fn run(args: &Audit, settings: &Settings, output: Output) -> Result<()> {
    let job = match &args.job {
        None => None,
        Some(text) => Some(
            text.parse()
                .map_err(|e| CliError::input(format!("--job {text:?}: {e}; give the whole id")))?,
        ),
    };
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    let mut lines: Vec<AuditEntry> = Vec::new();
    while let left @ 1.. = args.last.saturating_sub(lines.len() as u32) {
        let before = lines.last().map(|line| line.sequence);
        let page = client
            .audit(before, left.min(PAGE), args.who.as_deref(), job)
            .await?;
        let over = (page.len() as u32) < left.min(PAGE);
        lines.extend(page);
        if over {
            break;
        }
    }
    lines.reverse();
    output.result(&lines, || table(&lines.iter().map(row).collect::<Vec<_>>()));
    Ok(())
}

fn row(line: &AuditEntry) -> Vec<String> {
    vec![
        clock(line.at_ms),
        show::line(&line.who).into_owned(),
        line.act.name().into(),
        line.job.map_or_else(|| "-".into(), |job| job.to_string()),
        line.outcome.name().into(),
        show::line(&line.detail).into_owned(),
    ]
}
