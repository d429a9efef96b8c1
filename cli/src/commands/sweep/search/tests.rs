//! Searches for the known minimum of test functions.

use super::{Outcome, Space, Tried, Values, tpe};
use serde_json::json;

/// A function over a space, with a minimum of about 0.
struct Objective {
    name: &'static str,
    space: Space,
    of: fn(&Values) -> f64,
}

fn number(values: &Values, name: &str) -> f64 {
    values[name].as_f64().unwrap()
}

fn text<'a>(values: &'a Values, name: &str) -> &'a str {
    values[name].as_str().unwrap()
}

/// Returns the distance of two numbers in decades.
fn decades(x: f64, from: f64) -> f64 {
    (x / from).log10()
}

fn objectives() -> Vec<Objective> {
    let objective = |name, space: serde_json::Value, of| Objective {
        name,
        space: serde_json::from_value(space).unwrap(),
        of,
    };
    vec![
        objective(
            "sphere, 2 numbers",
            json!({"x": {"range": [-5, 5]}, "y": {"range": [-5, 5]}}),
            |v| (number(v, "x") - 1.3).powi(2) + (number(v, "y") + 2.1).powi(2),
        ),
        objective(
            "rate, decay and width",
            json!({"lr": {"log": [1e-5, 1e-1]}, "decay": {"log": [1e-6, 1e-1]}, "width": {"int": [2, 64]}}),
            |v| {
                decades(number(v, "lr"), 2e-3).powi(2)
                    + 0.2 * decades(number(v, "decay"), 1e-4).powi(2)
                    + 0.1 * (number(v, "width") / 48.0).log2().powi(2)
            },
        ),
        objective(
            "of lists, and a rate that goes with one",
            json!({"lr": {"log": [1e-5, 1e-1]}, "kind": ["a", "b", "c", "d"], "schedule": ["flat", "cosine", "step"]}),
            |v| {
                let (rate, worse) = match text(v, "kind") {
                    "a" => (1e-4, 0.8),
                    "b" => (1e-2, 0.0),
                    "c" => (1e-3, 0.4),
                    _ => (3e-5, 1.5),
                };
                let schedule = if text(v, "schedule") == "cosine" {
                    0.0
                } else {
                    0.3
                };
                decades(number(v, "lr"), rate).powi(2) + worse + schedule
            },
        ),
        objective(
            "a valley over 6",
            json!({"a": {"range": [-2, 2]}, "b": {"range": [-2, 2]}, "c": {"log": [1e-3, 1e1]}, "d": {"int": [0, 20]},
                   "e": ["x", "y", "z"], "f": {"range": [0, 1]}}),
            |v| {
                let (a, b) = (number(v, "a"), number(v, "b"));
                let valley = (1.0 - a).powi(2) + 10.0 * (b - a * a).powi(2);
                let listed = if text(v, "e") == "y" { 0.0 } else { 1.0 };
                valley
                    + decades(number(v, "c"), 0.1).powi(2)
                    + (number(v, "d") - 13.0).powi(2) / 40.0
                    + listed
                    + number(v, "f")
            },
        ),
    ]
}

type Search = fn(&Space, &[Tried], u64, u64, u64) -> Vec<Values>;

/// Returns the lowest value found with `trials` trials, in rounds.
fn least(objective: &Objective, search: Search, seed: u64, trials: u64, round: u64) -> f64 {
    let mut tried: Vec<Tried> = Vec::new();
    while (tried.len() as u64) < trials {
        let proposed = search(&objective.space, &tried, seed, tried.len() as u64, round);
        assert_eq!(proposed.len() as u64, round);
        tried.extend(proposed.into_iter().map(|values| Tried {
            outcome: Outcome::Finished((objective.of)(&values)),
            values,
        }));
    }
    let losses = tried.iter().map(|t| match t.outcome {
        Outcome::Finished(loss) => loss,
        _ => f64::INFINITY,
    });
    losses.fold(f64::INFINITY, f64::min)
}

fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let middle = numbers.len() / 2;
    match numbers.len() % 2 {
        1 => numbers[middle],
        _ => numbers[middle - 1].midpoint(numbers[middle]),
    }
}

