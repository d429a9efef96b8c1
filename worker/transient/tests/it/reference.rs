//! Comparison with the reference transients of an independent renderer (skipped if they are
//! absent).

use crate::common;

use common::{Quiet, reference, settings};
use picofarm_transient::{Budget, Settings, render};

fn check(name: &str, paths: u32) {
    let Some((scene, _)) = reference::load(name) else {
        return;
    };
    let rendered = render(&scene, &settings(Budget::Samples(paths)), &Quiet).unwrap();
    let split = rendered.split.as_ref().unwrap();
    let two = reference::compare(&split.two, None, &reference::part(name, "two"));
    let multi = reference::compare(
        &split.multi,
        Some(&split.multi_noise),
        &reference::part(name, "multi"),
    );
    println!(
        "{name}: {:?}\n{} rays {:?}",
        rendered.error, rendered.rays, rendered.plan
    );
    println!("two   {two:?}\nmulti {multi:?}");
    assert!(two.median < (two.reference_median.powi(2) + 0.02f64.powi(2)).sqrt());
    assert!((two.ratio - 1.0).abs() < 0.005);
    assert!(multi.z_rms < 1.3);
    assert!((multi.ratio - 1.0).abs() < 0.015);
}

#[test]
fn room_diffuse_with_one_spot_agrees_with_the_reference() {
    check("room-diffuse-1", 256);
}

#[test]
fn room_diffuse_agrees_with_the_reference() {
    check("room-diffuse", 128);
}

#[test]
fn room_mirror_agrees_with_the_reference() {
    check("room-mirror", 128);
}

#[test]
fn one_bounce_peaks_stand_where_and_as_high_as_the_reference_says() {
    let Some((scene, json)) = reference::load("room-mirror") else {
        return;
    };
    let only_one = Settings {
        max_bounces: Some(1),
        one_bounce: true,
        ..settings(Budget::Samples(1))
    };
    let r = render(&scene, &only_one, &Quiet).unwrap();
    let mut expected = vec![0.0f64; r.transient.len()];
    for s in json["spots"].as_array().unwrap() {
        let number = |key: &str| s[key].as_f64().unwrap_or(0.0);
        let pixel = |film: f64| (film * 64.0 + 1e-9) as usize;
        let k = pixel(number("film_v")) * 64 + pixel(number("film_u"));
        let bin = ((number("one_bounce_opl") - 1.0) / 0.0384) as usize;
        let area = (2.0f64 / 64.0).powi(2);
        // Absent if the camera does not see the spot.
        let value = s["one_bounce_value_times_Apix"].as_f64().unwrap_or(0.0);
        expected[k * 637 + bin] += value / area;
    }
    let highest = expected.iter().fold(0.0f64, |a, &b| a.max(b));
    for (i, (&h, &e)) in r.transient.iter().zip(&expected).enumerate() {
        // A peak on the edge between two pixels may be in either.
        let moved = i >= 637 && expected[i - 637] > 0.0 || e > 0.0 && h == 0.0;
        assert!(
            moved || (f64::from(h) - e).abs() < 1e-3 * highest,
            "{i}: {h} {e}"
        );
    }
    let (sum, all) = (common::energy(&r.transient), expected.iter().sum::<f64>());
    assert!((sum / all - 1.0).abs() < 1e-3, "{sum} {all}");
}
