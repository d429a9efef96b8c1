//! Inference and reports in job files: references to models, needs, keys of results, and refusals.

use picofarm_proto::{
    key::stage_key,
    spec::{JobSpec, TaskSpec},
    wire,
};

/// Returns a data set, its split, and one model of each kind.
fn job(stages: &str) -> Result<JobSpec, toml::de::Error> {
    let train = |name: &str, target: &str, model: &str| {
        format!(
            "[[stage]]\nname = \"{name}\"\nkind = \"train\"\nsource = \"rooms\"\n\
             train = {{ target = \"{target}\", model = \"{model}\" }}\n"
        )
    };
    let before = [
        "name = \"n\"\n[[stage]]\nname = \"rooms\"\nscenes = { kind = \"primitive\", count = 9 }\n\
         output = { store = \"/s\", dataset = \"rooms\" }\n\
         [[stage]]\nkind = \"split\"\nsource = \"rooms\"\nsplit = { fractions = [0.5, 0.3, 0.2] }\n",
        &train("depth", "tof", "d"),
        &train("light", "shadow", "l"),
        &train("mirrors", "specular", "m"),
        "[[stage]]\nname = \"asked\"\nkind = \"evaluate\"\nsource = \"rooms\"\nevaluate = { models = [\"depth\"] }\n",
    ];
    toml::from_str(&(before.concat() + stages))
}

fn good(stages: &str) -> JobSpec {
    let spec = job(stages).unwrap();
    spec.check().unwrap();
    spec.check_places().unwrap();
    spec
}

fn refused(stages: &str) -> String {
    match job(stages) {
        Err(error) => error.to_string(),
        Ok(spec) => spec.check().unwrap_err().to_string(),
    }
}

fn infer(settings: &str, output: &str) -> String {
    format!(
        "[[stage]]\nname = \"seen\"\nkind = \"infer\"\nsource = \"rooms\"\ninfer = {{ {settings} }}\noutput = {{ {output} }}\n"
    )
}

const PLACE: &str = "store = \"/s\", dataset = \"rooms-seen\"";

fn report(settings: &str) -> String {
    format!("[[stage]]\nname = \"told\"\nkind = \"report\"\nreport = {{ {settings} }}\n")
}

#[test]
fn an_inference_has_a_task_for_each_scene_and_needs_those_who_train_its_models() {
    let spec = good(&infer("models = [\"depth\", \"l\", \"old\"]", PLACE));
    let stage = spec.stages.last().unwrap();
    let TaskSpec::Infer(task) = &stage.task else {
        panic!("{stage:?}");
    };
    assert_eq!(task.infer.models, ["d", "l", "old"]);
    assert_eq!((stage.tasks(), task.count), (9, 9));
    assert_eq!(stage.needs, ["rooms", "depth", "light"]);
    let again = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(again, spec);
    let key = |settings: &str| stage_key(good(&infer(settings, PLACE)).stages.last().unwrap());
    let plain = key("models = [\"d\"]");
    assert_eq!(key("models = [\"depth\"]"), plain);
    for other in [
        "models = [\"x\"]",
        "models = [\"d\"], histogram = \"transient_25\"",
        "models = [\"d\"], version = \"x\"",
    ] {
        assert_ne!(key(other), plain, "{other}");
    }
}

#[test]
fn an_inference_that_cannot_be_is_refused_before_anything_is_trained() {
    let more = "[[stage]]\nname = \"more\"\nkind = \"train\"\nsource = \"rooms\"\n\
                train = { target = \"tof\", model = \"e\" }\n";
    for (stages, part) in [
        (
            more.to_owned() + &infer("models = [\"depth\", \"more\"]", PLACE),
            "\"d\" and \"e\" both predict \"tof\"",
        ),
        (infer("models = []", PLACE), "infer.models: names 0 models"),
        (
            infer("models = [\"a\", \"b\", \"c\", \"d\"]", PLACE),
            "infer.models: names 4 models",
        ),
        (infer("models = [\"d\", \"d\"]", PLACE), "named twice"),
        (infer("models = [\"asked\"]", PLACE), "trains no model"),
        (infer("models = [\"d\"], side = \"test\"", PLACE), "side"),
        (
            infer("models = [\"d\"], spots = [1]", PLACE),
            "infer.spots: need histogram",
        ),
        (
            infer("models = [\"d\"]", "store = \"/s\", dataset = \"rooms\""),
            "is the source itself",
        ),
        (
            infer("models = [\"d\"]", "store = \"/s\", dataset = \"models\""),
            "trained models",
        ),
        (
            infer("models = [\"d\"]", "store = \"/s\", dataset = \"reports\""),
            "reports about models",
        ),
        (
            infer(
                "models = [\"d\"]",
                "store = \"/s\", dataset = \"x\", profile = \"lossless\"",
            ),
            "output.profile",
        ),
        (
            infer("models = [\"d\"]", PLACE)
                + "[[stage]]\nname = \"cut\"\nkind = \"split\"\nsource = \"seen\"\nsplit = { counts = [1, 1, 1] }\n",
            "\"seen\" is no stage before this one that makes a data set",
        ),
        (
            infer("models = [\"d\"]", PLACE)
                + "[[stage]]\nname = \"cut\"\nkind = \"split\"\nsource = { store = \"/s\", dataset = \"rooms-seen\" }\n\
                   split = { counts = [1, 1, 1] }\n",
            "is no data set",
        ),
    ] {
        let said = refused(&stages);
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn a_report_lies_with_its_models_and_waits_for_what_is_said_of_them() {
    let spec = good(&report(
        "name = \"main\", models = [\"depth\", \"m\", \"old\"]",
    ));
    let stage = spec.stages.last().unwrap();
    let TaskSpec::Report(task) = &stage.task else {
        panic!("{stage:?}");
    };
    assert_eq!(task.report.models, ["d", "m", "old"]);
    assert_eq!((&*task.report.store, task.report.pictures), ("/s", 2));
    assert_eq!(stage.needs, ["depth", "mirrors", "asked"]);
    assert_eq!(stage.tasks(), 1);
    let again = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(again, spec);
    let other = good(&report(
        "name = \"main\", models = [\"old\"], store = \"/t\"",
    ));
    assert!(other.stages.last().unwrap().needs.is_empty());
}

#[test]
fn a_report_that_cannot_be_is_refused() {
    for (stages, part) in [
        (
            report("name = \"main\", models = [\"old\"]"),
            "report.store: is missing",
        ),
        (report("name = \"main\", models = []"), "report.models"),
        (
            report("name = \"a/b\", models = [\"d\"]"),
            "report.name: \"a/b\"",
        ),
        (
            report("name = \"main\", models = [\"d\"], pictures = 1000"),
            "report.pictures",
        ),
        (
            report("name = \"main\", models = [\"depth\"], store = \"/t\""),
            "keeps its model in /s",
        ),
        (
            report("name = \"main\", models = [\"d\"]")
                + &report("name = \"main\", models = [\"m\"]").replace("told", "again"),
            "is stage \"told\"'s report",
        ),
        (
            report("name = \"main\", models = [\"d\"]").replace("kind", "source = \"rooms\"\nkind"),
            "reads no data set",
        ),
    ] {
        let said = refused(&stages);
        assert!(said.contains(part), "{said}");
    }
}
