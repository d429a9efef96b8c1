//! `picofarm dataset split`: divides the scenes into training, validation and test.

use picofarm_proto::split::{Parts, SIDES, SplitSettings};
use picofarm_tasks::{
    Control,
    split::{Split, Splitter},
};
use serde_json::json;
use tokio::runtime::Handle;

use super::{store_and_folder, task_failed};
use crate::{
    args::DatasetSplit,
    error::{CliError, Code, Result},
    output::{Output, table},
};

pub async fn run(args: DatasetSplit, output: Output) -> Result<()> {
    let (store, dataset) = store_and_folder(&args.dataset)?;
    let settings = match (args.counts, args.fractions) {
        (Some(counts), _) => Some(Parts::Counts(counts)),
        (None, Some(fractions)) => Some(Parts::Fractions(fractions)),
        (None, None) => None,
    }
    .map(|parts| SplitSettings {
        name: args.name.clone(),
        seed: args.seed,
        parts,
    });
    let splitter = Splitter::new(Handle::current());
    let control = Control::default();
    let name = args.name.clone();
    let split = tokio::task::spawn_blocking(move || match settings {
        Some(settings) => splitter.run(&settings, &store, &dataset, &control),
        None => splitter.show(&name, &store, &dataset, &control),
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("splitting broke: {e}")))?
    .map_err(task_failed)?;
    tell(&args, &split, output);
    Ok(())
}

fn tell(args: &DatasetSplit, split: &Split, output: Output) {
    let record = &split.record;
    let counts: serde_json::Map<_, _> = SIDES
        .iter()
        .zip(record.counts)
        .map(|(side, count)| ((*side).to_owned(), json!(count)))
        .collect();
    let facts = json!({
        "dataset": args.dataset, "name": record.settings.name, "version": record.version, "counts": counts,
        "settings": record.settings, "made_of": record.made_of, "cuts": record.cuts,
        "changed": !split.adopted, "missing": split.missing, "file": split.place, "sha256": split.sha256,
    });
    output.result(&facts, || {
        let total: u64 = record.counts.iter().sum();
        let rows: Vec<Vec<String>> = SIDES
            .iter()
            .zip(record.counts)
            .map(|(side, count)| {
                let share = 100.0 * count as f64 / total.max(1) as f64;
                vec![(*side).into(), count.to_string(), format!("{share:.2} %")]
            })
            .collect();
        let what = match (split.adopted, record.version) {
            (true, _) => "unchanged",
            (false, 1) => "made",
            (false, _) => "extended by scenes added since; no scene changed sides",
        };
        let mut text = format!("{}: version {}, {what}\n", split.place, record.version);
        text += &table(&rows);
        if record.made_of != total {
            text += &format!("exact for the first {} scenes\n", record.made_of);
        }
        if split.missing > 0 {
            text += &format!("{} of them are not published now\n", split.missing);
        }
        text
    });
}
