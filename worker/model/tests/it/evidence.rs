//! Networks that see evidence and no histograms: they begin with the answers of the physics and
//! treat all spots alike.

use crate::common;

use burn::tensor::Device;
use common::{plan, scene, sources};
use picofarm_model::{
    Model,
    input::{Batch, EvidenceForm, ShadowVariant, Target, Visit, example},
    masks,
    net::{Architecture, NetSpec, Swin},
    scene::Scene,
    train::{Control, Plan, Training},
};

fn evident() -> Plan {
    plan(Target::Shadow, ShadowVariant::Evidence)
}

/// Returns the network after `steps` steps.
fn after(plan: &Plan, steps: u64) -> Model {
    let mut training = Training::start(plan.clone(), None, sources(), &Device::flex()).unwrap();
    if steps > 0 {
        let stop = |event: &_| matches!(event, picofarm_model::train::Event::Step { step, .. } if *step >= steps);
        let mut hear = |_: &Training, event: &_| match stop(event) {
            true => Control::Stop,
            false => Control::Continue,
        };
        training.run(&mut hear).unwrap();
    }
    Model::read(&training.finish().weights, &Device::flex()).unwrap()
}

fn said(model: &Model, scene: &Scene) -> Vec<u8> {
    masks(model, scene, &mut |_, _| true).unwrap().unwrap()
}

/// Returns the masks of the log odds alone.
fn of_odds(scene: &Scene) -> Vec<bool> {
    let planes = scene.evidence.chunks_exact(3 * scene.pixels());
    let odds = planes.flat_map(|spot| &spot[2 * scene.pixels()..]);
    odds.map(|code| EvidenceForm::log_odds(*code) > 0.0)
        .collect()
}

#[test]
fn an_untrained_network_gives_the_masks_of_the_log_odds_and_a_trained_one_better_ones() {
    let small = Swin {
        groups: 1,
        depth: 2,
        heads: 2,
        window: 4,
    };
    for architecture in [Architecture::Unet2d, Architecture::Swinir] {
        let mut plan = evident();
        plan.net = NetSpec {
            architecture,
            swin: if architecture == Architecture::Swinir {
                small
            } else {
                Swin::default()
            },
            ..plan.net
        };
        let unseen = scene(200);
        let untrained = said(&after(&plan, 0), &unseen);
        let lit: Vec<bool> = untrained.iter().map(|p| *p >= 128).collect();
        assert_eq!(lit, of_odds(&unseen), "{architecture:?}");
        plan.epochs = 40;
        let trained = said(&after(&plan, 1_000), &unseen);
        let wrong = |masks: &[u8]| {
            let pairs = masks.iter().zip(&unseen.lit);
            pairs.filter(|(p, lit)| (**p >= 128) != (**lit > 0)).count()
        };
        let (before, now) = (wrong(&untrained), wrong(&trained));
        assert!(
            before > 10 && 4 * now < before,
            "{architecture:?}: {before}, then {now}"
        );
    }
}

#[test]
fn spots_in_another_order_get_the_same_masks_in_that_order() {
    let model = after(&evident(), 3);
    let one = scene(200);
    let mut other = (*one).clone();
    let pixels = one.pixels();
    other.evidence.rotate_left(3 * pixels);
    other.spots.reverse();
    other.beams_m.reverse();
    other.lit.rotate_left(pixels);
    let mut turned = said(&model, &other);
    turned.rotate_left(pixels);
    assert_eq!(turned, said(&model, &one));
}

#[test]
fn histograms_are_not_needed_and_not_looked_at() {
    let model = after(&evident(), 3);
    let one = scene(200);
    let without = Scene {
        histogram: Vec::new(),
        ..(*one).clone()
    };
    assert_eq!(said(&model, &without), said(&model, &one));
}

#[test]
fn flipped_evidence_is_that_of_a_flipped_scene() {
    let question = evident().question;
    assert!(question.may_flip());
    let one = scene(3);
    let batch = |flip_columns, flip_rows| {
        let visit = Visit {
            spot: 1,
            flip_columns,
            flip_rows,
        };
        let mut batch = Batch::default();
        example(&mut batch, &question, &one, visit).unwrap();
        batch
    };
    let (straight, flipped) = (batch(false, false), batch(true, true));
    for (a, b) in [
        (&straight.dense, &flipped.dense),
        (&straight.target, &flipped.target),
    ] {
        for (a, b) in a.chunks_exact(64).zip(b.chunks_exact(64)) {
            assert!(a.iter().eq(b.iter().rev()));
        }
    }
}

#[test]
fn evidence_of_another_number_of_planes_is_refused() {
    let model = after(&evident(), 0);
    let mut odd = (*scene(4)).clone();
    odd.evidence.truncate(2 * 2 * odd.pixels());
    let error = masks(&model, &odd, &mut |_, _| true)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("evidence has 256 values, not 384"),
        "{error}"
    );
    let mut plan = evident();
    plan.question.evidence = None;
    let started = Training::start(plan, None, sources(), &Device::flex());
    let error = started.err().unwrap().to_string();
    assert!(error.contains("shadow.variant"), "{error}");
    let plan = plan_of_volume();
    let started = Training::start(plan, None, sources(), &Device::flex());
    assert!(
        started
            .err()
            .unwrap()
            .to_string()
            .contains("unet2d and swinir")
    );
}

fn plan_of_volume() -> Plan {
    let mut plan = evident();
    plan.net.architecture = Architecture::Unet25d;
    plan.net.time = 8;
    plan
}
