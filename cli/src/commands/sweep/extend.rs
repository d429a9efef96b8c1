//! `picofarm sweep extend` and `sweep run`: proposes further trials, based on the results of
//! finished ones.
//!
//! Trials are stages of a job with settings of their own, and a job does not change after its
//! submission, because leases, plans, reuse and keys depend on it. An adaptive search therefore
//! works in rounds. A round reads the records in the store, proposes values, and writes a new job
//! file with the values of all trials to the folder of the first one. When that file is submitted,
//! finished trials are reused and only the new ones are trained. Users can edit proposals in the
//! file. As with any job, the file alone determines what runs, and the same records give the same
//! file.

use std::{
    io::Write,
    path::{Path, PathBuf},
};

use super::search::{Outcome, Tried, Values, tpe};
use picofarm_proto::{
    show,
    spec::{TaskSpec, Trial},
};
use picofarm_results::TrialRecord;
use serde_json::{Value, json};

use super::{
    file::with_values,
    records::{Records, listed, outcome, text},
};
use crate::{
    args::{Extend, MoreTrials, Sampler, SweepRun},
    client::{
        Client,
        follow::{Show, follow, verdict},
        jobfile,
        stores::{self, Identity},
    },
    commands::model::open,
    error::{CliError, Result, io},
    files,
    output::{Output, table},
    settings::Settings,
};

/// A sweep of a job file.
struct Sweep {
    store: String,
    stage: String,
    /// Its trials in the file, by number.
    trials: Vec<Trial>,
}

/// A written file.
struct Extended {
    file: PathBuf,
    sweep: String,
    id: String,
    /// Number of trials that have ended.
    ended: usize,
    /// Number of the first new trial.
    first: u64,
    proposed: Vec<Values>,
}

/// Writes a job file with further trials.
pub async fn run(args: Extend, settings: &Settings, output: Output) -> Result<()> {
    let Extend { more, promote, out } = &args;
    let extended = extend(more, promote.as_deref(), out.as_deref(), settings).await?;
    let Extended { file, proposed, .. } = &extended;
    let trials: Vec<Value> = (extended.first..)
        .zip(proposed)
        .map(|(trial, values)| json!({"trial": trial, "values": values}))
        .collect();
    let facts = json!({
        "file": file, "sweep": extended.sweep, "id": extended.id, "ended": extended.ended, "trials": trials,
    });
    output.result(&facts, || described(&extended, more));
    Ok(())
}

/// Repeatedly submits a job file, waits for its end, and extends it.
pub async fn rounds(args: SweepRun, settings: &Settings, output: Output) -> Result<()> {
    let SweepRun { mut more, rounds } = args;
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    let mut files = Vec::new();
    for round in 0..=rounds {
        let (file, scale) = (&more.file, more.scale.as_deref());
        let mut spec = jobfile::read_counted(file, scale, &settings.assets).await?;
        stores::identify(&mut spec, Identity::Create, output).await;
        let job = client.submit(spec, false).await?.job;
        output.say(format!("round {round}: {}, job {job}", file.display()));
        let status = follow(&mut client, job, output, Show::Progress).await?;
        verdict(&status)?;
        files.push(json!({"file": file, "job": job}));
        if round < rounds {
            more.file = extend_or_find(&more, settings).await?;
        }
    }
    output.result(&json!({ "rounds": files }), || {
        let last = show::path(&more.file);
        format!("{rounds} rounds after the first; the last file is {last}\n")
    });
    Ok(())
}

/// Returns the next round's file: from an earlier run, or a new one.
async fn extend_or_find(more: &MoreTrials, settings: &Settings) -> Result<PathBuf> {
    let spec = jobfile::read_counted(&more.file, more.scale.as_deref(), &settings.assets).await?;
    let sweep = find(&spec.stages, more.stage.as_deref())?;
    let trials = sweep.trials.len() as u64;
    let next = extended_name(&more.file, trials, trials + more.trials);
    match next.exists() {
        true => {
            let spec =
                jobfile::read_counted(&next, more.scale.as_deref(), &settings.assets).await?;
            let found = find(&spec.stages, Some(&sweep.stage))?;
            if found.trials[0].id != sweep.trials[0].id || found.trials.len() as u64 <= trials {
                let what = format!(
                    "{}: is no extension of {}",
                    next.display(),
                    more.file.display()
                );
                return Err(CliError::input(what).hint("move it away, and give the command again"));
            }
            Ok(next)
        }
        false => Ok(extend(more, None, None, settings).await?.file),
    }
}

