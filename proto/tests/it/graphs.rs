//! Jobs of several stages: their written form, dependencies, and refusals.

use picofarm_proto::{
    key::{spec_hash, stage_key},
    spec::{JobSpec, SpecError, TaskSpec},
    wire,
};

const RENDER: &str = "[[stage]]\nscenes = { kind = \"primitive\", count = 9 }\n\
                      output = { store = \"/s\", dataset = \"clean\" }\n";

fn read(stages: &str) -> Result<JobSpec, toml::de::Error> {
    toml::from_str(&format!("name = \"n\"\n{RENDER}{stages}"))
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

const NOISE: &str = "[[stage]]\nname = \"noise\"\nkind = \"reprocess\"\nsource = \"render\"\n\
                     matrix = { dark = [0.0, 0.5], rebin = [1] }\n\
                     reprocess = { sensor = { dark_per_bin = \"{dark}\", rebin = \"{rebin}\" } }\n\
                     output = { store = \"/s\", dataset = \"noisy-{dark}\" }\n";

#[test]
fn a_job_without_stages_is_one_that_renders() {
    let short: JobSpec = toml::from_str(
        "name = \"n\"\n[scenes]\nkind = \"primitive\"\ncount = 9\n[output]\nstore = \"/s\"\ndataset = \"clean\"\n",
    )
    .unwrap();
    assert_eq!(short, good(""));
    assert_eq!(spec_hash(&short), spec_hash(&good("")));
}

#[test]
fn what_a_stage_reads_it_needs_and_knows_the_size_of() {
    let spec = good(
        "[[stage]]\nkind = \"split\"\nsource = \"render\"\nsplit = { fractions = [0.5, 0.3, 0.2] }\n",
    );
    let split = &spec.stages[1];
    assert_eq!(split.name, "split");
    assert_eq!(split.needs, ["render"]);
    let TaskSpec::Split(task) = &split.task else {
        panic!("{split:?}");
    };
    assert_eq!(
        (&*task.source.store, &*task.source.dataset, task.count),
        ("/s", "clean", 9)
    );
    assert_eq!(split.tasks(), 1);
    // The same, referred to by place.
    let place = good(
        "[[stage]]\nkind = \"split\"\nsource = { store = \"/s\", dataset = \"clean\" }\n\
         split = { fractions = [0.5, 0.3, 0.2] }\n",
    );
    assert_eq!(place, spec);
}

#[test]
fn a_matrix_makes_a_stage_for_each_combination() {
    let last = "[[stage]]\nkind = \"split\"\nsource = \"noise[0.5,1]\"\nneeds = [\"noise\"]\n\
                split = { fractions = [0.5, 0.3, 0.2] }\n";
    let spec = good(&format!("{NOISE}{last}"));
    let names: Vec<_> = spec.stages.iter().map(|s| &*s.name).collect();
    assert_eq!(names, ["render", "noise[0.0,1]", "noise[0.5,1]", "split"]);
    let TaskSpec::Reprocess(noise) = &spec.stages[2].task else {
        panic!("{:?}", spec.stages[2]);
    };
    assert_eq!(noise.reprocess.sensor.dark_per_bin, 0.5);
    assert_eq!((&*noise.output.dataset, noise.count), ("noisy-0.5", 9));
    assert_eq!(spec.stages[3].needs, ["noise[0.0,1]", "noise[0.5,1]"]);
    assert_ne!(stage_key(&spec.stages[1]), stage_key(&spec.stages[2]));
}

#[test]
fn a_graph_survives_the_wire_and_the_catalog() {
    let spec = good(NOISE);
    let back = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(back, spec);
    let stored = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<JobSpec>(&stored).unwrap(), spec);
}

#[test]
fn what_a_stage_runs_on_and_after_does_not_name_its_results() {
    let plain = stage_key(&good("").stages[0]);
    for more in [
        "resources = { cores = 8, memory_gib = 4.0, gpus = 1, labels = [\"fast\"] }\n",
        "force = true\n",
        "tolerate_dead = true\n",
        "name = \"other\"\n",
    ] {
        let spec = good(more);
        assert_eq!(stage_key(&spec.stages[0]), plain, "{more}");
        assert_ne!(spec_hash(&spec), spec_hash(&good("")), "{more}");
    }
}

