//! Demultiplexing in job files: its tasks, keys, refusals, and the stages that read its
//! predictions.

use picofarm_proto::{
    key::stage_key,
    spec::{JobSpec, TaskSpec},
    wire,
};

const ROOMS: &str = "name = \"n\"\n[[stage]]\nname = \"rooms\"\nscenes = { kind = \"primitive\", count = 9 }\n\
                     output = { store = \"/s\", dataset = \"rooms\" }\n";
const PLACE: &str = "store = \"/s\", dataset = \"rooms-apart\"";

fn apart(settings: &str, output: &str) -> String {
    format!(
        "[[stage]]\nname = \"apart\"\nkind = \"demultiplex\"\nsource = \"rooms\"\ndemultiplex = {{ {settings} }}\n\
         output = {{ {output} }}\n"
    )
}

fn good(stages: &str) -> JobSpec {
    let spec: JobSpec = toml::from_str(&(ROOMS.to_owned() + stages)).unwrap();
    spec.check().unwrap();
    spec.check_places().unwrap();
    spec
}

fn refused(stages: &str) -> String {
    match toml::from_str::<JobSpec>(&(ROOMS.to_owned() + stages)) {
        Err(error) => error.to_string(),
        Ok(spec) => spec.check().unwrap_err().to_string(),
    }
}

#[test]
fn a_demultiplexing_has_a_task_for_each_scene_and_needs_no_model() {
    let spec = good(&apart("", PLACE));
    let stage = spec.stages.last().unwrap();
    let TaskSpec::Demultiplex(task) = &stage.task else {
        panic!("{stage:?}");
    };
    assert_eq!((stage.tasks(), task.count), (9, 9));
    assert_eq!(stage.needs, ["rooms"]);
    assert_eq!(stage.task.models(), []);
    let again = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(again, spec);
    let key = |settings: &str| stage_key(good(&apart(settings, PLACE)).stages.last().unwrap());
    let plain = key("");
    let defaults =
        "histogram = \"transient\", places = \"given\", depth = \"own\", evidence = false";
    assert_eq!(key(defaults), plain);
    for other in [
        "histogram = \"transient_25\"",
        "places = \"returns\"",
        "version = \"x\"",
        "depth = \"truth\"",
        "evidence = true",
        "method = \"matched-filter\"",
        "method = \"likelihood\"",
    ] {
        assert_ne!(key(other), plain, "{other}");
    }
}

#[test]
fn a_demultiplexing_that_cannot_be_is_refused_with_its_field() {
    for (stages, expected) in [
        (
            apart("histogram = \"transient_spots\"", PLACE),
            "demultiplex.histogram: \"transient_spots\" has each spot alone",
        ),
        (apart("places = \"guessed\"", PLACE), "guessed"),
        (apart("method = \"guessed\"", PLACE), "guessed"),
        (
            apart("method = \"likelihood\", evidence = true", PLACE),
            "demultiplex.evidence: is for method = \"physics\"",
        ),
        (
            apart(
                "method = \"matched-filter\", histogram = \"transient_25\"",
                PLACE,
            ),
            "demultiplex.histogram: is for method = \"physics\"",
        ),
        (
            apart("method = \"matched-filter\", depth = \"truth\"", PLACE),
            "demultiplex.depth: is for method = \"physics\"",
        ),
        (apart("models = [\"a\"]", PLACE), "models"),
        (
            apart("", "store = \"/s\", dataset = \"rooms\""),
            "output.dataset: \"rooms\" is the source itself",
        ),
        (
            apart(
                "",
                "store = \"/s\", dataset = \"a\", profile = \"plain-f32\"",
            ),
            "output.profile: \"plain-f32\" is how histograms are coded",
        ),
    ] {
        let said = refused(&stages);
        assert!(said.contains(expected), "{said:?} lacks {expected:?}");
    }
}