async fn extend(
    more: &MoreTrials,
    promote: Option<&str>,
    out: Option<&Path>,
    settings: &Settings,
) -> Result<Extended> {
    let MoreTrials { file, scale, .. } = more;
    let spec = jobfile::read_counted(file, scale.as_deref(), &settings.assets).await?;
    let named = |what: String| CliError::input(format!("{}: {what}", file.display()));
    let Sweep {
        store,
        stage,
        trials,
    } = find(&spec.stages, more.stage.as_deref())?;
    let (first, name) = (&trials[0], trials[0].sweep.clone());
    if first.over.is_empty() {
        let what = format!(
            "stage {stage:?}: sweep.over: is missing, so nothing says where further values may lie"
        );
        return Err(
            named(what).hint("name each parameter's, e.g. over = { lr = { log = [1e-4, 1e-1] } }")
        );
    }
    let records = Records::read(&open(&store)?, &name, first.id.clone()).await?;
    let tried = all(&trials, &records.ended).map_err(named)?;
    let (begin, count) = (tried.len() as u64, more.trials);
    let search = match more.sampler {
        Sampler::Tpe => tpe::propose,
        Sampler::Random => tpe::random,
    };
    let proposed = search(&first.over, &tried, first.seed, begin, count);
    if proposed.is_empty() {
        let what = format!("all values of the sweep {name:?} have been tried");
        return Err(CliError::input(what).hint("widen sweep.over: that makes another sweep of it"));
    }
    let total = begin + proposed.len() as u64;
    let values: Vec<Values> = tried.into_iter().map(|t| t.values).collect();
    let values: Vec<Values> = values.into_iter().chain(proposed.iter().cloned()).collect();
    let promote = promote.map_or_else(|| format!("{name}-{total}"), str::to_owned);
    let before = files::read_text(file, files::LISTS)?;
    let after = with_values(&before, &stage, &values, &promote).map_err(named)?;
    let out = match out {
        Some(out) => same_folder(file, out)?,
        None => extended_name(file, trials.len() as u64, total),
    };
    let failed = |e: std::io::Error| io(out.display(), &e);
    let written = NewFile::create(&out, &after).map_err(failed)?;
    // Checks that the written file has the same sweep with the new trials.
    let spec = jobfile::read_counted(written.path(), scale.as_deref(), &settings.assets).await?;
    let found = find(&spec.stages, Some(&stage))?;
    let same = found.trials[0].id == first.id && found.trials.iter().map(|t| &t.values).eq(&values);
    if !same {
        let what = "came out as another sweep; please report it, with the job file";
        return Err(CliError::input(format!("{}: {what}", out.display())));
    }
    if !written.keep(&out).map_err(failed)? {
        let what = format!("{}: is there and says something else", out.display());
        return Err(CliError::input(what).hint("name another file (--out), or remove it"));
    }
    Ok(Extended {
        file: out,
        sweep: name,
        id: first.id.clone(),
        ended: records.ended.len(),
        first: begin,
        proposed,
    })
}

/// A file with complete content that has not received its name yet.
struct NewFile(tempfile::NamedTempFile);

