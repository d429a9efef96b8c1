//! Formats the problems found by a check as text and as JSON.

use picofarm_proto::show;
use picofarm_store::{Problem, VerifyMode};
use serde_json::{Value, json};

use crate::error::{CliError, Code};

/// Maximum number of problems and unfinished scenes shown as text.
pub const SHOWN: usize = 20;

/// Returns the thoroughness of the check.
pub fn mode(fast: bool) -> VerifyMode {
    match fast {
        true => VerifyMode::Fast,
        false => VerifyMode::Full,
    }
}

/// Returns the problems as an error.
pub fn broken(place: &str, problems: &[Problem]) -> CliError {
    broken_by(place, problems, Problem::hint)
}

/// Like `broken`, with other repair hints.
pub fn broken_by(
    place: &str,
    problems: &[Problem],
    hint_of: fn(&Problem) -> &'static str,
) -> CliError {
    let mut shown = Vec::new();
    let mut last = "";
    for problem in problems.iter().take(SHOWN) {
        let scene = problem.scene.map(|s| format!("scene {s}: "));
        let hint = hint_of(problem);
        let how = match hint == last {
            true => String::new(),
            false => format!("\n    hint: {hint}"),
        };
        last = hint;
        let what = problem.to_string();
        shown.push(format!(
            "{}{}{how}",
            scene.unwrap_or_default(),
            show::line(&what)
        ));
    }
    let more = match problems.len().saturating_sub(shown.len()) {
        0 => String::new(),
        n => format!("\n  … and {n} more (--json lists all)"),
    };
    let error = CliError::new(
        Code::Damaged,
        format!(
            "{place}: {} problem(s)\n  {}{more}",
            problems.len(),
            shown.join("\n  ")
        ),
    );
    let repairable = |p: &Problem| hint_of(p).starts_with("dataset repair");
    match problems.iter().any(repairable) {
        true => error.hint(format!(
            "picofarm dataset repair {} makes the broken scenes again, and only those",
            show::argument(place)
        )),
        false => error,
    }
}

/// Returns the problems as JSON.
pub fn problems_json(problems: &[Problem]) -> Vec<Value> {
    problems_json_by(problems, Problem::hint)
}

/// Like `problems_json`, with other repair hints.
pub fn problems_json_by(problems: &[Problem], hint: fn(&Problem) -> &'static str) -> Vec<Value> {
    problems
        .iter()
        .map(|p| {
            json!({
                "object": p.object, "scene": p.scene, "fault": p.fault.kind(), "what": p.fault.to_string(),
                "hint": hint(p),
            })
        })
        .collect()
}
