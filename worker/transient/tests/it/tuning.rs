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
        (everything(8), with(wanted, gate())),
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

/// Numbers that these small scenes do not depend on: limits that only large scenes reach, numbers
/// for larger images, shares of time, and forecasts.
const BEYOND_SMALL_SCENES: [&str; 41] = [
    "/beams/least_branch",
    "/beams/most_turns",
    "/caustics/paths",
    "/caustics/pays",
    "/caustics/probe",
    "/caustics/smoother",
    "/contacts/close",
    "/contacts/least",
    "/contacts/least_range",
    "/contacts/least_tile_paths",
    "/contacts/most_paths",
    "/contacts/most_range",
    "/contacts/much",
    "/contacts/pixels_per_path",
    "/contacts/tile_paths",
    "/ellipsoid/most_pieces",
    "/ellipsoid/narrow",
    "/error/most_rise",
    "/error/rise",
    "/glass/elsewhere",
    "/glass/least_looked_at",
    "/glass/least_share",
    "/glass/most_known",
    "/glass/most_planes",
    "/glass/paths",
    "/glass/photon_flat",
    "/mirrors/least_share",
    "/mirrors/most_planes",
    "/path_reuse/glossy",
    "/path_reuse/rough_spots",
    "/path_reuse/wide/extra",
    "/reflectors/most",
    "/rounds/first_share",
    "/rounds/forecast_passes",
    "/rounds/forecast_tiles",
    "/rounds/growth",
    "/rounds/large_image",
    "/rounds/large_tile",
    "/rounds/many_histograms",
    "/rounds/timed",
    "/two_bounce/narrow_pixels",
];

#[test]
fn every_number_for_small_scenes_changes_one() {
    let cases = cases();
    let plain: Vec<_> = cases
        .iter()
        .map(|(scene, set)| bits(&render(scene, set, &Quiet).unwrap()))
        .collect();
    let default = serde_json::to_value(Tuning::default()).unwrap();
    let all = numbers(&default, "");
    for path in BEYOND_SMALL_SCENES {
        assert!(all.iter().any(|p| p == path), "{path} is no number");
    }
    for path in all
        .iter()
        .filter(|p| !BEYOND_SMALL_SCENES.contains(&p.as_str()))
    {
        let changes = |value: Value| {
            let mut changed = default.clone();
            *changed.pointer_mut(path).unwrap() = value;
            let tuning: Tuning = serde_json::from_value(changed).unwrap();
            let mut each = cases.iter().zip(&plain);
            each.any(|((scene, set), plain)| {
                bits(&render_tuned(scene, set, &tuning, &Quiet).unwrap()) != *plain
            })
        };
        let others = others(default.pointer(path).unwrap());
        assert!(others.into_iter().any(changes), "{path} changes no bit");
    }
}

#[test]
fn a_number_that_does_not_exist_is_named() {
    let error = serde_json::from_str::<Tuning>(r#"{"walk":{"spot":8}}"#).unwrap_err();
    assert!(
        error.to_string().contains("unknown field `spot`"),
        "{error}"
    );
}
