//! Sweeps. A train stage with a sweep becomes many trainings, *trials*, with values from a grid or
//! drawn at random, and a last step that gives the best of them its own name.
//!
//! ```toml
//! [stage.sweep]
//! trials = 27                                       # drawn at random; without it, the whole grid
//! stop = { halving = { first = 3, factor = 3 } }    # best third goes on after 3, 9, … epochs
//! over = { lr = { log = [1e-4, 1e-1] }, width = [8, 16], levels = { int = [2, 4] } }
//! [stage.train]
//! model = "depth"                                   # trials depth.0, …; the best becomes depth
//! net = { width = "{width}", levels = "{levels}" }
//! optimise = { learning_rate = "{lr}", epochs = 81 }
//! ```
//!
//! Trial `i` of `tof` is a stage of one task, `tof.i`. It is an ordinary training with ordinary
//! settings, and is leased, resumed, reused and inspected like any other. Its draws depend only on
//! the seed, its number and the parameters' names, so that a later increase adds further trials.
//! `tof` itself becomes a stage of kind `promote`, which needs all trials.
//!
//! `values = [{ lr = 0.01, width = 8, levels = 3 }, …]` lists the values of the first trials by
//! hand. `trials` includes them, and the trials beyond are drawn. `picofarm sweep extend` writes
//! such a list. The sweep's id depends on the training, `over`, `seed` and `stop`. It does not
//! depend on the number of trials or on the origin of their values, so that an extended sweep stays
//! the same, and its trials are compared with the earlier ones.
//!
//! Own trainings (`kind = "python"`) are swept in the same way.
//!
//! [`super::stop`] defines when inferior trials stop. No trial waits for another, and a stopped
//! trial leaves its worker to the next. The set of trials that run to the end therefore depends on
//! their order. The result of each trial does not.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::{
    domain::{Domain, draw},
    limits::MAX_STAGES,
    spec_error::SpecError,
    stop::Stop,
    substitute::substitute,
    trial::Trial,
};

/// The fields of `[stage.sweep]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct SweepText {
    /// Total number of trials; those not listed in `values` are drawn at random. 0 means the listed
    /// trials or, without a list, each combination of values, which must then be lists.
    #[serde(default)]
    trials: u64,
    /// Seed of the draws.
    #[serde(default)]
    seed: u64,
    /// The possible values of each parameter, by name.
    #[serde(default)]
    over: BTreeMap<String, Domain>,
    /// The values of the first trials.
    #[serde(default)]
    values: Vec<Values>,
    /// The rule that stops inferior trials; without it they never stop.
    stop: Option<Stop>,
    /// The name for the best model; defaults to the name of the stage's model.
    #[serde(default)]
    promote: String,
}

/// A trial's values, by the parameters' names.
type Values = BTreeMap<String, Value>;

/// Expands a stage with a sweep into its trials and the stage that chooses the best. A stage
/// without one is returned unchanged.
pub(super) fn trials(mut stage: Value) -> Result<Vec<Value>, SpecError> {
    let Some(sweep) = stage.as_object_mut().and_then(|s| s.remove("sweep")) else {
        return Ok(vec![stage]);
    };
    let fail = |field: &str, what: String| Err(SpecError::new(format!("stage.{field}"), what));
    // The data set counts, the location of its store does not.
    let source = stage.get("source").map(|s| s.get("dataset").unwrap_or(s));
    let of =
        |stage: &Value, field: &str| stage.get(field).and_then(Value::as_str).map(str::to_owned);
    let kind = match of(&stage, "kind").as_deref() {
        Some("train") => "train",
        Some("python") => "python",
        _ => {
            let what = "belongs to kind = \"train\" or \"python\"; remove it";
            return fail("sweep", what.into());
        }
    };
    let mut training = stage[kind].clone();
    let store = training.as_object_mut().and_then(|t| t.remove("store"));
    let described = json!([
        source,
        training,
        sweep["over"],
        sweep["seed"],
        sweep["stop"]
    ]);
    let sweep: SweepText =
        serde_json::from_value(sweep).map_err(|e| SpecError::new("stage.sweep", e.to_string()))?;
    let Some(model) = stage.get(kind).and_then(|training| of(training, "model")) else {
        return fail(
            &format!("{kind}.model"),
            "is missing; name the model".into(),
        );
    };
    if let Some(stop) = sweep.stop {
        stop.check()
            .map_err(|e| SpecError::new(format!("stage.{}", e.field), e.what))?;
    }
    let chosen = sweep.choose()?;
    let name = of(&stage, "name").unwrap_or_else(|| kind.into());
    let id = id(described);
    let (mut stages, mut models) = (Vec::new(), Vec::new());
    for (index, values) in chosen.into_iter().enumerate() {
        let mut trial = stage.clone();
        for (parameter, value) in &values {
            let mark = format!("{{{parameter}}}");
            let before = trial.clone();
            substitute(&mut trial, &mark, value);
            if before == trial {
                let what = format!(
                    "nothing in the stage says \"{mark}\"; write it where the value belongs"
                );
                let field = match sweep.over.contains_key(parameter) {
                    true => format!("sweep.over.{parameter}"),
                    false => format!("sweep.values[0].{parameter}"),
                };
                return fail(&field, what);
            }
        }
        trial["name"] = json!(format!("{name}.{index}"));
        let called = format!("{model}.{index}");
        trial[kind]["model"] = json!(called);
        trial[kind]["trial"] = serde_json::to_value(Trial {
            sweep: model.clone(),
            id: id.clone(),
            index: index as u64,
            values,
            over: sweep.over.clone(),
            seed: sweep.seed,
            stop: sweep.stop,
        })
        .expect("plain data");
        models.push(called);
        stages.push(trial);
    }
    let mut promote = Map::new();
    for field in ["source", "count", "tolerate_dead"] {
        if let Some(value) = stage.get(field) {
            promote.insert(field.into(), value.clone());
        }
    }
    promote.insert("name".into(), json!(name));
    promote.insert("kind".into(), json!("promote"));
    let tolerant = stage.get("tolerate_dead") == Some(&json!(true));
    let named = match sweep.promote.is_empty() {
        true => model,
        false => sweep.promote,
    };
    let mut settings = json!({ "model": named, "among": models, "tolerate_missing": tolerant });
    if let Some(store) = store {
        settings["store"] = store;
    }
    promote.insert("promote".into(), settings);
    stages.push(Value::Object(promote));
    Ok(stages)
}

