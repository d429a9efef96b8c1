//! Examinations on the wire. Texts of a worker are cut to their bounds, because nobody can correct
//! them.

use crate::{
    messages::{
        Check, Examine, Examined, ExaminedWorker, Verdict,
        examine::{DETAIL_BYTES, MOST_CHECKS, WHAT_BYTES},
    },
    spec::bounds::cut,
    wire,
};

impl From<Examine> for wire::Examine {
    fn from(m: Examine) -> Self {
        wire::Examine {
            id: m.id,
            store: m.store,
            scenes: m.scenes,
        }
    }
}

impl From<wire::Examine> for Examine {
    fn from(w: wire::Examine) -> Self {
        Examine {
            id: w.id,
            store: w.store,
            scenes: w.scenes,
        }
    }
}

impl From<Check> for wire::Check {
    fn from(m: Check) -> Self {
        let verdict = match m.verdict {
            Verdict::Ok => wire::Verdict::Ok,
            Verdict::Note => wire::Verdict::Note,
            Verdict::Bad => wire::Verdict::Bad,
        };
        wire::Check {
            what: cut(&m.what, WHAT_BYTES),
            verdict: verdict.into(),
            detail: cut(&m.detail, DETAIL_BYTES),
        }
    }
}

impl From<wire::Check> for Check {
    fn from(w: wire::Check) -> Self {
        let verdict = match w.verdict() {
            wire::Verdict::Ok => Verdict::Ok,
            wire::Verdict::Note => Verdict::Note,
            // A verdict that this version does not know is a reason to look.
            wire::Verdict::Bad | wire::Verdict::Unspecified => Verdict::Bad,
        };
        Check {
            what: cut(&w.what, WHAT_BYTES),
            verdict,
            detail: cut(&w.detail, DETAIL_BYTES),
        }
    }
}

fn checks(checks: Vec<wire::Check>) -> Vec<Check> {
    checks
        .into_iter()
        .take(MOST_CHECKS)
        .map(Into::into)
        .collect()
}

impl From<Examined> for wire::Examined {
    fn from(m: Examined) -> Self {
        wire::Examined {
            id: m.id,
            clock_ms: m.clock_ms,
            checks: m.checks.into_iter().map(Into::into).collect(),
        }
    }
}

impl From<wire::Examined> for Examined {
    fn from(w: wire::Examined) -> Self {
        Examined {
            id: w.id,
            clock_ms: w.clock_ms,
            checks: checks(w.checks),
        }
    }
}

impl From<ExaminedWorker> for wire::ExaminedWorker {
    fn from(m: ExaminedWorker) -> Self {
        wire::ExaminedWorker {
            id: m.id,
            name: m.name,
            answered: m.answered,
            ahead_ms: m.ahead_ms,
            checks: m.checks.into_iter().map(Into::into).collect(),
        }
    }
}

impl From<wire::ExaminedWorker> for ExaminedWorker {
    fn from(w: wire::ExaminedWorker) -> Self {
        ExaminedWorker {
            id: w.id,
            name: w.name,
            answered: w.answered,
            ahead_ms: w.ahead_ms,
            checks: checks(w.checks),
        }
    }
}
