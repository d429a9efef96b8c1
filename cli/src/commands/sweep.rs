//! `picofarm sweep …`: shows the records of trials, and adds trials.

mod compare;
mod export;
mod extend;
mod file;
mod records;
mod search;

use std::{fs, path::Path, time::SystemTime};

use picofarm_proto::show;
use picofarm_report::trials::{self, Sweep};
use serde_json::json;

use self::records::{Records, loss, read};
use crate::{
    args::{Sweep as Command, WhichSweep},
    error::{CliError, Code, Result, io},
    output::{Output, table},
    settings::Settings,
};

pub async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    match command {
        Command::Status(which) => status(&read(&which).await?.sweep()?, output),
        Command::Best(which) => best(&which, &read(&which).await?.sweep()?, output)?,
        Command::Compare { store, names } => compare::run(&store, &names, output).await?,
        Command::Report { which, out } => report(&read(&which).await?, &out, output)?,
        Command::Export { which, out, curves } => {
            export::run(&read(&which).await?.sweep()?, &out, curves, output)?
        }
        Command::Extend(args) => extend::run(args, settings, output).await?,
        Command::Run(args) => extend::rounds(args, settings, output).await?,
    }
    Ok(())
}

fn status(sweep: &Sweep, output: Output) {
    output.result(sweep, || {
        let parameters = sweep.parameters();
        let mut header = vec!["trial", "end", "epochs", &*sweep.error];
        header.extend(&parameters);
        let mut rows = vec![header.into_iter().map(str::to_owned).collect::<Vec<_>>()];
        for trial in &sweep.trials {
            let mut row = vec![
                trial.index.to_string(),
                trial.end.name().to_owned(),
                trial.epochs.to_string(),
                loss(trial.loss),
            ];
            for name in &parameters {
                let value = trial.values.iter().find(|(other, _)| other == name);
                row.push(value.map_or_else(|| "-".into(), |(_, value)| value.text()));
            }
            rows.push(row);
        }
        format!("{}{}\n", table(&rows), sweep.summary())
    });
}

fn best(which: &WhichSweep, sweep: &Sweep, output: Output) -> Result<()> {
    let Some(best) = sweep.best() else {
        let what = format!("no trial of {:?} has come to its end yet", sweep.name);
        return Err(CliError::new(Code::Failed, what).hint(sweep.summary()));
    };
    output.result(best, || {
        let values = best.values.iter();
        let values: Vec<String> = values.map(|(n, v)| format!("{n} = {}", v.text())).collect();
        format!(
            "{}: {} {}, {}\nlook at it with `picofarm model show {} {}`\n",
            show::line(&best.model),
            show::line(&sweep.error),
            loss(best.loss),
            show::line(&values.join(", ")),
            show::argument(&which.store),
            show::argument(&best.model)
        )
    });
    Ok(())
}

fn report(records: &Records, out: &Path, output: Output) -> Result<()> {
    let date = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    let sweep = Sweep {
        date: date[..10].to_owned(),
        ..records.sweep()?
    };
    let beside = out.with_extension("json");
    let mut document = serde_json::to_string_pretty(&sweep).expect("plain data");
    document.push('\n');
    for (path, text) in [(out, trials::html(&sweep)), (&beside, document)] {
        fs::write(path, text).map_err(|e| io(path.display(), &e))?;
    }
    let facts = json!({"page": out, "json": beside, "trials": sweep.trials.len()});
    output.result(&facts, || {
        format!(
            "{}\n{} and {}\n",
            sweep.summary(),
            out.display(),
            beside.display()
        )
    });
    Ok(())
}
