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
    assert_eq!(key("histogram = \"transient\", places = \"given\""), plain);
    for other in [
        "histogram = \"transient_25\"",
        "places = \"returns\"",
        "version = \"x\"",
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
