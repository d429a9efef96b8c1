//! Sweeps in job files: their expansion, draws, checks of trials, and refusals.

use picofarm_proto::{
    key::stage_key,
    spec::{Domain, Halving, JobSpec, Median, StageSpec, Stop, TaskSpec, TrainSettings, Trial},
    wire,
};
use proptest::prelude::*;

const DATA: &str = "[[stage]]\nscenes = { kind = \"primitive\", count = 9 }\n\
                    output = { store = \"/s\", dataset = \"rooms\" }\n\
                    [[stage]]\nkind = \"split\"\nsource = \"render\"\nsplit = { fractions = [0.5, 0.3, 0.2] }\n";

fn job(sweep: &str, train: &str, rest: &str) -> Result<JobSpec, toml::de::Error> {
    toml::from_str(&format!(
        "name = \"n\"\n{DATA}[[stage]]\nname = \"tof\"\nkind = \"train\"\nsource = \"render\"\nsweep = {{ {sweep} }}\n\
         train = {{ target = \"tof\", {train} }}\n{rest}"
    ))
}

const TRAIN: &str = "model = \"depth\", net = { width = \"{width}\", levels = 3 }, optimise = { learning_rate = \"{lr}\", epochs = 27 }";

fn good(sweep: &str) -> JobSpec {
    let spec = job(sweep, TRAIN, "").unwrap();
    spec.check().unwrap();
    spec.check_places().unwrap();
    spec
}

fn refused(sweep: &str, train: &str) -> String {
    match job(sweep, train, "") {
        Err(error) => error.to_string(),
        Ok(spec) => spec.check().unwrap_err().to_string(),
    }
}

fn settings(stage: &StageSpec) -> &TrainSettings {
    match &stage.task {
        TaskSpec::Train(task) => &task.train,
        other => panic!("{other:?}"),
    }
}

fn trial(stage: &StageSpec) -> &Trial {
    settings(stage).trial.as_ref().unwrap()
}

fn trials(spec: &JobSpec) -> Vec<&StageSpec> {
    let trains = |s: &&StageSpec| matches!(s.task, TaskSpec::Train(_));
    spec.stages.iter().filter(trains).collect()
}

#[test]
fn a_grid_is_every_combination_and_then_the_choice_of_the_best() {
    let sweep =
        "over = { lr = [0.01, 0.001], width = [8, 16, 32] }, stop = { halving = { first = 3 } }";
    let evaluate =
        "[[stage]]\nkind = \"evaluate\"\nsource = \"render\"\nevaluate = { models = [\"tof\"] }\n";
    let spec = job(sweep, TRAIN, evaluate).unwrap();
    spec.check().unwrap();
    let names: Vec<&str> = spec.stages.iter().map(|s| &*s.name).collect();
    assert_eq!(
        names,
        [
            "render", "split", "tof.0", "tof.1", "tof.2", "tof.3", "tof.4", "tof.5", "tof",
            "evaluate"
        ]
    );
    let fourth = settings(&spec.stages[6]);
    assert_eq!(
        (
            &*fourth.model,
            fourth.optimise.learning_rate,
            fourth.net.width
        ),
        ("depth.4", 0.001, 16)
    );
    let of = trial(&spec.stages[6]);
    assert_eq!((&*of.sweep, of.index), ("depth", 4));
    assert_eq!(
        serde_json::to_string(&of.values).unwrap(),
        r#"{"lr":0.001,"width":16}"#
    );
    assert_eq!(
        of.stop,
        Some(Stop::Halving(Halving {
            first: 3,
            factor: 3
        }))
    );
    let TaskSpec::Promote(best) = &spec.stages[8].task else {
        panic!("{:?}", spec.stages[8]);
    };
    assert_eq!(best.promote.model, "depth");
    assert_eq!(best.promote.among.len(), 6);
    assert_eq!(
        spec.stages[8].needs,
        [
            "render", "tof.0", "tof.1", "tof.2", "tof.3", "tof.4", "tof.5"
        ]
    );
    // A later stage refers to the best trial.
    assert_eq!(spec.stages[9].needs, ["render", "split", "tof"]);
    let TaskSpec::Evaluate(evaluate) = &spec.stages[9].task else {
        panic!("{:?}", spec.stages[9]);
    };
    assert_eq!(evaluate.evaluate.models, ["depth"]);
    // The meaning is the same on the wire and in the catalog.
    let again = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(again, spec);
}

