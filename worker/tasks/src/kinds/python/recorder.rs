//! Keeps what the code sends: metrics, checkpoints and artefacts.

use std::{
    collections::BTreeMap,
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use bytes::{Buf, Bytes};
use picofarm_proto::spec::kinds::PythonSettings;
use picofarm_results::TrialEnd;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tempfile::TempDir;
use tracing::info;

use super::results::RESERVED;
use crate::{
    python::{Answer, Host, Report},
    saver::{PIECE, Saver},
    task::{Control, TaskError},
    trial::{AtEpoch, Course, EndedTrial},
};

/// First bytes of a checkpoint. The length of the worker's own part follows (4 bytes, little
/// endian), then that part as JSON, then what the code wrote.
const MAGIC: &[u8; 8] = b"pfown01\n";
/// Most reports of a training.
const REPORTS: usize = 100_000;
/// Most bytes of a checkpoint, and of all artefacts.
const BYTES: u64 = 16 << 30;
/// Most artefacts.
const ARTIFACTS: usize = 1_000;
/// Most log lines about reports, because a task's log allowance is not much larger.
const LINES: u64 = 80;
/// Share of the epochs in a task's progress.
const TRAINED: f64 = 0.99;

/// The worker's own part of a checkpoint.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Resumed {
    /// The step of the checkpoint.
    #[serde(skip)]
    step: u64,
    history: Vec<Value>,
    best: Option<f64>,
}

impl Resumed {
    /// Divides a checkpoint into the worker's own part and what the code wrote.
    pub(super) fn read(step: u64, pieces: Vec<Bytes>) -> Result<(Self, Vec<Bytes>), TaskError> {
        let broken = |what: &str| {
            TaskError::Crash(format!(
                "the checkpoint after {step} steps {what}; delete it, and the training begins anew"
            ))
        };
        let mut pieces = pieces.into_iter();
        let mut head = pieces.next().unwrap_or_default();
        if head.len() < MAGIC.len() + 4 || !head.starts_with(MAGIC) {
            return Err(broken("is of another kind"));
        }
        head.advance(MAGIC.len());
        let length = head.get_u32_le() as usize;
        if head.len() < length {
            return Err(broken("is cut off"));
        }
        let own = head.split_to(length);
        let own: Self = serde_json::from_slice(&own).map_err(|e| broken(&e.to_string()))?;
        let rest = std::iter::once(head).chain(pieces).collect();
        Ok((Self { step, ..own }, rest))
    }

    fn to_bytes(&self) -> Bytes {
        let own = serde_json::to_vec(self).expect("plain data");
        let length = u32::try_from(own.len()).unwrap_or(u32::MAX);
        [&MAGIC[..], &length.to_le_bytes(), &own].concat().into()
    }
}

/// Keeps what the code sends.
pub(super) struct Recorder<'a> {
    settings: &'a PythonSettings,
    saver: Saver<'a>,
    course: Option<&'a Course<'a>>,
    control: &'a Control,
    state: Resumed,
    /// The objective at the latest report that has it, as a loss.
    loss: Option<f64>,
    /// The latest number of each metric.
    latest: BTreeMap<String, f64>,
    end: Option<TrialEnd>,
    /// Holds the artefacts.
    folder: TempDir,
    artifacts: BTreeMap<String, PathBuf>,
    reported: u64,
}

