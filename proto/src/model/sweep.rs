//! Sweeps: one train stage stands for many trainings, *trials*, whose values are a grid or drawn at random, and for a last
//! step that gives the best of them a name of its own.
//!
//! ```toml
//! [stage.sweep]
//! trials = 27                                   # drawn at random; without it, the whole grid
//! halving = { first = 3, factor = 3 }           # after 3, 9, 27, … epochs only the best third goes on
//! over = { lr = { log = [1e-4, 1e-1] }, width = [8, 16], levels = { int = [2, 4] } }
//! [stage.train]
//! model = "depth"                               # trials are depth.0, depth.1, …; the best of them becomes depth
//! net = { width = "{width}", levels = "{levels}" }
//! optimise = { learning_rate = "{lr}", epochs = 81 }
//! ```
//!
//! Trial `i` of `tof` is a stage of one task, `tof.i`, an ordinary training with ordinary settings: it is leased, resumed,
//! reused and looked at as any other. Its draws follow from the seed, its number and the parameters' names alone, so more
//! trials later are further ones. `tof` itself becomes a stage of kind `promote` which needs all of them.
//!
//! Halving is ASHA's rule (Li et al., "A System for Massively Parallel Hyperparameter Tuning", MLSys 2020) in the form that
//! stops: a trial that reaches a rung goes on if it is among the best 1/factor of those that have reached it by then. No
//! trial waits for another, and one that stops leaves its worker to the next. Which trials come to their end thus depends
//! on which came first; what each of them computes does not.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::{
    limits::MAX_STAGES,
    spec_error::SpecError,
    substitute::substitute,
    trial::{Halving, Trial},
};

/// `[stage.sweep]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct SweepText {
    /// Trials drawn at random; 0 = each combination of values, which must be lists.
    #[serde(default)]
    trials: u64,
    /// Seed of the draws.
    #[serde(default)]
    seed: u64,
    /// By the parameters' names: the values that each may have.
    over: BTreeMap<String, Values>,
    /// When trials stop that fall behind; never without it.
    halving: Option<Halving>,
    /// The name that the best model gets; that of the stage's model without it.
    #[serde(default)]
    promote: String,
}

/// The values that a parameter may have.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
enum Values {
    /// One of these.
    OneOf(Vec<Value>),
    /// An interval.
    Within(Interval),
}

/// An interval: `{ range = [a, b] }`, `{ log = [a, b] }` or `{ int = [a, b] }`, ends among it.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Interval {
    /// Every number alike.
    Range([f64; 2]),
    /// Every order of magnitude alike.
    Log([f64; 2]),
    /// Every whole number alike.
    Int([i64; 2]),
}