/// Returns the id that distinguishes sweeps.
fn id(mut described: Value) -> String {
    described.sort_all_objects();
    let mut id = hex::encode(Sha256::digest(described.to_string().as_bytes()));
    id.truncate(16);
    id
}

impl SweepText {
    /// Returns the values of every trial.
    fn choose(&self) -> Result<Vec<Values>, SpecError> {
        let fail = |field: String, what: String| Err(SpecError::new(field, what));
        if self.over.is_empty() && self.values.is_empty() {
            let what = "names no parameter, e.g. over = { lr = { log = [1e-4, 1e-1] } }";
            return fail("stage.sweep.over".into(), what.into());
        }
        for (parameter, domain) in &self.over {
            if let Some(what) = domain.fault() {
                return fail(format!("stage.sweep.over.{parameter}"), what);
            }
        }
        let (trials, listed) = (self.trials, self.values.len() as u64);
        if trials.max(listed) > MAX_STAGES as u64 - 1 {
            let field = if trials >= listed { "trials" } else { "values" };
            let what = format!("{} are more than {}", trials.max(listed), MAX_STAGES - 1);
            return fail(format!("stage.sweep.{field}"), what);
        }
        self.check_values()?;
        if trials == 0 && listed == 0 {
            return self.grid();
        }
        if trials > 0 && trials < listed {
            let what = format!(
                "{trials} are fewer than the {listed} that sweep.values lists; say how many there are in all, or leave it away"
            );
            return fail("stage.sweep.trials".into(), what);
        }
        if self.over.is_empty() && trials > listed {
            let what = format!(
                "names no parameter to draw trials {listed} to {} from; give it, or leave sweep.trials away",
                trials - 1
            );
            return fail("stage.sweep.over".into(), what);
        }
        let drawn = (listed..trials).map(|trial| draw(&self.over, self.seed, trial));
        Ok(self.values.iter().cloned().chain(drawn).collect())
    }

    /// Checks that the listed values name every parameter and no other, and are in their domains.
    fn check_values(&self) -> Result<(), SpecError> {
        let fail = |i: usize, parameter: &str, what: String| {
            let field = format!("stage.sweep.values[{i}].{parameter}");
            Err(SpecError::new(field, what))
        };
        let parameters: Vec<&String> = match self.over.is_empty() {
            true => self
                .values
                .iter()
                .take(1)
                .flat_map(BTreeMap::keys)
                .collect(),
            false => self.over.keys().collect(),
        };
        if parameters.is_empty() {
            let what = "names no parameter, e.g. values = [{ lr = 0.01 }]";
            return Err(SpecError::new("stage.sweep.values[0]", what));
        }
        for (i, values) in self.values.iter().enumerate() {
            for parameter in &parameters {
                if !values.contains_key(*parameter) {
                    return fail(
                        i,
                        parameter,
                        "is missing; each trial needs a value of it".into(),
                    );
                }
            }
            for (parameter, value) in values {
                match self.over.get(parameter) {
                    Some(domain) if !domain.contains(value) => {
                        let domain = serde_json::to_string(domain).expect("plain data");
                        let what = format!(
                            "{value} is not in {domain}; change it, or widen sweep.over.{parameter}"
                        );
                        return fail(i, parameter, what);
                    }
                    None if !parameters.contains(&parameter) => {
                        let what = "is no parameter of the others; name the same in each trial, or give it in sweep.over";
                        return fail(i, parameter, what.into());
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Returns each combination of values.
    fn grid(&self) -> Result<Vec<Values>, SpecError> {
        let mut grid = vec![BTreeMap::new()];
        for (parameter, values) in &self.over {
            let Domain::OneOf(values) = values else {
                let what =
                    "is an interval: say how many trials are drawn (sweep.trials), or list values";
                return Err(SpecError::new(
                    format!("stage.sweep.over.{parameter}"),
                    what,
                ));
            };
            if grid.len() * values.len() >= MAX_STAGES {
                let what = format!(
                    "stands for {MAX_STAGES} trials or more; say how many are drawn (sweep.trials)"
                );
                return Err(SpecError::new("stage.sweep.over", what));
            }
            let with = |chosen: &Values, value: &Value| {
                let mut chosen = chosen.clone();
                chosen.insert(parameter.clone(), value.clone());
                chosen
            };
            grid = grid
                .iter()
                .flat_map(|chosen| values.iter().map(|value| with(chosen, value)))
                .collect();
        }
        Ok(grid)
    }
}
