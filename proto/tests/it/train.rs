//! Training and evaluation in job files: defaults, references to models, keys of results, and
//! refusals.

use picofarm_proto::{
    key::stage_key,
    spec::{
        Histogram, JobSpec, StageSpec, TaskSpec, TrainSettings,
        train::{Architecture, Normalise, Precision, Schedule, ShadowVariant, Target},
    },
    wire,
};

const DATA: &str = "[[stage]]\nscenes = { kind = \"primitive\", count = 9 }\n\
                    output = { store = \"/s\", dataset = \"rooms\" }\n\
                    [[stage]]\nkind = \"split\"\nsource = \"render\"\nsplit = { fractions = [0.5, 0.3, 0.2] }\n";

fn read(stages: &str) -> Result<JobSpec, toml::de::Error> {
    toml::from_str(&format!("name = \"n\"\n{DATA}{stages}"))
}

fn good(stages: &str) -> JobSpec {
    let spec = read(stages).unwrap();
    spec.check().unwrap();
    spec.check_places().unwrap();
    spec
}

fn refused(stages: &str) -> String {
    match read(stages) {
        Err(error) => error.to_string(),
        Ok(spec) => spec.check().unwrap_err().to_string(),
    }
}

fn train(name: &str, settings: &str) -> String {
    format!(
        "[[stage]]\nname = \"{name}\"\nkind = \"train\"\nsource = \"render\"\ntrain = {{ {settings} }}\n"
    )
}

/// Returns a stage with a model's predictions, stored in `of-MODEL`.
fn infer(name: &str, model: &str) -> String {
    format!(
        "[[stage]]\nname = \"{name}\"\nkind = \"infer\"\nsource = \"render\"\ninfer = {{ models = [\"{model}\"] }}\n\
         output = {{ store = \"/s\", dataset = \"of-{model}\" }}\n"
    )
}

fn evaluate(settings: &str) -> String {
    format!("[[stage]]\nkind = \"evaluate\"\nsource = \"render\"\nevaluate = {{ {settings} }}\n")
}

fn settings(stage: &StageSpec) -> &TrainSettings {
    match &stage.task {
        TaskSpec::Train(task) => &task.train,
        other => panic!("{other:?}"),
    }
}

#[test]
fn what_is_left_out_is_as_in_the_paper() {
    let spec = good(&train("tof", "target = \"tof\", model = \"m\""));
    let s = settings(&spec.stages[2]);
    assert_eq!((s.target, &*s.split, s.scenes), (Target::Tof, "default", 0));
    assert_eq!(
        (s.histogram, s.augment, s.seed),
        (Histogram::Transient, true, 0)
    );
    assert_eq!((s.input.normalise, s.input.bins), (Normalise::Minmax, 0));
    assert_eq!(s.net.architecture, Architecture::Unet2d);
    assert_eq!((s.net.width, s.net.levels, s.net.stem), (128, 6, 0));
    assert_eq!(
        (s.shadow.variant, &*s.shadow.times),
        (ShadowVariant::Concat, "truth")
    );
    let o = &s.optimise;
    assert_eq!((o.epochs, o.batch, o.accumulate), (200, 32, 1));
    assert_eq!((o.learning_rate, o.weight_decay), (1e-2, 1e-3));
    assert_eq!(
        (o.schedule, o.precision),
        (Schedule::Onecycle, Precision::F32)
    );
    assert_eq!((o.early_stop, s.checkpoint_minutes), (0, 10.0));
}

#[test]
fn a_training_needs_the_data_the_split_and_the_models_it_reads() {
    let stages = train("tof", "target = \"tof\", model = \"first\"")
        + &infer("seen", "first")
        + &train(
            "shadow",
            "target = \"shadow\", model = \"s\", shadow = { times = \"seen\" }",
        )
        + &train(
            "mirror",
            "target = \"specular\", model = \"m\", specular = { on = \"first\" }",
        )
        + &train(
            "other",
            "target = \"tof\", model = \"o\", split = \"half\", from = \"from-last-year\"",
        );
    let spec = good(&stages);
    let [_, _, tof, seen, shadow, mirror, other] = &spec.stages[..] else {
        panic!("{spec:?}");
    };
    assert_eq!(tof.needs, ["render", "split"]);
    assert_eq!(tof.tasks(), 1);
    assert_eq!(seen.needs, ["render", "tof"]);
    assert_eq!(settings(shadow).shadow.times, "of-first");
    assert_eq!(shadow.needs, ["render", "split", "seen"]);
    assert_eq!(mirror.needs, ["render", "split", "tof"]);
    assert_eq!(settings(other).from, "from-last-year");
    assert_eq!(other.needs, ["render"]);
    // The meaning is the same on the wire and in the catalog.
    let again = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(again, spec);
}

