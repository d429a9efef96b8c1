//! Scenes in job files: three forms of spots, two sizes of rooms, and the dependencies of keys.

use std::collections::BTreeSet;

use picofarm_proto::{
    key::{StageKey, stage_key, task_key},
    spec::{
        JobSpec, PrimitiveRooms, RenderSettings, SceneKind, SceneSource, Spots, StageSpec, TaskSpec,
    },
    wire,
};

fn read(scenes: &str) -> Result<JobSpec, String> {
    let text = format!(
        "name = \"test\"\n[scenes]\ncount = 3\n{scenes}\n[render]\nresolution = 16\nsamples = 4\nrenderer = \"r\"\n\
         [output]\nstore = \"/store\"\ndataset = \"rooms\"\n"
    );
    let spec: JobSpec = toml::from_str(&text).map_err(|e| e.to_string())?;
    spec.check().map_err(|e| e.to_string())?;
    Ok(spec)
}

fn scenes(text: &str) -> SceneSource {
    let spec = read(text).unwrap_or_else(|e| panic!("{text}: {e}"));
    let TaskSpec::Render(task) = &spec.stages[0].task else {
        unreachable!("the job renders");
    };
    task.scenes.clone()
}

fn key(text: &str) -> StageKey {
    stage_key(&read(text).unwrap().stages[0])
}

/// Scenes that all differ.
const ALL: [&str; 9] = [
    "kind = \"primitive\"",
    "kind = \"primitive\"\nspots = 16",
    "kind = \"primitive\"\nspots = { random = 16 }",
    "kind = \"primitive\"\nspots = { at = [[0.5, 0.5], [0.25, 0.75]] }",
    "kind = \"primitive\"\nspots = { at = [[0.25, 0.75], [0.5, 0.5]] }",
    "kind = \"primitive\"\nlaser_m = [0.1, 0.0, 0.0]",
    "kind = \"primitive\"\nrooms = { mirror_wall = \"back\" }",
    "kind = \"desktop\"",
    "kind = \"desktop\"\nrooms = { cube = { width_m = [0.1, 0.1], height_m = [0.1, 0.1] } }",
];

#[test]
fn what_is_said_of_scenes_comes_back_from_wire_and_catalog_and_each_has_a_key_of_its_own() {
    let mut keys = BTreeSet::new();
    for text in ALL {
        let spec = read(text).unwrap_or_else(|e| panic!("{text}: {e}"));
        let back = JobSpec::try_from(wire::JobSpec::from(spec.clone())).unwrap();
        assert_eq!(back, spec, "{text}");
        let stored = serde_json::to_string(&spec).unwrap();
        assert_eq!(serde_json::from_str::<JobSpec>(&stored).unwrap(), spec);
        keys.insert(key(text).to_string());
    }
    assert_eq!(keys.len(), ALL.len());
}

#[test]
fn what_is_left_out_is_what_the_kind_has() {
    let desktop = scenes("kind = \"desktop\"");
    assert_eq!(
        (desktop.fov_deg, desktop.spots),
        (Some(46.0), Spots::Grid(16))
    );
    let rooms = PrimitiveRooms::DESKTOP;
    assert_eq!(desktop.kind, SceneKind::Primitive { rooms });
    let some = scenes("kind = \"desktop\"\nspots = 4\nrooms = { depth_m = [0.2, 1.2] }");
    let rooms = PrimitiveRooms {
        depth_m: [0.2, 1.2],
        ..PrimitiveRooms::DESKTOP
    };
    assert_eq!(some.kind, SceneKind::Primitive { rooms });
    // The same settings written in full give the same key.
    let full = "kind = \"primitive\"\nspots = 25\nfov_deg = 90\nlaser_m = [0, 0, 0]\nrooms = { scale = [0.8, 1.15] }";
    assert_eq!(key(full), key("kind = \"primitive\""));
}

