//! A report on trained networks.

use crate::common;

use std::sync::Arc;

use common::{plan, scenes, sources};
use picofarm_model::{
    Model,
    baseline::Baseline,
    cpu, evaluate,
    input::{ShadowVariant, Target},
    train::{Control, Training},
};
use picofarm_report::{Entry, Report, html, json, pictures};

fn trained(target: Target) -> Entry {
    let (plan, sources) = (plan(target, ShadowVariant::Concat), sources());
    let baseline = Baseline::fit(&plan.question, sources.train.as_ref(), 9).unwrap();
    let mut training = Training::start(plan, None, sources, &cpu()).unwrap();
    training.run(&mut |_, _| Control::Continue).unwrap();
    let trained = training.finish();
    let model = Model::read(&trained.weights, &cpu()).unwrap();
    let held_out = scenes(200, 3);
    let mut entry = Entry::new(format!("{target:?}"), &model, 8);
    entry.history = trained.history;
    entry.evaluated = evaluate(&model, &baseline, &held_out, &mut |_, _| true).unwrap();
    entry.pictures = pictures(&model, &held_out, &[0, 2], 1).unwrap();
    entry
}

#[test]
fn pictures_show_what_the_figures_are_of() {
    for target in [Target::Tof, Target::Shadow, Target::Specular] {
        let entry = trained(target);
        let evaluated = entry.evaluated.as_ref().unwrap();
        assert_eq!(entry.pictures.len(), 2);
        for (picture, scene) in entry.pictures.iter().zip([0, 2]) {
            let held_out = Arc::clone(&scenes(200, 3)[scene]);
            match target {
                Target::Tof => {
                    let both = picture.truth.values().iter().zip(&held_out.depth_m);
                    assert!(both.into_iter().all(|(a, b)| (a - b).abs() < 1e-5));
                }
                Target::Specular | Target::Shadow => {
                    let said = picture.said.values();
                    assert!(said.iter().all(|p| (0.0..=1.0).contains(p)));
                }
            }
            if target != Target::Shadow {
                assert_eq!(picture.metrics, evaluated.scenes[scene]);
            }
        }
        let report = Report {
            title: "trained".to_owned(),
            models: vec![entry],
            ..Report::default()
        };
        let page = html(&report);
        assert_eq!(page.matches("data:image/png").count(), 8, "four a picture");
        assert_eq!(page, html(&report));
        assert!(json(&report).contains("\"parameters\""));
    }
}

#[test]
fn a_scene_that_is_not_there_is_named() {
    let entry = plan(Target::Tof, ShadowVariant::Concat);
    let training = Training::start(entry, None, sources(), &cpu()).unwrap();
    let model = Model::read(&training.finish().weights, &cpu()).unwrap();
    let error = pictures(&model, &scenes(0, 2), &[2], 1).unwrap_err();
    assert_eq!(
        error.to_string(),
        "report.scenes: there is no scene 2, only 2"
    );
}
