//! Against the reference transients of an independent renderer (skipped where they are absent).

mod common;

use common::{Quiet, reference, settings};
use picofarm_transient::{Budget, render};

fn check(name: &str, paths: u32) {
    let Some((scene, _)) = reference::load(name) else {
        return;
    };
    let rendered = render(&scene, &settings(Budget::Samples(paths)), &Quiet).unwrap();
    let split = rendered.split.as_ref().unwrap();
    let two = reference::compare(&split.two, &split.two_se, &reference::part(name, "two"));
    let multi = reference::compare(
        &split.multi,
        &split.multi_se,
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
    check("room-diffuse-1", 1024);
}

#[test]
fn room_diffuse_agrees_with_the_reference() {
    check("room-diffuse", 512);
}

#[test]
fn room_mirror_agrees_with_the_reference() {
    check("room-mirror", 512);
}
