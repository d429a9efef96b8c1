//! The numbers that techniques are tuned by reach the techniques.

use picofarm_scene::{Material, Scene};
use picofarm_transient::{
    Budget, Gate, Rendered, Settings, Strategy, Tuning, render, render_tuned,
};
use serde_json::{Value, json};

use crate::{
    common::{Quiet, gate, grey, quad, room, scene, settings, v},
    determinism::everything,
};

/// Returns a room with a mirror and seven spots, one of them a centimetre from a board.
fn mirrors(size: u32) -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.push(quad(
        v(-1.9, -1.0, -3.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, 2.0),
        Material::mirror("mirror", 0.02),
    ));
    objects.push(quad(
        v(0.42, -1.0, -4.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, 0.5),
        grey(0.7),
    ));
    let beams: Vec<_> = (0..7).map(|k| v(0.1 * k as f32 - 0.2, 0.1, -1.0)).collect();
    scene(objects, size, &beams)
}

fn cases() -> Vec<(Scene, Settings)> {
    let narrow = Gate {
        start_m: 9.0,
        bin_width_m: 0.02,
        bins: 4,
    };
    let all = settings(Budget::Samples(2));
    let with = |strategy: Strategy, gate: Gate| Settings {
        gate,
        strategy,
        ..all.clone()
    };
    let wanted = Strategy {
        caustics: Some(true),
        ..Strategy::default()
    };
    let ellipsoidal = Strategy {
        ellipsoidal: Some(true),
        ..Strategy::default()
    };
    vec![
        (everything(8), with(wanted.clone(), gate())),
        (mirrors(8), with(wanted, gate())),
        (everything(8), with(ellipsoidal, narrow)),
        (
            everything(8),
            Settings {
                max_bounces: Some(2),
                ..all.clone()
            },
        ),
        (
            mirrors(8),
            with(
                Strategy {
                    path_reuse: Some(4),
                    ..Strategy::default()
                },
                gate(),
            ),
        ),
        (
            mirrors(8),
            Settings {
                budget: Budget::Error(0.5),
                ..all.clone()
            },
        ),
    ]
}

fn bits(r: &Rendered) -> Vec<u32> {
    let split = r.split.as_ref().unwrap();
    let planes = [&r.transient, &split.two_se, &split.multi_se];
    let values = planes.into_iter().flatten().map(|x| x.to_bits());
    values.chain([r.error.samples]).collect()
}

/// Returns the paths of all numbers in a value.
fn numbers(value: &Value, path: &str) -> Vec<String> {
    match value {
        Value::Object(fields) => fields
            .iter()
            .flat_map(|(name, field)| numbers(field, &format!("{path}/{name}")))
            .collect(),
        _ => vec![path.to_owned()],
    }
}

/// Returns other values for a number: smaller and larger ones.
fn others(value: &Value) -> Vec<Value> {
    match value.as_u64() {
        Some(n) => vec![json!(n / 4 + 1), json!(n * 2 + 1)],
        None => {
            let x = value.as_f64().unwrap();
            vec![json!(x * 0.5), json!(x * 1.6)]
        }
    }
}

/// Numbers that change nothing in these small scenes.
const UNUSED: &[&str] = &[];

#[test]
fn every_number_reaches_its_technique() {
    let cases = cases();
    let plain: Vec<_> = cases
        .iter()
        .map(|(scene, set)| bits(&render(scene, set, &Quiet).unwrap()))
        .collect();
    let default = serde_json::to_value(Tuning::default()).unwrap();
    let mut unused = vec![];
    for path in numbers(&default, "") {
        let changes = |value: Value| {
            let mut changed = default.clone();
            *changed.pointer_mut(&path).unwrap() = value;
            let tuning: Tuning = serde_json::from_value(changed).unwrap();
            let mut each = cases.iter().zip(&plain);
            each.any(|((scene, set), plain)| {
                bits(&render_tuned(scene, set, &tuning, &Quiet).unwrap()) != *plain
            })
        };
        if !others(default.pointer(&path).unwrap())
            .into_iter()
            .any(changes)
        {
            unused.push(path);
        }
    }
    assert_eq!(unused, UNUSED);
}

#[test]
fn a_number_that_does_not_exist_is_named() {
    let error = serde_json::from_str::<Tuning>(r#"{"walk":{"spot":8}}"#).unwrap_err();
    assert!(
        error.to_string().contains("unknown field `spot`"),
        "{error}"
    );
}