impl<'a> Recorder<'a> {
    pub(super) fn new(
        settings: &'a PythonSettings,
        saver: Saver<'a>,
        (course, control): (Option<&'a Course<'a>>, &'a Control),
        state: Resumed,
    ) -> Result<Self, TaskError> {
        let folder = tempfile::tempdir();
        let folder = folder.map_err(|e| unwritten(&std::env::temp_dir(), &e))?;
        let loss = |line: &Value| line["loss"].as_f64();
        Ok(Self {
            settings,
            saver,
            course,
            control,
            loss: state.history.iter().rev().find_map(loss),
            state,
            latest: BTreeMap::new(),
            end: None,
            folder,
            artifacts: BTreeMap::new(),
            reported: 0,
        })
    }

    /// Waits for the checkpoint in progress.
    pub(super) fn last(&mut self) {
        self.saver.last();
    }

    /// Returns the figures of a trial that ended before its training.
    pub(super) fn ended(self) -> Result<EndedTrial, TaskError> {
        let end = self.end.ok_or_else(|| {
            TaskError::Crash("the code was not asked to stop, but did".to_owned())
        })?;
        Ok(EndedTrial {
            end,
            epochs: epochs(&self.state.history),
            loss: self.loss,
            history: self.state.history,
        })
    }

    /// Returns the lines of the history.
    pub(super) fn history(&self) -> &[Value] {
        &self.state.history
    }

    /// Returns the latest loss.
    pub(super) fn loss(&self) -> Option<f64> {
        self.loss
    }

    /// Returns the latest number of each metric.
    pub(super) fn latest(&self) -> &BTreeMap<String, f64> {
        &self.latest
    }

    /// Returns the files to be published, by name.
    pub(super) fn artifacts(&self) -> &BTreeMap<String, PathBuf> {
        &self.artifacts
    }

    /// Adds a report to the history. Returns its loss: `None` without the objective, NaN if it is
    /// not finite.
    fn note(&mut self, report: &Report) -> Option<f64> {
        let objective = report.metrics.get(&self.settings.objective);
        let loss = objective.map(|v| v.map_or(f64::NAN, |v| self.settings.goal.loss(v)));
        let finite = loss.filter(|loss| loss.is_finite());
        self.state.history.push(json!({
            "epoch": report.epoch, "step": report.step, "loss": finite, "metrics": report.metrics,
        }));
        let numbers = report.metrics.iter();
        self.latest
            .extend(numbers.filter_map(|(name, value)| Some((name.clone(), (*value)?))));
        if let Some(loss) = finite {
            self.loss = Some(loss);
            self.state.best = Some(self.state.best.map_or(loss, |best| best.min(loss)));
        }
        loss
    }

    /// Shows a report as the task's activity and progress, and in its log.
    fn show(&mut self, report: &Report) {
        let at = match (report.epoch, report.step) {
            (Some(epoch), _) if self.settings.epochs > 0 => {
                let of = self.settings.epochs;
                self.control.at((epoch as f64 / of as f64 * TRAINED) as f32);
                format!("epoch {epoch}/{of}")
            }
            (Some(epoch), _) => format!("epoch {epoch}"),
            (None, Some(step)) => format!("step {step}"),
            (None, None) => "report".to_owned(),
        };
        let metrics = report.metrics.iter();
        let shown: Vec<String> = metrics
            .clone()
            .map(|(name, value)| match value {
                Some(value) => format!("{name} {value:.4}"),
                None => format!("{name} is not finite"),
            })
            .collect();
        let text = format!("{at}: {}", shown.join(", "));
        let counts = [("epoch", report.epoch), ("step", report.step)];
        let counts = counts.into_iter().filter_map(|(n, v)| Some((n, v? as f64)));
        let figures = metrics.filter_map(|(name, value)| Some((&**name, (*value)?)));
        let figures: Vec<(&str, f64)> = counts.chain(figures).collect();
        let between = self.settings.epochs.div_ceil(LINES).max(1);
        let due = match report.epoch {
            Some(epoch) if self.settings.epochs > 0 => epoch.is_multiple_of(between),
            _ => self.reported < LINES,
        };
        if due {
            self.reported += 1;
            info!("{text}");
        }
        self.control.say(text, &figures);
    }

    /// Asks the sweep whether the trial goes on.
    fn goes_on(&self, report: &Report, loss: Option<f64>) -> Result<bool, TaskError> {
        let (Some(course), Some(epoch)) = (self.course, report.epoch) else {
            return Ok(true);
        };
        let at = AtEpoch {
            epoch,
            of: self.settings.epochs,
            loss,
            best: self.state.best,
        };
        course.goes_on(&at, self.control)
    }
}

impl Host for Recorder<'_> {
    fn report(&mut self, report: Report) -> Result<Answer, TaskError> {
        if self.state.history.len() >= REPORTS {
            let what = format!("report: more than {REPORTS} reports; report less often");
            return Err(TaskError::User(what));
        }
        let loss = self.note(&report);
        self.show(&report);
        if self.course.is_some() && loss.is_some_and(f64::is_nan) {
            let what = format!("{} is not finite", self.settings.objective);
            self.end = Some(TrialEnd::Diverged(what));
            return Ok(Answer::Stop("diverged"));
        }
        if self.goes_on(&report, loss)? {
            return Ok(Answer::Go);
        }
        self.end = Some(TrialEnd::Pruned);
        Ok(Answer::Stop("pruned"))
    }