#[test]
fn the_estimator_finds_better_values_than_draws_at_random() {
    const SEEDS: u64 = 24;
    for objective in objectives() {
        let found = |search: Search| -> Vec<f64> {
            (0..SEEDS)
                .map(|seed| least(&objective, search, seed, 60, 6))
                .collect()
        };
        let (tpe, random) = (found(tpe::propose), found(tpe::random));
        let better = tpe.iter().zip(&random).filter(|(a, b)| a < b).count();
        let (tpe, random) = (median(tpe), median(random));
        println!(
            "{}: {tpe:.4} beside {random:.4}; better {better} of {SEEDS} times",
            objective.name
        );
        assert!(tpe < 0.7 * random, "{}: {tpe} {random}", objective.name);
        assert!(
            better as u64 * 3 >= SEEDS * 2,
            "{}: {better}",
            objective.name
        );
    }
}

#[test]
fn the_same_records_give_the_same_proposals_and_others_other_ones() {
    let objective = &objectives()[1];
    let tried: Vec<Tried> = tpe::random(&objective.space, &[], 5, 0, 20)
        .into_iter()
        .map(|values| Tried {
            outcome: Outcome::Finished((objective.of)(&values)),
            values,
        })
        .collect();
    let proposed = tpe::propose(&objective.space, &tried, 5, 20, 8);
    assert_eq!(proposed, tpe::propose(&objective.space, &tried, 5, 20, 8));
    // A longer round begins with the shorter one.
    assert_eq!(
        proposed[..5],
        tpe::propose(&objective.space, &tried, 5, 20, 5)
    );
    assert_ne!(proposed, tpe::propose(&objective.space, &tried, 6, 20, 8));
    let mut other = tried.clone();
    other.retain(|t| !matches!(t.outcome, Outcome::Finished(loss) if loss < 1.0));
    assert!((10..20).contains(&other.len()), "{}", other.len());
    assert_ne!(proposed, tpe::propose(&objective.space, &other, 5, 20, 8));
    // To the digit, on every machine.
    let text = serde_json::to_string(&proposed[..2]).unwrap();
    assert_eq!(
        text,
        r#"[{"decay":4.895e-6,"lr":0.0003978,"width":48},{"decay":0.00005552,"lr":0.00046,"width":64}]"#
    );
}

#[test]
fn before_enough_trials_have_ended_values_are_those_that_the_sweep_draws() {
    let space = &objectives()[1].space;
    let few: Vec<Tried> = tpe::random(space, &[], 3, 0, 9)
        .into_iter()
        .map(|values| Tried {
            values,
            outcome: Outcome::Finished(1.0),
        })
        .collect();
    let drawn = |trial| picofarm_proto::spec::domain::draw(space, 3, trial);
    let proposed = tpe::propose(space, &few, 3, 9, 4);
    assert_eq!(proposed, (9..13).map(drawn).collect::<Vec<_>>());
}

#[test]
fn nothing_is_proposed_twice_and_nothing_once_all_has_been_tried() {
    let space: Space =
        serde_json::from_value(json!({"a": ["x", "y", "z"], "n": {"int": [1, 5]}})).unwrap();
    let mut tried: Vec<Tried> = Vec::new();
    for round in 0..9 {
        for values in tpe::propose(&space, &tried.clone(), 1, round * 2, 2) {
            assert!(!tried.iter().any(|t| t.values == values), "{values:?}");
            let loss = number(&values, "n");
            tried.push(Tried {
                values,
                outcome: Outcome::Finished(loss),
            });
        }
    }
    assert_eq!(tried.len(), 15);
    assert!(tpe::propose(&space, &tried, 1, 15, 3).is_empty());
}

#[test]
fn trials_that_stopped_early_teach_less_than_those_that_came_further() {
    let space: Space = serde_json::from_value(json!({"x": {"range": [0, 1]}})).unwrap();
    let at = |x: f64, outcome| Tried {
        values: [("x".to_owned(), json!(x))].into(),
        outcome,
    };
    // Trials near 0.9 ran long; those near 0.1 look better, but stopped at once.
    let mut tried = Vec::new();
    for i in 0..15 {
        let x = f64::from(i) * 0.005;
        tried.push(at(
            0.9 + x,
            Outcome::Stopped {
                epochs: 27,
                loss: 0.5 + x,
            },
        ));
        tried.push(at(
            0.1 + x,
            Outcome::Stopped {
                epochs: 3,
                loss: 0.1 + x,
            },
        ));
        tried.push(at(0.5 + x, Outcome::Failed));
    }
    let proposed = tpe::propose(&space, &tried, 0, 45, 4);
    assert!(
        proposed.iter().filter(|v| number(v, "x") > 0.75).count() >= 3,
        "{proposed:?}"
    );
}