#[test]
fn what_cannot_be_used_is_named() {
    for (text, parts) in [
        (
            "kind = \"files\"\nfiles = [\"/a.glb\", \"/b.glb\", \"/c.glb\"]\nlaser_m = [0.1, 0, 0]",
            ["scenes.laser_m", "generated"],
        ),
        (
            "kind = \"primitive\"\nrooms = { walls = 3 }",
            ["walls", "mirror_wall"],
        ),
        (
            "kind = \"desktop\"\nrooms = { depth_m = [2.0, 1.0] }",
            ["scenes.rooms.depth_m", "the lesser first"],
        ),
        (
            "kind = \"desktop\"\nrooms = { fov_jitter_deg = 46 }",
            ["scenes.rooms.fov_jitter_deg", "46"],
        ),
        (
            "kind = \"desktop\"\nrooms = { mirror_wall = \"front\" }",
            ["front", "`back`"],
        ),
        (
            "kind = \"primitive\"\nspots = { random = 4, at = [[0.5, 0.5]] }",
            ["spots", "one of random and at"],
        ),
    ] {
        let said = read(text).expect_err(text);
        for part in parts {
            assert!(said.contains(part), "{text}: {part:?} is not in {said}");
        }
    }
}

#[test]
fn networks_that_know_spots_by_number_are_refused_where_spots_are_at_random() {
    let job = |spots: &str, variant: &str| {
        let text = format!(
            "name = \"n\"\n[[stage]]\nname = \"rooms\"\nscenes = {{ kind = \"desktop\", count = 3, spots = {spots} }}\n\
             output = {{ store = \"/s\", dataset = \"rooms\" }}\n\
             [[stage]]\nname = \"noisy\"\nkind = \"reprocess\"\nsource = \"rooms\"\nreprocess = {{ seed = 1 }}\n\
             output = {{ store = \"/s\", dataset = \"noisy\", profile = \"counts-u16\" }}\n\
             [[stage]]\nname = \"split\"\nkind = \"split\"\nsource = \"noisy\"\nsplit = {{ counts = [1, 1, 1] }}\n\
             [[stage]]\nname = \"train\"\nkind = \"train\"\nsource = \"noisy\"\n\
             train = {{ target = \"shadow\", model = \"m\", shadow = {{ variant = \"{variant}\" }} }}\n"
        );
        let spec: JobSpec = toml::from_str(&text).unwrap();
        spec.check().map_err(|e| e.to_string())
    };
    for variant in ["index", "all"] {
        let said = job("{ random = 4 }", variant).unwrap_err();
        assert!(
            said.contains("train.shadow.variant") && said.contains("other places"),
            "{said}"
        );
        job("4", variant).unwrap();
        job("{ at = [[0.5, 0.5], [0.1, 0.2]] }", variant).unwrap();
    }
    job("{ random = 4 }", "concat").unwrap();
}

#[test]
fn a_scene_of_a_file_is_named_by_its_own_file_and_position_and_by_no_other_file() {
    let stage = |files: [&str; 3], more: &str| {
        let listed: Vec<String> = files
            .iter()
            .map(|sha| {
                format!(
                    "{{ path = \"/{sha}.glb\", sha256 = \"{}\" }}",
                    sha.repeat(64)
                )
            })
            .collect();
        let text = format!("kind = \"files\"\nfiles = [{}]\n{more}", listed.join(", "));
        read(&text).unwrap().stages[0].clone()
    };
    let (before, after) = (stage(["a", "b", "c"], ""), stage(["a", "d", "c"], ""));
    let keys = |stage: &StageSpec| [0, 1, 2].map(|i| stage.task.scene_key(i).unwrap());
    let (were, are) = (keys(&before), keys(&after));
    assert_ne!(stage_key(&before), stage_key(&after), "two sets of results");
    assert_eq!((were[0], were[2]), (are[0], are[2]));
    assert_ne!(were[1], are[1]);
    assert_eq!(before.task.files_key(), after.task.files_key());
    // The same content in another position has its own spots, and other settings make another
    // scene.
    assert_ne!(keys(&stage(["b", "b", "b"], ""))[0], were[1]);
    let other = stage(["a", "b", "c"], "spots = 4");
    assert_ne!(keys(&other), were);
    assert_ne!(other.task.files_key(), before.task.files_key());
    // A lease of one scene knows its key, and none of a scene that it does not list.
    let leased = before.only(1, 2);
    assert_eq!(leased.task.scene_key(1), Some(were[1]));
    assert_eq!(leased.task.scene_key(0), None);
    assert_eq!(leased.task.files_key(), before.task.files_key());
    // Scenes that are made have the keys that they always had.
    let made = read(ALL[0]).unwrap().stages[0].clone();
    assert_eq!(made.task.scene_key(2), Some(task_key(&stage_key(&made), 2)));
    assert_eq!(made.task.files_key(), None);
}

