//! Job settings from file to model to wire and back, refusals, and dependencies of keys.

use picofarm_proto::{
    key::{StageKey, spec_hash, stage_key},
    spec::{JobSpec, RenderTask, SpecError, TaskSpec},
    wire,
};

fn read(scenes: &str, render: &str) -> Result<JobSpec, toml::de::Error> {
    toml::from_str(&format!(
        "name = \"test\"\n[scenes]\nkind = \"primitive\"\ncount = 3\nseed = 1\n{scenes}\n\
         [render]\nresolution = 16\nsamples = 4\nrenderer = \"r\"\n{render}\n\
         [output]\nstore = \"/store\"\ndataset = \"rooms\"\n"
    ))
}

fn good(render: &str) -> JobSpec {
    let spec = read("spots = 100", render).unwrap();
    spec.check().unwrap();
    spec
}

fn key(spec: &JobSpec) -> StageKey {
    stage_key(&spec.stages[0])
}

fn complaint(scenes: &str, render: &str) -> SpecError {
    read(scenes, render).unwrap().check().unwrap_err()
}

#[test]
fn a_job_without_subsets_keeps_the_key_it_had_before_there_were_any() {
    assert_eq!(
        key(&good("")).to_string(),
        "a65f63ca6fb2563240587717a1b36e8917c6a63f1d3f9517bf979c1df92df2d4"
    );
    let named = good("subsets = []\nper_spot = false\nstrategy = {}");
    assert_eq!(key(&named), key(&good("")));
    assert_eq!(spec_hash(&named), spec_hash(&good("")));
}

#[test]
fn other_subsets_and_other_strategies_are_other_results() {
    let jobs = [
        "",
        "subsets = [4]",
        "subsets = [25]",
        "subsets = [4, 25]",
        "per_spot = true",
        "strategy = { path_reuse = 1 }",
        "strategy = { path_reuse = 2 }",
        "strategy = { mirror_images = false }",
        "strategy = { mirror_images = true }",
    ];
    let keys = jobs.map(|job| key(&good(job)));
    for (i, key) in keys.iter().enumerate() {
        assert!(!keys[..i].contains(key), "{:?}", jobs[i]);
    }
    let reversed = key(&good("subsets = [25, 4]"));
    assert_eq!(keys[3], reversed, "their order changes nothing");
}

#[test]
fn subsets_and_strategies_survive_the_wire_and_the_catalog() {
    let spec = good(
        "subsets = [25, 4]\nper_spot = true\nstrategy = { path_reuse = 1, light_vertices = false }",
    );
    let TaskSpec::Render(RenderTask { render, .. }) = &spec.stages[0].task else {
        unreachable!("the job renders");
    };
    assert_eq!(render.subsets, [4, 25]);
    assert_eq!(render.strategy.light_vertices, Some(false));
    let back = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
    assert_eq!(back, spec);
    let stored = serde_json::to_string(&spec).unwrap();
    assert_eq!(serde_json::from_str::<JobSpec>(&stored).unwrap(), spec);
}

#[test]
fn what_cannot_be_used_is_named() {
    let at = |scenes: &str, render: &str| {
        let error = complaint(scenes, render);
        (error.field, error.what)
    };
    let (field, what) = at("spots = 25", "subsets = [4]");
    assert!(
        field == "render.subsets" && what.contains("scenes.spots = 25"),
        "{what}"
    );
    let (field, what) = at("spots = 100", "subsets = [16]");
    assert!(field == "render.subsets" && what.contains("16"), "{what}");
    let (field, what) = at("spots = 100", "subsets = [4, 4]");
    assert!(field == "render.subsets" && what.contains("once"), "{what}");
    let wrong = read("", "strategy = { \"mirror-images\" = true }").unwrap_err();
    assert!(
        wrong
            .to_string()
            .contains("render.strategy: \"mirror-images\" is unknown"),
        "{wrong}"
    );
    let wrong = read("", "strategy = { path_reuse = \"much\" }").unwrap_err();
    assert!(wrong.to_string().contains("path_reuse"), "{wrong}");
}