#[test]
fn draws_lie_where_they_shall_and_more_trials_are_further_ones() {
    let over = "over = { lr = { log = [1e-4, 1e-1] }, width = { int = [4, 7] }, decay = { range = [0, 0.5] }, p = [\"f32\"] }";
    let train = "model = \"d\", net = { width = \"{width}\", levels = 3 }, \
                 optimise = { learning_rate = \"{lr}\", weight_decay = \"{decay}\", precision = \"{p}\" }";
    let few = job(&format!("trials = 20, seed = 4, {over}"), train, "").unwrap();
    let many = job(&format!("trials = 60, seed = 4, {over}"), train, "").unwrap();
    few.check().unwrap();
    let of = |spec: &JobSpec| -> Vec<TrainSettings> {
        trials(spec).iter().map(|s| settings(s).clone()).collect()
    };
    assert_eq!(of(&few)[..], of(&many)[..20]);
    let keys = |spec: &JobSpec| -> Vec<_> { trials(spec).iter().map(|s| stage_key(s)).collect() };
    assert_eq!(keys(&few)[..], keys(&many)[..20]);
    let (mut low, mut widths) = (0, std::collections::BTreeSet::new());
    for settings in of(&many) {
        let o = &settings.optimise;
        assert!((1e-4..=1e-1).contains(&o.learning_rate) && (0.0..=0.5).contains(&o.weight_decay));
        assert!((4..=7).contains(&settings.net.width));
        low += usize::from(o.learning_rate < 10f64.powf(-2.5));
        widths.insert(settings.net.width);
    }
    // Half of all draws are in the lower half of the orders of magnitude.
    assert!((15..=45).contains(&low), "{low}");
    assert_eq!(widths.len(), 4);
    let other = job(&format!("trials = 20, seed = 5, {over}"), train, "").unwrap();
    assert_ne!(
        trial(trials(&other)[0]).values,
        trial(trials(&few)[0]).values
    );
    // The same on every machine.
    let first: Vec<String> = of(&few)[..3]
        .iter()
        .map(|s| {
            format!(
                "{} {} {}",
                s.optimise.learning_rate, s.net.width, s.optimise.weight_decay
            )
        })
        .collect();
    insta::assert_debug_snapshot!(first);
}

#[test]
fn what_a_trial_computes_does_not_depend_on_the_sweep_but_its_task_does() {
    let spec = good("over = { lr = [0.01], width = [8] }, stop = { halving = { first = 3 } }");
    let stage = trials(&spec)[0];
    let mut plain = stage.clone();
    let TaskSpec::Train(task) = &mut plain.task else {
        panic!()
    };
    task.train.trial = None;
    assert_eq!(settings(stage).shaping(), task.train.shaping());
    assert_ne!(stage_key(stage), stage_key(&plain));
    // Ranges distinguish sweeps, resources do not.
    let id = |sweep: &str| trial(trials(&good(sweep))[0]).id.clone();
    assert_ne!(
        id("over = { lr = [0.01], width = [8] }"),
        id("over = { lr = [0.02], width = [8] }")
    );
}

#[test]
fn a_matrix_goes_over_sweeps_and_each_has_its_best() {
    let spec: JobSpec = toml::from_str(&format!(
        "name = \"n\"\n{DATA}[[stage]]\nname = \"tof\"\nkind = \"train\"\nsource = \"render\"\nmatrix = {{ seed = [1, 2] }}\n\
         sweep = {{ over = {{ lr = [0.1, 0.2] }} }}\n\
         train = {{ target = \"tof\", model = \"d-{{seed}}\", seed = \"{{seed}}\", optimise = {{ learning_rate = \"{{lr}}\" }} }}\n"
    ))
    .unwrap();
    spec.check().unwrap();
    let names: Vec<&str> = spec.stages[2..].iter().map(|s| &*s.name).collect();
    assert_eq!(
        names,
        [
            "tof[1].0", "tof[1].1", "tof[1]", "tof[2].0", "tof[2].1", "tof[2]"
        ]
    );
}

