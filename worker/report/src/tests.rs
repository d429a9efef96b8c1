//! The report as a whole.

use serde_json::Value;

use super::{
    Data, Entry, Picture, Plane, Report, Speed, Spread, html, json, published, summary,
    table::table,
};
use picofarm_model::{
    Evaluated,
    input::{Normalise, Question, ShadowVariant, Target},
    metric::{Metrics, Released},
    net::{Architecture, NetSpec, StemForm, Swin, TimeProjection},
    train::{Line, Plan, Schedule},
};

fn entry(name: &str, target: Target, variant: ShadowVariant, seed: u64, metrics: Metrics) -> Entry {
    let question = Question {
        target,
        variant,
        normalise: Normalise::MinMax,
        bins: 64,
        intensity_only: false,
        spots: 4,
        depth_scale_m: 4.5,
        evidence: None,
    };
    let (dense, one_hot, outputs) = question.channels();
    let net = NetSpec {
        architecture: Architecture::Unet2d,
        dense,
        one_hot,
        outputs,
        width: 8,
        levels: 3,
        stem: 0,
        stem_form: StemForm::Block,
        time: 0,
        time_projection: TimeProjection::Shared,
        swin: Swin::default(),
        added: false,
        frozen: false,
        precision: picofarm_model::net::Precision::F32,
    };
    let trivial = |metrics: &Metrics| match metrics {
        Metrics::Depth { .. } => vec![
            (
                "constant".to_owned(),
                Metrics::Depth {
                    mae_m: 0.8,
                    rmse_m: 1.0,
                },
            ),
            (
                "peak".to_owned(),
                Metrics::Depth {
                    mae_m: 0.4,
                    rmse_m: 0.75,
                },
            ),
        ],
        Metrics::Mask { .. } => vec![(
            "all".to_owned(),
            Metrics::Mask {
                mae: 0.5,
                iou: 0.5,
                f1: 0.625,
            },
        )],
    };
    Entry {
        name: name.to_owned(),
        data: Data {
            name: "rooms v2".to_owned(),
            scenes: Some(96),
            ..Data::default()
        },
        conditions: Vec::new(),
        parameters: 12_345,
        multiply_adds: Some(net.multiply_adds(32)),
        history: vec![Line {
            epoch: 1,
            within: false,
            step: 12,
            loss: 0.5,
            learning_rate: 1e-2,
            validation: Some(metrics),
        }],
        evaluated: Some(Evaluated {
            metrics,
            released: match metrics {
                Metrics::Depth { .. } => Released::Depth { boundary_f1: 0.5 },
                Metrics::Mask { mae, iou, f1 } => Released::Mask {
                    mae_32: mae,
                    iou_32: 0.9 * iou,
                    f1_32: 0.9 * f1,
                },
            },
            baselines: trivial(&metrics),
            scenes: vec![metrics; 2],
            examples: 2,
        }),
        speed: Some(Speed {
            samples_per_s: 20.0,
            seconds: Some(90.0),
        }),
        lineage: vec![("code".to_owned(), "model-1".to_owned())],
        pictures: Vec::new(),
        plan: Plan {
            question,
            net,
            epochs: 1,
            batch: 2,
            accumulate: 1,
            learning_rate: 1e-2,
            decay: 1e-3,
            schedule: Schedule::Onecycle,
            restarts: None,
            clip_norm: None,
            ema: None,
            augment: true,
            early_stop: 0,
            validate_every: 0,
            seed,
        },
    }
}

fn depth(name: &str, seed: u64, mae_m: f64) -> Entry {
    let metrics = Metrics::Depth {
        mae_m,
        rmse_m: 2.0 * mae_m,
    };
    entry(name, Target::Tof, ShadowVariant::Concat, seed, metrics)
}

fn shadow(name: &str, variant: ShadowVariant, seed: u64, iou: f64) -> Entry {
    let metrics = Metrics::Mask {
        mae: 1.0 - iou,
        iou,
        f1: iou,
    };
    entry(name, Target::Shadow, variant, seed, metrics)
}

fn report(models: Vec<Entry>) -> Report {
    Report {
        title: "Mini runs".to_owned(),
        date: "2026-11-22".to_owned(),
        models,
    }
}

#[test]
fn seeds_of_an_experiment_are_one_row_beside_trivial_and_published_figures() {
    let all = report(vec![
        depth("tof-1", 1, 0.125),
        depth("tof-2", 2, 0.375),
        Entry {
            evaluated: None,
            ..shadow("all & one", ShadowVariant::All, 1, 0.5)
        },
    ]);
    let said = summary(&all);
    assert_eq!(said.groups.len(), 2);
    assert_eq!(said.groups[0].label, "tof");
    let tables = said
        .groups
        .iter()
        .map(|g| table(&all, g.target, &[g]).replace("<t", "\n<t"));
    insta::assert_snapshot!(tables.collect::<Vec<_>>().join("\n"));
}