#[test]
fn its_predictions_serve_where_those_of_networks_do() {
    let apart = apart("", PLACE);
    let spec = good(
        &(apart.clone()
            + "[[stage]]\nname = \"3d\"\nkind = \"reconstruct\"\nsource = \"rooms\"\n\
               reconstruct = { from = \"predictions\", predictions = \"apart\" }\n\
               output = { store = \"/s\", dataset = \"rooms-3d\" }\n"),
    );
    assert_eq!(spec.stages.last().unwrap().needs, ["rooms", "apart"]);
    let spec = good(
        &(apart
            + "[[stage]]\nkind = \"split\"\nsource = \"rooms\"\nsplit = { fractions = [0.5, 0.3, 0.2] }\n\
               [[stage]]\nname = \"shadow\"\nkind = \"train\"\nsource = \"rooms\"\n\
               train = { target = \"shadow\", model = \"sh\", shadow = { times = \"apart\" } }\n"),
    );
    let needs = &spec.stages.last().unwrap().needs;
    assert!(needs.contains(&"apart".to_owned()), "{needs:?}");
}

/// A split and a shadow network with more settings.
fn network(settings: &str) -> String {
    format!(
        "[[stage]]\nkind = \"split\"\nsource = \"rooms\"\nsplit = {{ fractions = [0.5, 0.3, 0.2] }}\n\
         [[stage]]\nname = \"shadow\"\nkind = \"train\"\nsource = \"rooms\"\n\
         train = {{ target = \"shadow\", model = \"sh\", {settings} }}\n"
    )
}

fn evaluation(times: &str) -> String {
    format!(
        "[[stage]]\nkind = \"evaluate\"\nsource = \"rooms\"\n\
         evaluate = {{ models = [\"shadow\"], times = \"{times}\" }}\n"
    )
}

#[test]
fn networks_take_evidence_and_depths_from_stages_that_store_them() {
    let evident = network("shadow = { variant = \"evidence\", times = \"apart\" }");
    let timed = network("shadow = { times = \"apart\" }");
    let spec = good(&(apart("evidence = true", PLACE) + &evident + &evaluation("apart")));
    let needs = &spec.stages[3].needs;
    assert!(needs.contains(&"apart".to_owned()), "{needs:?}");
    let TaskSpec::Train(task) = &spec.stages[3].task else {
        panic!("{spec:?}");
    };
    assert!(task.train.takes_evidence());
    good(&(apart("depth = \"truth\", evidence = true", PLACE) + &evident));
    for (stages, expected) in [
        (
            apart("", PLACE) + &evident,
            "train.shadow.times: \"rooms-apart\" is written by a stage before this one, and holds no evidence",
        ),
        (
            apart("depth = \"truth\"", PLACE) + &timed,
            "train.shadow.times: \"rooms-apart\" is written by a stage before this one, and holds no depths",
        ),
        (
            apart("depth = \"truth\", evidence = true", PLACE)
                + &network("")
                + &evaluation("apart"),
            "evaluate.times: \"rooms-apart\" is written by a stage before this one, and holds no depths",
        ),
        (apart("depth = \"guessed\"", PLACE), "guessed"),
    ] {
        let said = refused(&stages);
        assert!(said.contains(expected), "{said:?} lacks {expected:?}");
    }
}

#[test]
fn settings_of_histograms_are_refused_for_networks_on_evidence() {
    let shadow = "shadow = { variant = \"evidence\", times = \"apart\" }";
    for (settings, expected) in [
        (
            "shadow = { variant = \"evidence\" }".to_owned(),
            "train.shadow.times: is \"truth\"",
        ),
        (
            format!("{shadow}, input = {{ bins = 8 }}"),
            "train.input: is for histograms",
        ),
        (
            format!("{shadow}, sensor = {{ dark_per_bin = 0.1 }}"),
            "train.sensor: is for histograms",
        ),
        (
            format!("{shadow}, net = {{ architecture = \"nlost\" }}"),
            "train.net.architecture: is \"nlost\"",
        ),
    ] {
        let said = refused(&(apart("evidence = true", PLACE) + &network(&settings)));
        assert!(said.contains(expected), "{said:?} lacks {expected:?}");
    }
}