#[test]
fn files_have_the_options_of_the_command_line_and_other_kinds_do_not() {
    let files = "kind = \"files\"\nfiles = [\"models/*.glb\", \"b\", \"c.glb\"]\n";
    let view = "camera = \"0\"\nlook_from = [0, 1.5, 4]\nlook_at = [0, 1, 0]\nup = [0, 0, 1]\nfov_deg = 40\nunit = \"mm\"\nreplace_laser = true\n";
    let source = scenes(&format!("{files}{view}"));
    let again: SceneSource =
        serde_json::from_value(serde_json::to_value(&source).unwrap()).unwrap();
    assert_eq!(again, source);
    let SceneKind::Files { view, .. } = &source.kind else {
        panic!("files stay files");
    };
    assert_eq!(view.look_from, Some([0.0, 1.5, 4.0]));
    // Spots that the job does not state are spread over what the camera sees.
    assert!(view.spread_spots);
    let stated = scenes(&format!("{files}spots = 25"));
    assert!(matches!(&stated.kind, SceneKind::Files { view, .. } if !view.spread_spots));
    for (field, text) in [
        (
            "scenes.look_at",
            "look_from = [0, 0, 0]\nlook_at = [0, 0, 0]",
        ),
        ("scenes.up", "up = [0, 0, 0]"),
        ("scenes.unit", "unit = \"furlong\""),
        ("scenes.fov_deg", "fov_deg = 175"),
        ("scenes.spread_spots", "spots = 4\nspread_spots = true"),
    ] {
        let said = read(&format!("{files}{text}")).unwrap_err();
        assert!(said.contains(field), "{field}: {said}");
    }
    let said = read("kind = \"primitive\"\nlook_at = [0, 0, 0]").unwrap_err();
    assert!(
        said.contains("scenes.look_at") && said.contains("files"),
        "{said}"
    );
}

#[test]
fn a_view_names_other_scenes_and_its_absence_the_old_ones() {
    let file = format!("{{ path = \"/a.glb\", sha256 = \"{}\" }}", "a".repeat(64));
    let stage = |more: &str| {
        let text = format!("kind = \"files\"\nfiles = [{file}, {file}, {file}]\nspots = 4\n{more}");
        stage_key(&read(&text).unwrap().stages[0])
    };
    let keys = [
        "",
        "look_at = [0, 0, 0]",
        "fov_deg = 90",
        "fov_deg = 60",
        "unit = \"m\"",
        "replace_laser = true",
    ];
    let keys = keys.map(stage);
    for (k, key) in keys.iter().enumerate() {
        assert!(!keys[..k].contains(key), "{k}");
    }
}

#[test]
fn a_gate_is_stated_in_one_of_two_forms_and_an_automatic_one_needs_files() {
    let render = |text: &str| toml::from_str::<RenderSettings>(text).map_err(|e| e.to_string());
    let stated = render("gate = [2, 12]\nbins = 100").unwrap();
    assert_eq!(
        (stated.gate_start_m, stated.bin_width_m, stated.bins),
        (2.0, 0.1, 100)
    );
    let auto = render("gate = \"auto\"").unwrap();
    assert!(auto.fit_gate);
    let again = serde_json::from_value(serde_json::to_value(&auto).unwrap());
    assert_eq!(auto, again.unwrap());
    for wrong in [
        "gate = \"automatic\"",
        "gate = [12, 2]",
        "gate = [1, 25]\nbin_width_m = 0.1",
        "gate = \"auto\"\ngate_start_m = 0.5",
    ] {
        let said = render(wrong).unwrap_err();
        assert!(said.contains("render.gate"), "{wrong}: {said}");
    }
    let mut spec = read("kind = \"primitive\"").unwrap();
    let TaskSpec::Render(task) = &mut spec.stages[0].task else {
        unreachable!("the job renders");
    };
    task.render.fit_gate = true;
    let said = spec.check().unwrap_err().to_string();
    assert!(
        said.contains("render.gate") && said.contains("files"),
        "{said}"
    );
}