#[test]
fn what_cannot_be_is_refused_by_name() {
    let split = |more: &str| {
        refused(&format!(
            "[[stage]]\nkind = \"split\"\nsource = \"render\"\nsplit = {{ fractions = [0.5, 0.3, 0.2] }}\n{more}"
        ))
    };
    let cases = [
        (
            split("needs = [\"nobody\"]\n"),
            ["stage.split.needs", "no stage \"nobody\""],
        ),
        (
            split("needs = [\"split\"]\n"),
            ["stage.split.needs", "no stage \"split\""],
        ),
        (
            split("name = \"render\"\n"),
            ["stage.render.name", "another stage's"],
        ),
        (
            split("render = { bins = 3 }\n"),
            ["stage[1]", "render: belongs to kind = \"render\""],
        ),
        (split("bins = 3\n"), ["stage[1]", "unknown field `bins`"]),
        (
            split("resources = { labels = [\"a b\"] }\n"),
            ["resources.labels", "\"a b\""],
        ),
        (
            split("resources = { memory_gib = -1 }\n"),
            ["resources.memory_gib", "-1"],
        ),
        (
            refused("[[stage]]\nkind = \"dance\"\n"),
            ["kind", "\"dance\" is not one of"],
        ),
        (
            refused(
                "[[stage]]\nkind = \"export\"\nsource = \"split\"\nexport = { dest = \"/x\" }\n",
            ),
            ["stage.export.source", "no stage before this one"],
        ),
        (
            refused(
                "[[stage]]\nname = \"again\"\nscenes = { kind = \"primitive\", count = 1 }\n\
                     output = { store = \"/s\", dataset = \"clean\" }\n",
            ),
            ["stage.again.output.dataset", "stage \"render\""],
        ),
        (
            refused(&NOISE.replace("noisy-{dark}", "noisy")),
            ["output.dataset", "noise[0.0,1]"],
        ),
        (
            refused(&NOISE.replace("[0.0, 0.5]", "0.5")),
            ["stage.matrix", "dark must be a list"],
        ),
        (
            refused(&NOISE.replace("[0.0, 0.5]", &format!("{:?}", vec![1; 1001]))),
            ["stage.matrix", "more than 1000"],
        ),
    ];
    for (said, parts) in cases {
        for part in parts {
            assert!(said.contains(part), "{part:?} is not in {said:?}");
        }
    }
    let limits = |limits: &str| -> SpecError {
        let spec: JobSpec =
            toml::from_str(&format!("name = \"n\"\n[limits]\n{limits}\n{RENDER}")).unwrap();
        spec.check().unwrap_err()
    };
    assert_eq!(limits("deadline = \"tomorrow\"").field, "limits.deadline");
    assert_eq!(limits("max_failures = 0").field, "limits.max_failures");
}

#[test]
fn a_lease_brings_only_its_own_files() {
    let files: Vec<String> = (0..9)
        .map(|i| format!("{{ path = \"/{i}.glb\", sha256 = \"{i}\" }}"))
        .collect();
    let spec: JobSpec = toml::from_str(&format!(
        "name = \"n\"\n[scenes]\nkind = \"files\"\nfiles = [{}]\n[output]\nstore = \"/s\"\ndataset = \"d\"\n",
        files.join(", ")
    ))
    .unwrap();
    let part = spec.stages[0].only(3, 5);
    let scenes = part.task.scenes().unwrap();
    let paths: Vec<_> = (0..9)
        .map(|i| scenes.kind.file(i).map(|f| &*f.path))
        .collect();
    let mut expected = vec![None; 9];
    (expected[3], expected[4]) = (Some("/3.glb"), Some("/4.glb"));
    assert_eq!(paths, expected);
    let text = serde_json::to_string(&part).unwrap();
    let back: picofarm_proto::spec::StageSpec = serde_json::from_str(&text).unwrap();
    assert_eq!(back, part);
    // A submitted job lists all of them.
    let whole = JobSpec {
        stages: vec![part],
        ..spec
    };
    assert_eq!(whole.check().unwrap_err().field, "scenes.first");
}

