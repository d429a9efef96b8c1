//! Materials of several parts are restored from our Mitsuba scenes, exactly with our comment, and
//! in their shares without it.

#[allow(dead_code)]
mod common;

use std::sync::Arc;

use common::{alike, conductor, lambertian, parts};
use picofarm_scene::{Bsdf, Material, Part, Parts, Scene, SceneError, export, import::read_scene};

fn materials(scene: &Scene) -> Vec<Material> {
    let all = scene.objects.iter().flat_map(|o| &o.mesh.materials);
    all.cloned().collect()
}

#[test]
fn several_parts_of_an_exported_scene_come_back_exactly() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let scene = common::parted_room();
    let notes = export::write_mitsuba(&scene, &path).expect("writes");
    assert!(
        notes.iter().any(|n| n.contains("its spectrum stands")),
        "{notes:?}"
    );
    let back = read_scene(&path).expect("reads");
    assert_eq!(materials(&back), materials(&scene));
    assert_eq!(back.provenance, scene.provenance);
}

/// Returns the scene without our comment, as other programs read it.
fn without_comment(scene: &Scene) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    export::write_mitsuba(scene, &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    let plain: Vec<&str> = text.lines().filter(|l| !l.starts_with("<!--")).collect();
    std::fs::write(&path, plain.join("\n")).expect("writes");
    read_scene(&path)
}

#[test]
fn without_our_comment_several_parts_have_the_same_shares() {
    let mut scene = common::parted_room();
    // Its parts have different reflectances and therefore separate images.
    let error = without_comment(&scene)
        .expect_err("two textures")
        .to_string();
    assert!(error.contains("same bitmap"), "{error}");
    scene.objects.remove(2);
    let back = without_comment(&scene).expect("reads");
    for (k, (a, b)) in back.objects.iter().zip(&scene.objects).take(4).enumerate() {
        let (a, b) = (&a.mesh.materials[0], &b.mesh.materials[0]);
        // The scale of a texture is contained in its image.
        let scaled = |part: Part| match b.texture {
            Some(_) => common::with_reflectance(part, 1.0),
            None => part,
        };
        let expected: Vec<Part> = parts(b).into_iter().map(scaled).collect();
        alike(&parts(a), &expected);
        assert_eq!(
            (a.two_sided, a.texture.is_some()),
            (b.two_sided, b.texture.is_some()),
            "{k}"
        );
    }
}

#[test]
fn every_reflectance_of_a_textured_material_has_an_image_of_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    export::write_mitsuba(&common::parted_room(), &path).expect("writes");
    let texel = |name: &str| {
        let file = folder.path().join("textures").join(name);
        image::open(file)
            .ok()
            .map(|i| i.into_rgb8().get_pixel(3, 3).0)
    };
    assert!(texel("material2-part0.png").is_some());
    assert!(texel("material2-part1.png").is_some());
    assert_ne!(texel("material2-part0.png"), texel("material2-part1.png"));
    assert!(texel("material0-part0.png").is_some());
    for shared in [
        "material0-part1.png",
        "material0-part2.png",
        "material2-part2.png",
    ] {
        assert_eq!(texel(shared), None, "{shared}");
    }
}

#[test]
fn every_number_of_parts_with_and_without_a_missing_share_is_read_from_its_text() {
    for count in 1..=8 {
        for sum in [1.0, 0.5, 0.0] {
            for two_sided in [false, true] {
                let mut scene = common::textured_room();
                let all = (0..count).map(|k| match k % 3 {
                    1 => conductor(sum / count as f32, 0.1 * k as f32, 0.5),
                    _ => lambertian(sum / count as f32, 0.1 * (k + 1) as f32),
                });
                let all: Vec<Part> = all.collect();
                let material = &mut Arc::make_mut(&mut scene.objects[0].mesh).materials[0];
                *material = Material {
                    bsdf: Bsdf::Several {
                        parts: Parts::of(&all).expect("8 at most"),
                    },
                    two_sided,
                    ..Material::diffuse("parts", [0.5; 3])
                };
                scene.objects.truncate(1);
                let back = without_comment(&scene).expect("reads");
                let found = &back.objects[0].mesh.materials[0];
                assert_eq!(found.two_sided, two_sided);
                match (found.bsdf, count) {
                    (Bsdf::Diffuse { reflectance }, _) if sum == 0.0 => {
                        assert_eq!(reflectance, 0.0)
                    }
                    (Bsdf::Diffuse { reflectance }, 1) => assert!((reflectance - 0.1).abs() < 1e-6),
                    (Bsdf::Mixed { weight, .. }, 2) => assert_eq!((weight, sum), (0.5, 1.0)),
                    _ => alike(&parts(found), &all),
                }
            }
        }
    }
}