#[test]
fn settings_of_a_reconstruction_are_refused_by_field_where_they_make_no_sense() {
    let check = |settings: &str| {
        let spec: JobSpec = toml::from_str(&format!(
            "name = \"test\"\n[[stage]]\nkind = \"reconstruct\"\nsource = {{ store = \"/store\", dataset = \"rooms\" }}\ncount = 3\n\
             output = {{ store = \"/store\", dataset = \"rooms-3d\" }}\n[stage.reconstruct]\n{settings}\n"
        ))
        .unwrap();
        spec.check().map(|()| stage_key(&spec.stages[0]))
    };
    let grid = check("").unwrap();
    assert_eq!(check("field = \"grid\"").unwrap(), grid);
    assert_eq!(check("mirrors = \"leave_out\"").unwrap(), grid);
    assert_ne!(check("mirrors = \"keep\"").unwrap(), grid);
    assert_ne!(check("from = \"given\"").unwrap(), grid);
    let networks = check("field = \"mlp\"\nmlp = { steps = 8 }").unwrap();
    assert_ne!(networks, grid);
    let other = check("field = \"mlp\"\nmlp = { steps = 8, shadow_loss = \"cross_entropy\" }");
    assert_ne!(other.unwrap(), networks);
    for (settings, field, word) in [
        ("field = \"mlp\"", "mlp.steps", "steps = 1000"),
        ("mlp = { steps = 8 }", "mlp", "field = \"mlp\""),
        (
            "field = \"mlp\"\nmlp = { steps = 7 }",
            "mlp.steps",
            "choose 8 to",
        ),
        (
            "field = \"mlp\"\nmlp = { width = 4 }",
            "mlp.width",
            "choose 8 to 1024",
        ),
        (
            "field = \"mlp\"\nmlp = { batch = 0 }",
            "mlp.batch",
            "choose 1 to",
        ),
        (
            "field = \"mlp\"\nmlp = { steps = 8 }\ngrid = { shadows = \"ignore\" }",
            "grid.shadows",
            "learn from shadows",
        ),
        (
            "sensor = { dark_per_bin = 1.0 }",
            "sensor",
            "add from = \"captures\"",
        ),
        (
            "from = \"captures\"\nsensor = { rebin = 2 }",
            "sensor.rebin",
            "keep their bins",
        ),
        (
            "from = \"captures\"\nsensor = { dark_per_bin = -1.0 }",
            "sensor.dark_per_bin",
            "",
        ),
        (
            "from = \"captures\"\nmirrors = \"keep\"",
            "mirrors",
            "does not know",
        ),
        (
            "from = \"given\"\npredictions = \"seen\"",
            "predictions",
            "only from = \"predictions\" reads",
        ),
    ] {
        let error = check(settings).unwrap_err();
        assert!(
            error.field.ends_with(&format!("reconstruct.{field}")),
            "{error}"
        );
        assert!(error.what.contains(word), "{error}");
    }
}

#[test]
fn the_automatic_profile_is_as_coarse_as_the_error_of_the_render_allows() {
    let profile = |budget: &str| {
        let spec: JobSpec = toml::from_str(&format!(
            "name = \"test\"\n[scenes]\nkind = \"primitive\"\ncount = 3\nseed = 1\n[render]\nresolution = 16\n\
             {budget}\n[output]\nstore = \"/store\"\ndataset = \"rooms\"\nprofile = \"auto\"\n"
        ))
        .unwrap();
        spec.check().unwrap();
        let TaskSpec::Render(task) = &spec.stages[0].task else {
            panic!("a render stage")
        };
        task.output.profile.clone()
    };
    assert_eq!(profile("samples = 64"), "sqrt-u16");
    assert_eq!(profile("error = \"2%\""), "sqrt-u16");
    assert_eq!(profile("error = \"10%\""), "balanced");
    assert_eq!(profile("error = \"20%\""), "coarse");
}