impl NewFile {
    /// Creates a file with this content in the folder of `out`.
    fn create(out: &Path, content: &str) -> std::io::Result<Self> {
        let folder = out.parent().filter(|p| !p.as_os_str().is_empty());
        let mut file = tempfile::Builder::new()
            .prefix(".sweep-")
            .suffix(".toml")
            .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))
            .tempfile_in(folder.unwrap_or(Path::new(".")))?;
        file.write_all(content.as_bytes())?;
        file.as_file().sync_all()?;
        Ok(Self(file))
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    /// Gives the file its name if the name is unused, or if an existing file is equal. Returns
    /// whether this succeeded.
    fn keep(self, out: &Path) -> std::io::Result<bool> {
        let ours = std::fs::read(self.path())?;
        match self.0.persist_noclobber(out) {
            Ok(_) => Ok(true),
            Err(e) if e.error.kind() == std::io::ErrorKind::AlreadyExists => {
                Ok(files::read(out, files::LISTS).is_ok_and(|theirs| theirs == ours))
            }
            Err(e) => Err(e.error),
        }
    }
}

/// Returns the selected sweep of a job's stages.
fn find(stages: &[picofarm_proto::spec::StageSpec], stage: Option<&str>) -> Result<Sweep> {
    let mut sweeps: Vec<Sweep> = Vec::new();
    for spec in stages {
        let (trial, store) = match &spec.task {
            TaskSpec::Train(task) => (&task.train.trial, &task.source.store),
            TaskSpec::Python(task) => (&task.python.trial, task.store()),
            _ => continue,
        };
        let Some(trial) = trial else {
            continue;
        };
        let end = format!(".{}", trial.index);
        let name = spec.name.strip_suffix(&end).unwrap_or(&spec.name);
        match sweeps.last_mut() {
            Some(sweep) if sweep.stage == name => sweep.trials.push(trial.clone()),
            _ => sweeps.push(Sweep {
                store: store.clone(),
                stage: name.to_owned(),
                trials: vec![trial.clone()],
            }),
        }
    }
    let names: Vec<String> = sweeps.iter().map(|s| s.stage.clone()).collect();
    if let Some(stage) = stage {
        sweeps.retain(|sweep| sweep.stage == stage);
    }
    match (sweeps.pop(), sweeps.is_empty(), names.is_empty()) {
        (Some(sweep), true, _) => Ok(sweep),
        (_, _, true) => Err(CliError::input("the job has no stage with a sweep")
            .hint("write one: `picofarm job init --kind sweep`")),
        _ => {
            let what = match stage {
                Some(stage) => format!("no stage with a sweep is called {stage:?}"),
                None => "the job has several sweeps".to_owned(),
            };
            Err(CliError::input(what).hint(format!("choose one: --stage {}", names.join(" | "))))
        }
    }
}

/// Returns all trials so far: those of the file, and further ones that have ended.
///
/// # Errors
/// Fails if file and store have different values for a trial, or if a trial between them is
/// unknown.
fn all(trials: &[Trial], ended: &[TrialRecord]) -> Result<Vec<Tried>, String> {
    let mut all: Vec<Tried> = trials
        .iter()
        .map(|trial| Tried {
            values: trial.values.clone(),
            outcome: Outcome::Open,
        })
        .collect();
    for record in ended {
        let index = record.index as usize;
        let known = all.len();
        match all.get_mut(index) {
            Some(tried) if tried.values != record.values => {
                let shown = |values: &Values| listed(values.iter().map(|(n, v)| (n, text(v))));
                return Err(format!(
                    "trial {index} has {} here, and had {} when it was trained; list the latter (sweep.values)",
                    shown(&tried.values),
                    shown(&record.values)
                ));
            }
            Some(tried) => tried.outcome = outcome(record),
            None if index == known => all.push(Tried {
                values: record.values.clone(),
                outcome: outcome(record),
            }),
            None => {
                return Err(format!(
                    "trial {known} is not in it and has not ended, but trial {index} has; extend the file that lists both"
                ));
            }
        }
    }
    Ok(all)
}

/// Returns `job-40.toml` in the folder of `job.toml` or `job-32.toml`, for a file of 32 trials
/// extended to 40.
fn extended_name(file: &Path, trials: u64, total: u64) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let stem = stem.strip_suffix(&format!("-{trials}")).unwrap_or(&stem);
    file.with_file_name(format!("{stem}-{total}.toml"))
}