#[test]
fn a_sweep_that_cannot_be_says_why() {
    let over = "lr = [0.1], width = [8]";
    for (sweep, train, said) in [
        ("over = {}", TRAIN, "stage.sweep.over: names no parameter"),
        (
            "over = { lr = [], width = [8] }",
            TRAIN,
            "stage.sweep.over.lr: lists no value",
        ),
        (
            "over = { lr = { log = [0, 1] }, width = [8] }",
            TRAIN,
            "stage.sweep.over.lr: 0 must lie above 0 and below 1",
        ),
        (
            "over = { lr = { log = [0.1, 1] }, width = [8] }",
            TRAIN,
            "stage.sweep.over.lr: is an interval: say how many trials",
        ),
        (
            "over = { lr = { lin = [0.1, 1] }, width = [8] }",
            TRAIN,
            "stage.sweep: ",
        ),
        (
            &format!("over = {{ {over}, depth = [3] }}"),
            TRAIN,
            "stage.sweep.over.depth: nothing in the stage says \"{depth}\"",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ halving = {{ first = 0 }} }}"),
            TRAIN,
            "stage.sweep.stop.halving.first: must be at least 1 epoch",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ halving = {{ first = 1, factor = 1 }} }}"),
            TRAIN,
            "stage.sweep.stop.halving.factor: must be at least 2",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ median = {{ first = 2, every = 0 }} }}"),
            TRAIN,
            "stage.sweep.stop.median.every: must be at least 1 epoch",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ median = {{ first = 2, least = 0 }} }}"),
            TRAIN,
            "stage.sweep.stop.median.least: must be at least 1 trial",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ hyperband = {{ first = 2, factor = 1 }} }}"),
            TRAIN,
            "stage.sweep.stop.hyperband.factor: must be at least 2",
        ),
        (
            &format!("over = {{ {over} }}, stop = {{ average = {{ first = 2 }} }}"),
            TRAIN,
            "unknown variant `average`",
        ),
        (
            &format!("over = {{ {over} }}, values = [{{ lr = 0.1, width = 9 }}]"),
            TRAIN,
            "stage.sweep.values[0].width: 9 is not in [8]; change it, or widen sweep.over.width",
        ),
        (
            &format!("over = {{ {over} }}, values = [{{ lr = 0.1 }}]"),
            TRAIN,
            "stage.sweep.values[0].width: is missing",
        ),
        (
            "values = [{ lr = 0.1, width = 8 }, { lr = 0.1, width = 8, decay = 0 }]",
            TRAIN,
            "stage.sweep.values[1].decay: is no parameter of the others",
        ),
        (
            "values = [{ lr = 0.1, width = 8 }, { lr = 0.2, width = 8 }], trials = 1",
            TRAIN,
            "stage.sweep.trials: 1 are fewer than the 2 that sweep.values lists",
        ),
        (
            "values = [{ lr = 0.1, width = 8 }], trials = 3",
            TRAIN,
            "stage.sweep.over: names no parameter to draw trials 1 to 2 from",
        ),
        (
            "values = [{ lr = 0.1, width = 8, depth = 3 }]",
            TRAIN,
            "stage.sweep.values[0].depth: nothing in the stage says \"{depth}\"",
        ),
        (
            &format!("trials = 1000, over = {{ {over} }}"),
            TRAIN,
            "stage.sweep.trials: 1000 are more than 999",
        ),
        (
            &format!("over = {{ {over} }}"),
            "net = { width = 8 }",
            "stage.train.model: is missing",
        ),
    ] {
        let error = refused(sweep, train);
        assert!(error.contains(said), "{sweep}: {error}");
    }
    let render = "name = \"n\"\n[[stage]]\nsweep = { over = { n = [1] } }\nscenes = { kind = \"primitive\", count = \"{n}\" }\n\
                  output = { store = \"/s\", dataset = \"rooms\" }\n";
    let error = toml::from_str::<JobSpec>(render).unwrap_err().to_string();
    assert!(
        error.contains("stage.sweep: belongs to kind = \"train\""),
        "{error}"
    );
}

