//! Primitive rooms: reproducible, complete, and usable by the renderer.

use picofarm_scene::{
    SceneError, export,
    primitive::{self, PrimitiveSettings},
};

fn small() -> PrimitiveSettings {
    PrimitiveSettings {
        width: 64,
        height: 64,
        ..PrimitiveSettings::default()
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_does_not() {
    let bytes = |seed| {
        let scene = primitive::generate(seed, &small()).expect("ordinary seeds succeed");
        export::glb_bytes(&scene).expect("generated scenes are valid")
    };
    assert_eq!(bytes(11), bytes(11));
    assert_ne!(bytes(11), bytes(12));
}

#[test]
fn forty_seeds_give_a_cube_a_cylinder_and_a_mirror() {
    for seed in 0..40 {
        let scene = primitive::generate(seed, &small()).expect("ordinary seeds succeed");
        scene.validate().expect("generated scenes are valid");
        let labels: Vec<&str> = scene
            .objects
            .iter()
            .map(|o| scene.labels[usize::from(o.label)].as_str())
            .collect();
        assert_eq!(labels[6..], ["cube", "cylinder", "mirror"], "seed {seed}");
        assert_eq!(scene.laser.beams.len(), 25);
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    for (settings, field) in [
        (
            PrimitiveSettings {
                spots: 9,
                ..small()
            },
            "spots",
        ),
        (
            PrimitiveSettings {
                width: 0,
                ..small()
            },
            "width and height",
        ),
        (
            PrimitiveSettings {
                fov_deg: 179.0,
                ..small()
            },
            "fov_deg",
        ),
    ] {
        match primitive::generate(0, &settings) {
            Err(SceneError::Invalid { field: f, .. }) => assert_eq!(f, field),
            other => panic!("expected a refusal of {field}, got {other:?}"),
        }
    }
}