#[test]
fn equal_figures_of_several_seeds_have_no_deviation() {
    for value in [0.403_124_202_604_601_76, 0.1, 1.0 / 3.0] {
        let spread = Spread::from_values(&[value; 3]).unwrap();
        assert_eq!((spread.mean, spread.deviation), (value, Some(0.0)));
    }
    let spread = Spread::from_values(&[1.0, 2.0, 3.0]).unwrap();
    assert_eq!((spread.mean, spread.deviation), (2.0, Some(1.0)));
    assert_eq!(Spread::from_values(&[]), None);
}

#[test]
fn the_json_says_everything() {
    let mut one = depth("tof-1", 1, 0.125);
    let plane = Plane::new(2, 1, vec![1.0, f32::NAN]).unwrap();
    one.pictures = vec![Picture {
        label: "scene 0".to_owned(),
        intensity: plane.clone(),
        truth: plane.clone(),
        said: plane,
        metrics: Metrics::Depth {
            mae_m: 0.25,
            rmse_m: f64::NAN,
        },
    }];
    let mut said: Value =
        serde_json::from_str(&json(&report(vec![one, depth("tof-2", 2, 0.375)]))).unwrap();
    // Whether a map preserves its order is a feature that other crates of the workspace decide.
    said.sort_all_objects();
    insta::assert_json_snapshot!(said);
}

#[test]
fn a_report_can_be_kept_and_read_again() {
    let mut one = shadow("concat", ShadowVariant::Concat, 1, 0.9);
    let plane = Plane::new(2, 1, vec![0.1, 1.0]).unwrap();
    one.pictures = vec![Picture {
        label: "scene 3, spot 0".to_owned(),
        intensity: plane.clone(),
        truth: plane.clone(),
        said: plane,
        metrics: Metrics::Mask {
            mae: 0.0,
            iou: 1.0,
            f1: 1.0,
        },
    }];
    let kept = report(vec![one]);
    let text = serde_json::to_string(&kept).unwrap();
    assert_eq!(serde_json::from_str::<Report>(&text).unwrap(), kept);
    let short = text.replace("\"width\":2,\"height\":1", "\"width\":3,\"height\":1");
    let error = serde_json::from_str::<Report>(&short)
        .unwrap_err()
        .to_string();
    assert!(error.contains("2 values, 3×1 expected"), "{error}");
}

#[test]
fn nothing_from_outside_becomes_markup() {
    let evil = "</pre><script>alert(\"1\")</script>'&";
    let mut one = shadow(evil, ShadowVariant::Concat, 1, 0.9);
    one.data.name = evil.to_owned();
    one.conditions = vec![(evil.to_owned(), evil.to_owned())];
    one.lineage = one.conditions.clone();
    let mut evaluated = one.evaluated.clone().unwrap();
    evaluated.baselines[0].0 = evil.to_owned();
    one.evaluated = Some(evaluated);
    let plane = Plane::new(1, 1, vec![f32::NAN]).unwrap();
    one.pictures = vec![Picture {
        label: evil.to_owned(),
        intensity: plane.clone(),
        truth: plane.clone(),
        said: plane,
        metrics: Metrics::Mask {
            mae: f64::NAN,
            iou: f64::NAN,
            f1: f64::NAN,
        },
    }];
    let mut other = shadow(evil, ShadowVariant::All, 1, 0.95);
    other.lineage = vec![(evil.to_owned(), "b".to_owned())];
    let page = html(&Report {
        title: evil.to_owned(),
        date: evil.to_owned(),
        models: vec![one, other],
    });
    assert!(
        !page.contains("<script") && !page.contains("</pre><s"),
        "{page}"
    );
    assert!(
        !page.contains("http:") && !page.contains("https:"),
        "needs nothing beside it"
    );
    for tag in [
        "section", "table", "tr", "td", "svg", "g", "div", "figure", "details", "small", "p", "ul",
    ] {
        let opened =
            page.matches(&format!("<{tag}>")).count() + page.matches(&format!("<{tag} ")).count();
        assert_eq!(opened, page.matches(&format!("</{tag}>")).count(), "{tag}");
    }
}

#[test]
fn a_report_without_an_evaluation_says_so() {
    let none = Entry {
        evaluated: None,
        ..depth("a", 1, 0.1)
    };
    let page = html(&report(vec![none.clone()]));
    assert!(
        page.contains("No model of this report was evaluated") && page.contains(">not evaluated<")
    );
    let page = html(&report(vec![none, depth("b", 1, 0.1)]));
    assert!(page.contains("Not evaluated: 1 of 2 models"));
    assert!(html(&report(vec![])).contains("There are no models in this report"));
}

#[test]
fn an_experiment_that_loses_to_a_trivial_answer_says_so_in_a_line() {
    let page = html(&report(vec![
        shadow("lost", ShadowVariant::Concat, 1, 0.4),
        shadow("won", ShadowVariant::Difference, 1, 0.9),
    ]));
    assert!(page.contains("lost: no better than a trivial answer: 1.2 times the error of"));
    assert!(page.contains("won: better than every trivial answer: 0.20 times"));
}