#[test]
fn listed_values_are_the_first_trials_and_change_neither_the_sweep_nor_the_tasks() {
    let over = "seed = 4, over = { lr = { log = [1e-4, 1e-1] }, width = { int = [4, 7] } }";
    let drawn = good(&format!("trials = 3, {over}"));
    let list: Vec<String> = trials(&drawn)
        .iter()
        .map(|s| {
            let values = &trial(s).values;
            format!("{{ lr = {}, width = {} }}", values["lr"], values["width"])
        })
        .collect();
    let list = list.join(", ");
    let listed = good(&format!("values = [{list}], {over}"));
    let keys = |spec: &JobSpec| -> Vec<_> { trials(spec).iter().map(|s| stage_key(s)).collect() };
    assert_eq!(keys(&listed), keys(&drawn));
    // Appended values are further trials of the same sweep, and the draws beyond them are
    // unchanged.
    let more = good(&format!(
        "values = [{list}, {{ lr = 0.02, width = 5 }}], trials = 6, {over}"
    ));
    assert_eq!(keys(&more)[..3], keys(&drawn)[..]);
    assert_eq!(trials(&more).len(), 6);
    let id = |spec: &JobSpec| trial(trials(spec)[0]).id.clone();
    assert_eq!(id(&more), id(&drawn));
    assert_eq!(
        keys(&more)[4..],
        keys(&good(&format!("trials = 6, {over}")))[4..]
    );
    assert_eq!(
        serde_json::to_string(&trial(trials(&more)[3]).values).unwrap(),
        r#"{"lr":0.02,"width":5}"#
    );
    // Values listed by hand without domains.
    let by_hand = good("values = [{ lr = 0.1, width = 8 }, { lr = 5, width = 9 }]");
    assert_eq!(trials(&by_hand).len(), 2);
    assert_eq!(
        trial(trials(&by_hand)[1]).over,
        std::collections::BTreeMap::new()
    );
    let further =
        good("values = [{ lr = 0.1, width = 8 }, { lr = 5, width = 9 }, { lr = 1, width = 1 }]");
    assert_eq!(keys(&further)[..2], keys(&by_hand)[..]);
    // Other rules give another sweep.
    let other = good(&format!(
        "trials = 3, {over}, stop = {{ median = {{ first = 3 }} }}"
    ));
    assert_ne!(id(&other), id(&drawn));
    assert_eq!(
        trial(trials(&other)[0]).stop,
        Some(Stop::Median(Median {
            first: 3,
            every: 1,
            least: 5
        }))
    );
}

#[test]
fn hyperband_deals_trials_to_brackets_as_published() {
    // Li et al., JMLR 2018, table 1: R = 81, factor 3: 81, 34, 15, 8 and 5 trials; here 1, 3, 9, 27
    // are rungs before the end.
    let stop = Stop::Hyperband(Halving {
        first: 1,
        factor: 3,
    });
    let mut counts = [0; 5];
    for index in 0..143 {
        counts[stop.bracket(index, 81) as usize] += 1;
    }
    assert_eq!(counts, [81, 34, 15, 8, 5]);
    let asked = |bracket: u32| -> Vec<u64> {
        let index = (0..143).find(|i| stop.bracket(*i, 81) == bracket).unwrap();
        (0..100).filter(|e| stop.asks(index, *e, 81)).collect()
    };
    assert_eq!(asked(0), [1, 3, 9, 27]);
    assert_eq!(asked(2), [9, 27]);
    assert_eq!(asked(4), [0; 0]);
}

