//! The forecast of `plan` is close to the cost and error of the render.

use crate::common;
use crate::hard_scenes as scenes;

use common::{Quiet, grey, room, scene, settings, v};
use picofarm_scene::Scene;
use picofarm_transient::{Budget, ClassVariance, Settings, plan, render, variance};

fn check(scene: &Scene, settings: &Settings) {
    let forecast = plan(scene, settings).unwrap();
    let rendered = render(scene, settings, &Quiet).unwrap();
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
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let beams = [v(0.3, 0.2, -1.0), v(-0.4, 0.1, -1.0)];
    let scene = scene(walls, 64, &beams);
    check(&scene, &short(Budget::Samples(32)));
    check(&scene, &short(Budget::Error(0.15)));
    let two = Settings {
        max_bounces: Some(2),
        ..short(Budget::Samples(32))
    };
    check(&scene, &two);
}

fn short(budget: Budget) -> Settings {
    Settings {
        split: false,
        ..settings(budget)
    }
}

fn hard(name: &str, pixels: u32) -> Scene {
    let rooms = scenes::all(pixels).into_iter();
    rooms.filter(|(of, _)| of == name).last().unwrap().1
}

#[test]
fn what_light_paths_draw_into_the_image_is_foretold_as_well() {
    let two = Settings {
        max_bounces: Some(2),
        ..short(Budget::Samples(16))
    };
    let bodies = hard("bodies", 64);
    check(&bodies, &short(Budget::Samples(16)));
    check(&bodies, &two);
    let windows = hard("windows", 64);
    check(&windows, &short(Budget::Samples(16)));
    check(&windows, &short(Budget::Error(0.2)));
}

#[test]
fn classes_of_paths_share_all_energy_and_variance_and_glass_has_its_own() {
    for (name, glass) in [("bodies", true), ("no-glass", false)] {
        let classes = variance(&hard(name, 16), &short(Budget::Samples(16)), 16).unwrap();
        let sum = |of: fn(&ClassVariance) -> f64| classes.iter().map(of).sum::<f64>();
        for all in [sum(|c| c.energy), sum(|c| c.variance), sum(|c| c.middle)] {
            assert!((all - 1.0).abs() < 1e-9, "{name}: {all}");
        }
        let by_glass = classes.iter().filter(|c| c.class.contains("by glass"));
        let energy: f64 = by_glass.map(|c| c.energy).sum();
        assert_eq!(energy > 0.1, glass, "{name}: {energy}");
        assert!(energy < 0.5, "{name}: {energy}");
    }
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