#[test]
fn the_order_of_experiments_is_compared_with_the_published_one() {
    let of = |difference| {
        let all = report(vec![
            shadow("concat-1", ShadowVariant::Concat, 1, 0.90),
            shadow("concat-2", ShadowVariant::Concat, 2, 0.92),
            shadow("difference", ShadowVariant::Difference, 1, difference),
            shadow("all", ShadowVariant::All, 1, 0.6),
        ]);
        summary(&all).orders.remove(0)
    };
    let (kept, turned) = (of(0.85), of(0.93));
    assert_eq!((kept.pairs, kept.kept, kept.close), (3, 3, 0));
    assert_eq!((turned.pairs, turned.kept), (3, 2));
    assert_eq!(turned.turned, [["difference", "concat"]]);
    assert_eq!(of(0.905).close, 1);
    let equal = of(0.6);
    assert_eq!((equal.kept, equal.turned.len(), equal.close), (2, 0, 1));
}

#[test]
fn models_that_differ_in_their_scenes_only_make_a_curve() {
    let with = |name: &str, seed, scenes, mae_m| {
        let mut one = depth(name, seed, mae_m);
        one.data.scenes = Some(scenes);
        one
    };
    let mut wider = with("wide", 1, 50, 0.1);
    wider.plan.net.width = 16;
    let all = report(vec![
        with("tof-n200-1", 1, 200, 0.125),
        with("tof-n50-1", 1, 50, 0.5),
        with("tof-n50-2", 2, 50, 0.25),
        wider,
    ]);
    let said = summary(&all);
    assert_eq!(said.groups.len(), 3);
    let [curve] = &said.scalings[..] else {
        panic!("{:?}", said.scalings)
    };
    assert_eq!(curve.label, "tof");
    let points: Vec<_> = curve
        .points
        .iter()
        .map(|(n, e)| (*n, e.mean, e.runs))
        .collect();
    assert_eq!(points, [(50, 0.375, 2), (200, 0.125, 1)]);
}

#[test]
fn published_figures_stand_beside_the_experiments_that_they_are_of() {
    let of = |change: &dyn Fn(&mut Entry)| {
        let mut one = shadow("s", ShadowVariant::Concat, 1, 0.9);
        change(&mut one);
        published(&one).and_then(|p| p.iou)
    };
    assert_eq!(of(&|_| {}), Some(0.959));
    assert_eq!(of(&|e| e.data.max_bounces = 2), Some(0.964));
    assert_eq!(of(&|e| e.data.max_bounces = 3), None);
    assert_eq!(of(&|e| e.plan.question.intensity_only = true), Some(0.700));
    assert_eq!(of(&|e| e.data.noise = true), None);
    assert_eq!(
        of(&|e| e.plan.net.architecture = Architecture::Unet25d),
        None
    );
    assert_eq!(published(&depth("d", 1, 0.1)).unwrap().mae, Some(0.0228));
}

#[test]
fn published_figures_stand_beside_the_papers_size_alone() {
    let mut one = shadow("s", ShadowVariant::Concat, 1, 0.9);
    let page = |one: &Entry| {
        let report = report(vec![one.clone()]);
        let summary = summary(&report);
        let shown: Vec<&super::Group> = summary.groups.iter().collect();
        (
            summary.groups[0].clone(),
            table(&report, Target::Shadow, &shown),
        )
    };
    let (small, html) = page(&one);
    assert!(small.published.is_none() && small.repeats.is_some());
    assert!(!html.contains("0.959"), "{html}");
    assert!(
        html.contains("A.1 concat (A.4: IoU 0.954), but spots not known, images not known, 64 bins, 96 scenes, width 8, 3 levels"),
        "{html}"
    );
    one.data.spots = Some(25);
    one.data.images = Some([256, 256]);
    one.data.scenes = Some(87_688);
    one.plan.question.bins = 637;
    (one.plan.net.width, one.plan.net.levels) = (128, 6);
    let (whole, html) = page(&one);
    assert_eq!(whole.unlike, Vec::<String>::new());
    assert_eq!(whole.published.and_then(|p| p.iou), Some(0.959));
    assert!(html.contains("0.959"), "{html}");
    for (change, word) in [
        (
            (|e: &mut Entry| e.data.spots = Some(4)) as fn(&mut Entry),
            "4 spots",
        ),
        (|e| e.data.images = Some([64, 128]), "128 × 64 pixels"),
        (|e| e.plan.question.bins = 106, "106 bins"),
        (|e| e.data.scenes = Some(300), "300 scenes"),
        (|e| e.plan.net.width = 32, "width 32, 6 levels"),
    ] {
        let mut other = one.clone();
        change(&mut other);
        let (group, html) = page(&other);
        assert_eq!(group.unlike, [word]);
        assert!(
            group.published.is_none() && !html.contains("0.959"),
            "{html}"
        );
    }
}