/// Checks that a copy is in the job file's folder, because the file's locations are relative to it.
fn same_folder(file: &Path, out: &Path) -> Result<PathBuf> {
    let folder = |path: &Path| {
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty());
        parent.unwrap_or(Path::new(".")).canonicalize()
    };
    let (here, there) = (
        folder(file).map_err(|e| io(file.display(), &e))?,
        folder(out).map_err(|e| io(out.display(), &e))?,
    );
    if here != there {
        let what = format!(
            "--out: {} lies in another folder than the job file, whose paths are relative to it",
            out.display()
        );
        return Err(CliError::input(what).hint(format!("write it into {}", here.display())));
    }
    Ok(out.to_owned())
}

fn described(extended: &Extended, more: &MoreTrials) -> String {
    let names: Vec<String> = extended
        .proposed
        .iter()
        .take(1)
        .flat_map(|v| v.keys().cloned())
        .collect();
    let mut rows = vec![
        std::iter::once("trial".to_owned())
            .chain(names)
            .collect::<Vec<_>>(),
    ];
    for (trial, values) in (extended.first..).zip(&extended.proposed) {
        let values = values.values().map(text);
        rows.push(std::iter::once(trial.to_string()).chain(values).collect());
    }
    let few = match more.sampler {
        Sampler::Tpe if extended.ended < tpe::STARTUP => format!(
            "{} trials have ended; values are drawn at random until {} have\n",
            extended.ended,
            tpe::STARTUP
        ),
        _ => String::new(),
    };
    let scale = more.scale.as_ref();
    let scale = scale.map_or_else(String::new, |scale| {
        format!(" --scale {}", show::argument(scale))
    });
    format!(
        "{}{few}train them with `picofarm job submit {}{scale}`: the trials that have ended are reused\n",
        table(&rows),
        show::argument(&extended.file.display().to_string())
    )
}

#[cfg(test)]
mod tests {
    use picofarm_results::TrialEnd;

    use super::{super::records::tests::record, *};

    fn trial(index: u64, lr: f64) -> Trial {
        Trial {
            sweep: "m".into(),
            id: "0123456789abcdef".into(),
            index,
            values: [("lr".to_owned(), json!(lr))].into(),
            over: std::collections::BTreeMap::new(),
            seed: 0,
            stop: None,
        }
    }

    #[test]
    fn trials_of_the_file_and_of_the_store_are_joined_by_number() {
        let file = [trial(0, 0.1), trial(1, 0.2)];
        let ended = |index, lr| record(index, lr, TrialEnd::Finished, &[0.5]);
        let found = all(&file, &[ended(1, 0.2), ended(2, 0.3)]).unwrap();
        let outcomes: Vec<Outcome> = found.iter().map(|t| t.outcome).collect();
        assert_eq!(
            outcomes,
            [
                Outcome::Open,
                Outcome::Finished(0.5),
                Outcome::Finished(0.5)
            ]
        );
        assert_eq!(found[2].values["lr"], 0.3);
        let error = all(&file, &[ended(1, 0.25)]).unwrap_err();
        assert_eq!(
            error,
            "trial 1 has lr = 0.2 here, and had lr = 0.25 when it was trained; list the latter (sweep.values)"
        );
        let error = all(&file, &[ended(3, 0.3)]).unwrap_err();
        assert!(error.contains("trial 2 is not in it"), "{error}");
    }

    #[test]
    fn a_file_that_says_something_else_is_never_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("job-8.toml");
        let write = |content| NewFile::create(&out, content).unwrap().keep(&out).unwrap();
        assert!(write("a = 1"));
        assert!(write("a = 1"), "the same again");
        assert!(!write("a = 2"));
        assert_eq!(std::fs::read_to_string(&out).unwrap(), "a = 1");
        // No other file is left in the folder.
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn files_of_rounds_are_called_by_their_number_of_trials() {
        let name = |file: &str, trials, total| {
            extended_name(Path::new(file), trials, total)
                .display()
                .to_string()
        };
        assert_eq!(name("a/job.toml", 32, 40), "a/job-40.toml");
        assert_eq!(name("a/job-32.toml", 32, 40), "a/job-40.toml");
        assert_eq!(name("job-8.toml", 32, 40), "job-8-40.toml");
    }
}