/// Returns a domain of any kind.
fn domain() -> impl Strategy<Value = Domain> {
    let ends = (-50i64..50, 1i64..60);
    prop_oneof![
        (-9.0..9.0f64, 0.1..9.0f64).prop_map(|(a, w)| serde_json::json!({"range": [a, a + w]})),
        (1e-6..1.0f64, 1.5..1e4f64).prop_map(|(a, w)| serde_json::json!({"log": [a, a * w]})),
        ends.prop_map(|(a, w)| serde_json::json!({"int": [a, a + w]})),
        (1usize..5).prop_map(|n| serde_json::json!(vec![0.5, 1.0, 8.0, 9.0][..n.min(4)])),
    ]
    .prop_map(|domain| serde_json::from_value(domain).unwrap())
}

proptest! {
    #[test]
    fn rungs_lie_at_powers_of_the_factor_before_the_end(first in 1u32..6, factor in 2u32..5, of in 1u64..200) {
        let halving = Halving { first, factor };
        let mut rungs = Vec::new();
        let mut rung = u64::from(first);
        while rung < of {
            rungs.push(rung);
            rung *= u64::from(factor);
        }
        let found: Vec<u64> = (0..=of + 1).filter(|e| halving.is_rung(*e, of)).collect();
        prop_assert_eq!(found, rungs);
    }

    #[test]
    fn draws_lie_in_their_domain_and_domains_come_back_from_json(domain in domain(), seed: u64, number in 0u64..2000) {
        let over = [("x".to_owned(), domain.clone())].into();
        let value = picofarm_proto::spec::domain::draw(&over, seed, number)["x"].clone();
        prop_assert!(domain.contains(&value), "{value} of {domain:?}");
        let text = serde_json::to_string(&domain).unwrap();
        prop_assert_eq!(&serde_json::from_str::<Domain>(&text).unwrap(), &domain);
        // A value's fraction of the interval leads back to the value.
        if let Domain::Within(interval) = domain {
            prop_assert_eq!(interval.at(interval.share(&value).unwrap()), value);
        }
    }

    #[test]
    fn each_bracket_of_hyperband_has_its_share_of_the_first_trials_however_many(first in 1u32..4, factor in 2u32..5, of in 2u64..90, trials in 1u64..90) {
        let stop = Stop::Hyperband(Halving { first, factor });
        let dealt: Vec<u32> = (0..trials).map(|i| stop.bracket(i, of)).collect();
        let brackets = (0..=of).filter(|e| Halving { first, factor }.is_rung(*e, of)).count() + 1;
        let weight = |b: usize| (brackets as f64 * f64::from(factor).powi((brackets - 1 - b) as i32) / (brackets - b) as f64).ceil();
        let total: f64 = (0..brackets).map(weight).sum();
        for bracket in 0..brackets {
            let count = dealt.iter().filter(|b| **b as usize == bracket).count() as f64;
            let due = trials as f64 * weight(bracket) / total;
            prop_assert!((count - due).abs() <= brackets as f64 / 2.0 + 1.0, "bracket {bracket}: {count} of {due}");
        }
        // Later brackets are checked at fewer of the same rungs, and no bracket at its end.
        for index in (0..trials).step_by(7) {
            let asked: Vec<u64> = (0..=of).filter(|e| stop.asks(index, *e, of)).collect();
            prop_assert_eq!(asked.len(), brackets - 1 - dealt[index as usize] as usize);
            let rungs = Halving { first, factor };
            prop_assert!(asked.iter().all(|e| *e < of && rungs.is_rung(*e, of)));
        }
    }

    #[test]
    fn by_the_median_trials_are_asked_every_so_often_before_the_end(first in 1u32..9, every in 1u32..9, of in 1u64..60, index in 0u64..9) {
        let stop = Stop::Median(Median { first, every, least: 1 });
        let asked: Vec<u64> = (0..=of + 1).filter(|e| stop.asks(index, *e, of)).collect();
        let due: Vec<u64> = (u64::from(first)..of).step_by(every as usize).collect();
        prop_assert_eq!(asked, due);
        prop_assert_eq!(stop.bracket(index, of), 0);
    }
}