#[test]
fn a_model_called_like_a_stage_goes_before_the_stage() {
    let stages = train("a", "target = \"tof\", model = \"b\"")
        + &train("b", "target = \"tof\", model = \"c\"")
        + &train("d", "target = \"tof\", model = \"d\", from = \"a\"");
    let mut spec = good(&stages);
    assert_eq!(settings(&spec.stages[4]).from, "b");
    assert_eq!(spec.stages[4].needs, ["render", "split", "a"]);
    let before = spec.clone();
    spec.resolve().unwrap();
    assert_eq!(spec, before);
}

#[test]
fn a_matrix_goes_over_any_field_and_its_models_are_evaluated_together() {
    let sweep = "[[stage]]\nname = \"tof\"\nkind = \"train\"\nsource = \"render\"\n\
                 matrix = { lr = [0.01, 0.001], width = [8] }\n\
                 train = { target = \"tof\", model = \"tof-{lr}\", net = { width = \"{width}\", levels = 3 }, \
                 optimise = { learning_rate = \"{lr}\" } }\n";
    let spec = good(&(sweep.to_owned() + &evaluate("models = [\"tof\", \"old\"]")));
    let [_, _, one, two, evaluation] = &spec.stages[..] else {
        panic!("{spec:?}");
    };
    assert_eq!(one.name, "tof[0.01,8]");
    assert_eq!(
        (
            settings(one).optimise.learning_rate,
            settings(two).optimise.learning_rate
        ),
        (0.01, 0.001)
    );
    assert_eq!(
        (settings(two).net.width, &*settings(two).model),
        (8, "tof-0.001")
    );
    let TaskSpec::Evaluate(task) = &evaluation.task else {
        panic!("{evaluation:?}");
    };
    assert_eq!(task.evaluate.models, ["tof-0.01", "tof-0.001", "old"]);
    assert_eq!(
        (&*task.evaluate.side, task.evaluate.histogram),
        ("test", None)
    );
    assert_eq!(
        evaluation.needs,
        ["render", "split", "tof[0.01,8]", "tof[0.001,8]"]
    );
    let one_of_many = train("s", "target = \"tof\", model = \"s\", from = \"tof\"");
    let said = refused(&(sweep.to_owned() + &one_of_many));
    assert!(said.contains("stands for 2 models"), "{said}");
}

#[test]
fn whatever_shapes_a_model_is_in_its_key_and_how_often_it_is_saved_is_not() {
    let key = |settings: &str| {
        let text = format!("target = \"shadow\", model = \"m\"{settings}");
        stage_key(&good(&train("t", &text)).stages[2])
    };
    let plain = key("");
    assert_eq!(key(", checkpoint_minutes = 1.0"), plain);
    let parts = ", optimise = { batch = 32, accumulate = 4 }";
    assert_eq!(key(&format!("{parts}, processes = 4")), key(parts));
    assert_eq!(
        key(", optimise = { learning_rate = 0.01 }, seed = 0"),
        plain
    );
    for other in [
        ", seed = 1",
        ", scenes = 3",
        ", augment = false",
        ", histogram = \"transient_25\"",
        ", input = { bins = 64 }",
        ", input = { normalise = \"log\", max = 3.0 }",
        ", net = { width = 64 }",
        ", net = { stem = 128 }",
        ", net = { stem = 128, stem_form = \"linear\" }",
        ", shadow = { variant = \"index\" }",
        ", shadow = { times = \"x\" }",
        ", optimise = { epochs = 1 }",
        ", optimise = { precision = \"bf16\" }",
        ", from = \"x\"",
        ", version = \"x\"",
        ", split = \"x\"",
    ] {
        assert_ne!(key(other), plain, "{other}");
    }
    let other_name = good(&train("t", "target = \"shadow\", model = \"n\""));
    assert_ne!(stage_key(&other_name.stages[2]), plain);
}