    fn checkpoint(&mut self, step: u64, file: &Path) -> Result<(), TaskError> {
        if step < self.state.step {
            return Err(TaskError::User(format!(
                "checkpoint: step {step} is before the last checkpoint's, {}; count steps up",
                self.state.step
            )));
        }
        let mut pieces = vec![self.state.to_bytes()];
        let read = pieces_of(file, &mut pieces);
        let removed = fs::remove_file(file);
        read.and(removed).map_err(|e| unwritten(file, &e))?;
        self.state.step = step;
        self.saver.save(step, Box::new(pieces.into_iter()));
        // The code asks for each checkpoint to count, or may have no time for another.
        if self.settings.checkpoint_minutes == 0.0 || self.control.stopped() {
            self.saver.last();
        }
        Ok(())
    }

    fn artifact(&mut self, name: &str, file: &Path) -> Result<(), TaskError> {
        if RESERVED.contains(&name) {
            let what = format!("artifact: {name} is the worker's own; choose another name");
            return Err(TaskError::User(what));
        }
        if self.artifacts.len() >= ARTIFACTS {
            let what = format!("artifact: more than {ARTIFACTS} files; pack them into one");
            return Err(TaskError::User(what));
        }
        let kept = self.folder.path().join(name);
        let moved = fs::rename(file, &kept).or_else(|_| {
            // The folders may be on different file systems.
            fs::copy(file, &kept).and_then(|_| fs::remove_file(file))
        });
        moved.map_err(|e| unwritten(&kept, &e))?;
        self.artifacts.insert(name.to_owned(), kept);
        let sizes = self
            .artifacts
            .values()
            .map(|path| fs::metadata(path).map(|m| m.len()));
        let total: u64 = sizes.filter_map(Result::ok).sum();
        match total > BYTES {
            true => Err(TaskError::User(format!(
                "artifact: more than {} GiB in all; publish less",
                BYTES >> 30
            ))),
            false => Ok(()),
        }
    }
}

/// Reads a checkpoint in pieces.
fn pieces_of(file: &Path, pieces: &mut Vec<Bytes>) -> std::io::Result<()> {
    let mut file = fs::File::open(file)?;
    let bytes = file.metadata()?.len();
    if bytes > BYTES {
        let what = format!(
            "a checkpoint of {bytes} bytes, more than {} GiB",
            BYTES >> 30
        );
        return Err(std::io::Error::other(what));
    }
    loop {
        let mut piece = Vec::new();
        (&mut file).take(PIECE as u64).read_to_end(&mut piece)?;
        if piece.is_empty() {
            return Ok(());
        }
        pieces.push(piece.into());
    }
}

/// Returns the number of completed epochs.
pub(super) fn epochs(history: &[Value]) -> u64 {
    let epochs = history.iter().filter_map(|line| line["epoch"].as_u64());
    epochs.max().unwrap_or(0)
}

fn unwritten(path: &Path, error: &std::io::Error) -> TaskError {
    TaskError::Interrupted(format!("{}: {error}; make room there", path.display()))
}
