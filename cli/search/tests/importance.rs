//! Importance of parameters for functions with known importances.

use std::collections::BTreeMap;

use picofarm_search::{
    Outcome, Space, Tried,
    importance::{FEW, Importance, LEAST, importance},
    tpe,
};
use serde_json::json;

fn space() -> Space {
    let space = json!({"x": {"range": [0, 1]}, "y": {"log": [1e-3, 1]}, "z": {"int": [0, 30]}});
    serde_json::from_value(space).unwrap()
}

/// Weights 1 for x, 0.1 for y and 0 for z.
fn weighs(values: &BTreeMap<String, serde_json::Value>) -> f64 {
    let of = |name: &str| values[name].as_f64().unwrap();
    let y = (of("y").log10() + 3.0) / 3.0;
    (of("x") - 0.3).powi(2) + 0.1 * (y - 0.6).powi(2)
}

fn tried(trials: u64, seed: u64) -> Vec<Tried> {
    let values = tpe::random(&space(), &[], seed, 0, trials);
    values
        .into_iter()
        .map(|values| Tried {
            outcome: Outcome::Finished(weighs(&values)),
            values,
        })
        .collect()
}

fn of(found: &Importance, name: &str) -> (f64, f64) {
    let parameter = found
        .parameters
        .iter()
        .find(|p| p.parameter == name)
        .unwrap();
    (parameter.share, parameter.chance)
}

#[test]
fn what_weighs_more_has_the_greater_share_and_what_weighs_nothing_is_chance() {
    let found = importance(&space(), &tried(300, 1)).unwrap();
    assert_eq!((found.trials, found.top), (300, 30));
    let names: Vec<&str> = found.parameters.iter().map(|p| &*p.parameter).collect();
    assert_eq!(names, ["x", "y", "z"]);
    let ((x, by_x), (y, by_y), (z, by_z)) = (of(&found, "x"), of(&found, "y"), of(&found, "z"));
    assert!((x + y + z - 1.0).abs() < 1e-9);
    assert!(x > 0.6 && y > z, "{found:?}");
    assert!(by_x < 0.01 && by_y < 0.05 && by_z > 0.05, "{found:?}");
}

#[test]
fn shares_are_those_of_optuna() {
    // PedAnovaImportanceEvaluator of Optuna 5.0.0 on the same trials
    // (tests/peers/search_optuna.py).
    for (trials, seed, shares) in [
        (300, 1, [0.8623, 0.1337, 0.0040]),
        (300, 2, [0.9211, 0.0747, 0.0042]),
        (100, 1, [0.7705, 0.2212, 0.0083]),
        (50, 3, [0.8572, 0.0510, 0.0918]),
    ] {
        let found = importance(&space(), &tried(trials, seed)).unwrap();
        for (name, share) in ["x", "y", "z"].iter().zip(shares) {
            let ours = of(&found, name).0;
            println!("{trials} trials, seed {seed}: {name} {ours:.4}, Optuna {share}");
            assert!(
                (ours - share).abs() < 0.01,
                "{trials} {seed} {name}: {ours} {share}"
            );
        }
    }
}

#[test]
fn a_list_that_decides_all_has_the_greatest_share() {
    let space: Space =
        serde_json::from_value(json!({"kind": ["a", "b", "c", "d"], "x": {"range": [0, 1]}}))
            .unwrap();
    let values = tpe::random(&space, &[], 2, 0, 120);
    let tried: Vec<Tried> = values
        .into_iter()
        .map(|values| Tried {
            // For the third kind, the last digits of x, which are independent of its size.
            outcome: match values["kind"] == json!("c") {
                true => Outcome::Finished((values["x"].as_f64().unwrap() * 1000.0).fract()),
                false => Outcome::Stopped {
                    epochs: 3,
                    loss: 0.5,
                },
            },
            values,
        })
        .collect();
    let found = importance(&space, &tried).unwrap();
    assert_eq!(found.parameters[0].parameter, "kind", "{found:?}");
    assert!(found.parameters[0].chance < 0.01);
}

#[test]
fn too_few_trials_have_no_importance_and_how_few_mislead_is_known() {
    assert!(importance(&space(), &tried(LEAST as u64 - 1, 1)).is_none());
    // Returns the percentage of runs that rank x first, and of those that wrongly find z
    // significant.
    let rates = |trials: u64| {
        let found: Vec<Importance> = (0..100)
            .map(|seed| importance(&space(), &tried(trials, seed)).unwrap())
            .collect();
        let first = found
            .iter()
            .filter(|f| f.parameters[0].parameter == "x")
            .count();
        let sure = found.iter().filter(|f| of(f, "x").1 <= 0.05).count();
        let wrong = found.iter().filter(|f| of(f, "z").1 <= 0.05).count();
        println!(
            "{trials} trials: first {first} %, sure of x {sure} %, wrongly sure of z {wrong} %"
        );
        (first, wrong)
    };
    for trials in [10, 20, FEW as u64, 80] {
        let (first, wrong) = rates(trials);
        // The test's nominal rate, with the spread of 100 repetitions.
        assert!(wrong <= 12, "{trials}: {wrong}");
        if trials >= FEW as u64 {
            assert!(first >= 85, "{trials}: {first}");
        }
    }
}