#[test]
fn an_unusable_field_is_named() {
    for (settings, field, part) in [
        ("target = \"depth\", model = \"m\"", "", "`tof`, `shadow`"),
        ("target = \"tof\"", "", "missing field `model`"),
        (
            "target = \"tof\", model = \"a/b\"",
            "train.model",
            "letters",
        ),
        ("target = \"tof\", model = \"m\", colour = 1", "", "colour"),
        (
            "target = \"tof\", model = \"m\", net = { depth = 3 }",
            "",
            "depth",
        ),
        (
            "target = \"tof\", model = \"m\", net = { levels = 0 }",
            "train.net.levels",
            "2..=8",
        ),
        (
            "target = \"tof\", model = \"m\", net = { time_features = 8 }",
            "train.net.time_features",
            "unet25d",
        ),
        (
            "target = \"tof\", model = \"m\", net = { stem_form = \"linear\" }",
            "train.net.stem_form",
            "give net.stem",
        ),
        (
            "target = \"tof\", model = \"m\", net = { time_projection = \"each\" }",
            "train.net.time_projection",
            "unet25d",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"unet25d\", levels = 4, time_features = 100 }",
            "train.net.time_features",
            "multiple of 8",
        ),
        (
            "target = \"tof\", model = \"m\", net = { swin = { groups = 2 } }",
            "train.net.swin",
            "swinir",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"swinir\", width = 100 }",
            "train.net.width",
            "no multiple of the 6 heads",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"swinir\", width = 60, swin = { window = 1 } }",
            "train.net.swin.window",
            "2..=64",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"swinir\", width = 60, levels = 3 }",
            "train.net.levels",
            "is for U-Nets",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"swinir\", width = 60, stem = 8 }",
            "train.net.stem",
            "unet2d",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"embeddings\", time_features = 8 }",
            "train.net.time_features",
            "unet25d",
        ),
        (
            "target = \"specular\", model = \"m\", specular = { on = \"x\" }, net = { architecture = \"embeddings\" }",
            "train.specular.on",
            "from scratch",
        ),
        (
            "target = \"shadow\", model = \"m\", shadow = { variant = \"index\" }, net = { architecture = \"embeddings\" }",
            "train.shadow.variant",
            "concat",
        ),
        (
            "target = \"shadow\", model = \"m\", shadow = { variant = \"index\" }, net = { architecture = \"nlost\" }",
            "train.shadow.variant",
            "nlost",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"nlost\", width = 30 }",
            "train.net.width",
            "multiple of 4",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"nlost\", levels = 3 }",
            "train.net.levels",
            "nlost",
        ),
        (
            "target = \"tof\", model = \"m\", net = { architecture = \"nlost\", swin = { heads = 4 } }",
            "train.net.swin",
            "swinir",
        ),
        (
            "target = \"tof\", model = \"m\", optimise = { batch = 32, accumulate = 5 }",
            "train.optimise.accumulate",
            "does not divide",
        ),
        (
            "target = \"tof\", model = \"m\", optimise = { learning_rate = 0.0 }",
            "train.optimise.learning_rate",
            "..=10",
        ),
        (
            "target = \"tof\", model = \"m\", shadow = { times = \"x\" }",
            "train.shadow",
            "remove",
        ),
        (
            "target = \"tof\", model = \"m\", processes = 3, optimise = { batch = 32, accumulate = 2 }",
            "train.processes",
            "expected 1 to 2",
        ),
        (
            "target = \"tof\", model = \"m\", runtime = \"torch\", processes = 4, optimise = { batch = 36, accumulate = 6 }",
            "train.processes",
            "does not divide optimise.accumulate = 6",
        ),
        (
            "target = \"tof\", model = \"m\", torch = { compile = true }",
            "train.torch",
            "remove it",
        ),
        (
            "target = \"tof\", model = \"m\", processes = 0",
            "train.processes",
            "expected 1 to 1",
        ),
        (
            "target = \"tof\", model = \"m\", specular = { on = \"x\" }",
            "train.specular",
            "remove",
        ),
        (
            "target = \"tof\", model = \"m\", from = \"m\"",
            "train.from",
            "itself",
        ),
        (
            "target = \"tof\", model = \"m\", spots = [1]",
            "train.spots",
            "transient_spots",
        ),
        (
            "target = \"tof\", model = \"m\", split = \"a b\"",
            "train.split",
            "letters",
        ),
        (
            "target = \"tof\", model = \"m\", from = \"render\"",
            "from",
            "trains no model",
        ),
        (
            "target = \"tof\", model = \"m\", checkpoint_minutes = -0.5",
            "train.checkpoint_minutes",
            "0 is after each step",
        ),
        (
            "target = \"specular\", model = \"m\", specular = { on = \"x\" }, from = \"y\"",
            "train.from",
            "remove",
        ),
        (
            "target = \"tof\", model = \"m\", input = { max = 4.0 }",
            "train.input.max",
            "log",
        ),
    ] {
        let said = refused(&train("t", settings));
        assert!(
            said.contains(field) && said.contains(part),
            "{settings}: {said}"
        );
    }
    for (settings, part) in [
        ("models = []", "evaluate.models"),
        ("models = [\"a\", \"a\"]", "evaluate.models[1]"),
        ("models = [\"a\"], side = \"tests\"", "evaluate.side"),
        ("models = [\"a\"], spots = [1]", "evaluate.spots"),
    ] {
        let said = refused(&evaluate(settings));
        assert!(said.contains(part), "{settings}: {said}");
    }
    let seen = train("tof", "target = \"tof\", model = \"m\"")
        + &train("mirrors", "target = \"specular\", model = \"s\"")
        + &infer("masks", "s")
        + &infer("seen", "m");
    for (times, part) in [
        (
            "tof",
            "stage that keeps nothing of scenes; name an infer stage",
        ),
        ("masks", "holds no depths"),
        ("of-s", "holds no depths"),
        ("", "give \"truth\""),
        ("a/b", "plain name"),
        ("..", "plain name"),
    ] {
        let shadow =
            format!("target = \"shadow\", model = \"x\", shadow = {{ times = \"{times}\" }}");
        let said = refused(&(seen.clone() + &train("t", &shadow)));
        assert!(
            said.contains("train.shadow.times") && said.contains(part),
            "{times}: {said}"
        );
        if !times.is_empty() {
            let asked = format!("models = [\"m\"], times = \"{times}\"");
            let said = refused(&(seen.clone() + &evaluate(&asked)));
            assert!(
                said.contains("evaluate.times") && said.contains(part),
                "{times}: {said}"
            );
        }
    }
    let all =
        "target = \"shadow\", model = \"x\", shadow = { variant = \"all\", times = \"seen\" }";
    assert!(refused(&(seen.clone() + &train("t", all))).contains("is given no times"));
    let asked = good(&(seen + &evaluate("models = [\"m\"], times = \"seen\"")));
    assert_eq!(asked.stages[6].needs, ["render", "split", "tof", "seen"]);
    let twice = train("a", "target = \"tof\", model = \"m\"")
        + &train("b", "target = \"tof\", model = \"m\"");
    assert!(refused(&twice).contains("stage \"a\" trains"));
    let late = train("a", "target = \"tof\", model = \"a\", from = \"z\"")
        + &train("b", "target = \"tof\", model = \"z\"");
    assert!(refused(&late).contains("put that before"));
    let folder = "[[stage]]\nname = \"x\"\nscenes = { kind = \"primitive\", count = 9 }\n\
                  output = { store = \"/s\", dataset = \"models\" }\n";
    assert!(refused(folder).contains("output.dataset"));
}

#[test]
fn settings_without_their_kind_are_refused() {
    let said = refused(
        "[[stage]]\nkind = \"split\"\nsource = \"render\"\nsplit = { fractions = [1.0, 0.0, 0.0] }\ntrain = { target = \"tof\", model = \"m\" }\n",
    );
    assert!(said.contains("belongs to kind = \"train\""), "{said}");
}
