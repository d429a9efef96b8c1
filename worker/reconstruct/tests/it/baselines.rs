//! The baseline methods.

use crate::common;

use common::{measured, room, small};
use picofarm_reconstruct::{
    Settings, World,
    baseline::{Behind, bounce_flash, depth_alone},
    render::Renderer,
    score::score_views,
};
use picofarm_scene::plato::{self, PlatoObject};

#[test]
fn carving_finds_a_hidden_box_better_than_a_depth_map_does() {
    let (scene, rendered) = room(PlatoObject::HiddenBox, 16, 96);
    let measured = measured(&scene, &rendered);
    let world = World::new(&scene);
    let views: Vec<_> = plato::views(32).into_iter().skip(45).step_by(9).collect();
    let settings = small();
    let score = |field| score_views(&Renderer::new(&field), &scene.camera, &world, &views);
    let carved = score(bounce_flash(&measured, settings.nodes).unwrap());
    let empty = score(depth_alone(&measured, &settings, Behind::Empty).unwrap());
    let solid = score(depth_alone(&measured, &settings, Behind::Solid).unwrap());
    let objects = [&carved, &empty, &solid].map(|s| s.occluded_objects.l1_m);
    assert!(objects[0] < objects[1], "{objects:?}");
    assert!(solid.occluded.l1_m > carved.occluded.l1_m);
}

#[test]
fn unusable_input_is_refused_by_name() {
    let (scene, rendered) = room(PlatoObject::Empty, 4, 16);
    let mut measured = measured(&scene, &rendered);
    let few = bounce_flash(&measured, 2).unwrap_err().to_string();
    assert!(few.contains("nodes"), "{few}");
    measured.spots.clear();
    let none = depth_alone(&measured, &Settings::default(), Behind::Solid);
    let none = none.unwrap_err().to_string();
    assert!(none.contains("spots"), "{none}");
}