const HEAVY: &str = "name = \"n\"\nparts = 4\n[scenes]\nkind = \"files\"\nfiles = [\"/0.glb\", \"/1.glb\", \"/2.glb\"]\n\
                     [output]\nstore = \"/s\"\ndataset = \"d\"\n";

#[test]
fn a_render_stage_in_parts_needs_one_that_renders_them_and_its_result_has_the_same_key() {
    let spec: JobSpec = toml::from_str(HEAVY).unwrap();
    spec.check().unwrap();
    let stages: Vec<_> = spec
        .stages
        .iter()
        .map(|s| (&*s.name, s.task.kind(), s.tasks(), &s.needs[..]))
        .collect();
    let needs = ["render.parts".to_owned()];
    let expected = [
        ("render.parts", "part", 15, &[][..]),
        ("render", "render", 3, &needs[..]),
    ];
    assert_eq!(stages, expected);
    let whole: JobSpec = toml::from_str(&HEAVY.replace("parts = 4", "")).unwrap();
    assert_eq!(stage_key(&whole.stages[0]), stage_key(&spec.stages[1]));
    assert_ne!(stage_key(&whole.stages[0]), stage_key(&spec.stages[0]));
    // A job read again, from the catalog or the wire, gets no further stages.
    let text = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<JobSpec>(&text).unwrap(), spec);
    // Tasks 4 to 6 belong to scenes 0 and 1.
    let leased = spec.stages[0].only(4, 7);
    let scenes = leased.task.scenes().unwrap();
    let there = [0, 1, 2].map(|i| scenes.kind.file(i).is_some());
    assert_eq!(there, [true, true, false]);
}

#[test]
fn an_evaluation_in_shards_needs_a_stage_that_asks_of_them_and_its_result_has_the_same_key() {
    let text = "name = \"n\"\n[[stage]]\nkind = \"evaluate\"\nsource = { store = \"/s\", dataset = \"d\" }\ncount = 9\n\
                evaluate = { models = [\"m\"], shards = 7 }\n";
    let spec: JobSpec = toml::from_str(text).unwrap();
    spec.check().unwrap();
    let stages: Vec<_> = spec
        .stages
        .iter()
        .map(|s| (&*s.name, s.task.kind(), s.tasks(), &s.needs[..]))
        .collect();
    let needs = ["evaluate.shards".to_owned()];
    let expected = [
        ("evaluate.shards", "evaluate_shard", 7, &[][..]),
        ("evaluate", "evaluate", 1, &needs[..]),
    ];
    assert_eq!(stages, expected);
    let whole: JobSpec = toml::from_str(&text.replace(", shards = 7", "")).unwrap();
    assert_eq!(whole.stages.len(), 1);
    assert_eq!(stage_key(&whole.stages[0]), stage_key(&spec.stages[1]));
    assert_ne!(stage_key(&whole.stages[0]), stage_key(&spec.stages[0]));
    let text_again = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<JobSpec>(&text_again).unwrap(), spec);
    let none: JobSpec = toml::from_str(&text.replace("shards = 7", "shards = 0")).unwrap();
    let error = none.check().unwrap_err().to_string();
    assert!(
        error.contains("evaluate.shards: is 0, expected 1 to 10000"),
        "{error}"
    );
}

#[test]
fn parts_of_what_cannot_be_divided_are_refused() {
    let refused = |text: &str| {
        let spec: JobSpec = toml::from_str(text).unwrap();
        spec.check().unwrap_err().to_string()
    };
    let error = refused(&format!("{HEAVY}[render]\nerror = 0.1\n"));
    assert!(
        error.contains("parts") && error.contains("render.samples"),
        "{error}"
    );
    let error = refused(&HEAVY.replace("parts = 4", "parts = 2000"));
    assert!(error.contains("2000 lies outside 1..=1024"), "{error}");
    let error =
        toml::from_str::<JobSpec>(&HEAVY.replace("parts = 4", "parts = 4\njoined_by = \"ab\""));
    assert!(error.unwrap_err().to_string().contains("joined_by"));
}
