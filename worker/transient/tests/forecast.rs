//! What `plan` says of a render is about what the render then takes.

mod common;

use common::{Quiet, grey, room, scene, settings, v};
use picofarm_transient::{Budget, Settings, plan, render};

fn check(settings: &Settings) {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let beams = [v(0.3, 0.2, -1.0), v(-0.4, 0.1, -1.0)];
    let scene = scene(walls, 64, &beams);
    let forecast = plan(&scene, settings).unwrap();
    let rendered = render(&scene, settings, &Quiet).unwrap();
    let about = |a: f64, b: f64, within: f64| (a / b).max(b / a) <= within;
    assert!(
        about(forecast.rays as f64, rendered.rays as f64, 1.5),
        "{settings:?}: {} rays foretold, {} taken",
        forecast.rays,
        rendered.rays
    );
    let (foretold, found) = (forecast.error, rendered.error.median_relative);
    assert!(
        about(f64::from(foretold), f64::from(found), 1.5),
        "{settings:?}: error {foretold} foretold, {found} found"
    );
    let (passes, spent) = (forecast.passes, rendered.error.samples);
    assert!(
        about(f64::from(passes + 1), f64::from(spent + 1), 2.0),
        "{settings:?}: {passes} passes foretold, {spent} spent"
    );
    assert!(!forecast.plan.strategies.is_empty());
}

#[test]
fn passes_error_and_rays_are_about_what_was_foretold() {
    let short = |budget| Settings {
        split: false,
        ..settings(budget)
    };
    check(&short(Budget::Samples(32)));
    check(&short(Budget::Error(0.15)));
    check(&Settings {
        max_bounces: Some(2),
        ..short(Budget::Samples(32))
    });
}

#[test]
fn a_plan_refuses_what_a_render_refuses() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let scene = scene(walls, 8, &[v(0.3, 0.2, -1.0)]);
    let settings = Settings {
        groups: vec![vec![0], vec![1]],
        ..settings(Budget::Samples(4))
    };
    let planned = plan(&scene, &settings).unwrap_err().to_string();
    assert!(planned.starts_with("groups[1]: names beam 1"), "{planned}");
    let rendered = render(&scene, &settings, &Quiet).unwrap_err().to_string();
    assert_eq!(planned, rendered);
}