/// The stages that a stage with a sweep stands for, its trials and what chooses among them; one without stands for itself.
pub(super) fn trials(mut stage: Value) -> Result<Vec<Value>, SpecError> {
    let Some(sweep) = stage.as_object_mut().and_then(|s| s.remove("sweep")) else {
        return Ok(vec![stage]);
    };
    let fail = |field: &str, what: String| Err(SpecError::new(format!("stage.{field}"), what));
    // Where a store lies does not count, only what lies in it.
    let source = stage.get("source").map(|s| s.get("dataset").unwrap_or(s));
    let described = json!([
        source,
        stage["train"],
        sweep["over"],
        sweep["seed"],
        sweep["halving"]
    ]);
    let sweep: SweepText =
        serde_json::from_value(sweep).map_err(|e| SpecError::new("stage.sweep", e.to_string()))?;
    let of =
        |stage: &Value, field: &str| stage.get(field).and_then(Value::as_str).map(str::to_owned);
    if of(&stage, "kind").as_deref() != Some("train") {
        return fail("sweep", "belongs to kind = \"train\"; remove it".into());
    }
    let Some(model) = stage.get("train").and_then(|train| of(train, "model")) else {
        return fail("train.model", "is missing; name the model".into());
    };
    if let Some(halving) = sweep.halving {
        halving
            .check()
            .map_err(|e| SpecError::new(format!("stage.{}", e.field), e.what))?;
    }
    let chosen = sweep.choose()?;
    let name = of(&stage, "name").unwrap_or_else(|| "train".into());
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
                return fail(&format!("sweep.over.{parameter}"), what);
            }
        }
        trial["name"] = json!(format!("{name}.{index}"));
        let called = format!("{model}.{index}");
        trial["train"]["model"] = json!(called);
        trial["train"]["trial"] = serde_json::to_value(Trial {
            sweep: model.clone(),
            id: id.clone(),
            index: index as u64,
            values,
            halving: sweep.halving,
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
    promote.insert(
        "promote".into(),
        json!({ "model": named, "among": models, "tolerate_missing": tolerant }),
    );
    stages.push(Value::Object(promote));
    Ok(stages)
}

/// Tells sweeps apart.
fn id(mut described: Value) -> String {
    described.sort_all_objects();
    let mut id = hex::encode(Sha256::digest(described.to_string().as_bytes()));
    id.truncate(16);
    id
}

impl SweepText {
    /// The values of every trial.
    fn choose(&self) -> Result<Vec<BTreeMap<String, Value>>, SpecError> {
        let fail = |field: String, what: String| Err(SpecError::new(field, what));
        if self.over.is_empty() {
            let what = "names no parameter, e.g. over = { lr = { log = [1e-4, 1e-1] } }";
            return fail("stage.sweep.over".into(), what.into());
        }
        for (parameter, values) in &self.over {
            if let Some(what) = values.fault() {
                return fail(format!("stage.sweep.over.{parameter}"), what);
            }
        }
        if self.trials > MAX_STAGES as u64 - 1 {
            let what = format!("{} are more than {}", self.trials, MAX_STAGES - 1);
            return fail("stage.sweep.trials".into(), what);
        }
        match self.trials {
            0 => self.grid(),
            n => Ok((0..n).map(|trial| self.draw(trial)).collect()),
        }
    }

    /// Each combination.
    fn grid(&self) -> Result<Vec<BTreeMap<String, Value>>, SpecError> {
        let mut grid = vec![BTreeMap::new()];
        for (parameter, values) in &self.over {
            let Values::OneOf(values) = values else {
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
            let with = |chosen: &BTreeMap<String, Value>, value: &Value| {
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

    /// One combination at random.
    fn draw(&self, trial: u64) -> BTreeMap<String, Value> {
        let over = self.over.iter();
        over.map(|(parameter, values)| {
            let mut hash = Sha256::new();
            hash.update(b"trial");
            hash.update(self.seed.to_le_bytes());
            hash.update(trial.to_le_bytes());
            hash.update(parameter.as_bytes());
            let digest = hash.finalize();
            let bits = u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"));
            (parameter.clone(), values.at(bits))
        })
        .collect()
    }
}

impl Values {
    /// What is wrong with them.
    fn fault(&self) -> Option<String> {
        let ordered = |a: f64, b: f64| a.is_finite() && b.is_finite() && a < b;
        match self {
            Self::OneOf(values) => values.is_empty().then(|| "lists no value".into()),
            Self::Within(Interval::Range([a, b])) => {
                (!ordered(*a, *b)).then(|| format!("{a} must lie below {b}"))
            }
            Self::Within(Interval::Log([a, b])) => (!ordered(*a, *b) || *a <= 0.0)
                .then(|| format!("{a} must lie above 0 and below {b}")),
            Self::Within(Interval::Int([a, b])) => {
                (a >= b || b.checked_sub(*a).is_none()).then(|| format!("{a} must lie below {b}"))
            }
        }
    }

    /// The value that random bits choose. Numbers of an interval have four digits, which are readable and the same on
    /// every machine.
    fn at(&self, bits: u64) -> Value {
        let share = (bits >> 11) as f64 / (1u64 << 53) as f64;
        let whole = |n: u64| ((u128::from(bits) * u128::from(n)) >> 64) as u64;
        let four = |x: f64, [a, b]: [f64; 2]| {
            let rounded: f64 = format!("{x:.3e}").parse().expect("a number");
            json!(rounded.clamp(a, b))
        };
        match self {
            Self::OneOf(values) => values[whole(values.len() as u64) as usize].clone(),
            Self::Within(Interval::Range(ends)) => {
                four(ends[0] + share * (ends[1] - ends[0]), *ends)
            }
            Self::Within(Interval::Log(ends)) => {
                let [a, b] = ends.map(libm::log);
                four(libm::exp(a + share * (b - a)), *ends)
            }
            Self::Within(Interval::Int([a, b])) => json!(a + whole((b - a) as u64 + 1) as i64),
        }
    }
}
