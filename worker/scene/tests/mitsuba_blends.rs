//! Blends of blends in Mitsuba scenes are read or refused by element.

#[allow(dead_code)]
mod common;

use common::{alike, conductor, lambertian, parts};
use picofarm_scene::{
    Bsdf, Distribution, Lobe, Material, Part, Scene, SceneError, SpectrumPoint, import::read_scene,
};
use proptest::prelude::*;

/// Reads a wall with a BSDF with the id `m`. The images `a.png` and `b.png`, with other texels, are
/// in the same folder.
fn read(bsdf: &str) -> Result<Scene, SceneError> {
    let text = format!(
        r#"<scene version="3.0.0">
    <sensor type="perspective"><float name="fov" value="90"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
    <emitter type="projector"><float name="fov" value="0.1"/>
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform></emitter>
    {bsdf}
    <shape type="rectangle"><ref id="m"/></shape>
</scene>"#
    );
    let folder = tempfile::tempdir().expect("a folder");
    for (name, texel) in [("a.png", [10, 200, 30]), ("b.png", [200, 10, 30])] {
        let image = image::RgbImage::from_pixel(2, 2, image::Rgb(texel));
        image.save(folder.path().join(name)).expect("writes");
    }
    let path = folder.path().join("scene.xml");
    std::fs::write(&path, text).expect("writes");
    read_scene(&path)
}

fn material_of(scene: &Scene) -> &Material {
    &scene.objects[0].mesh.materials[0]
}

fn material(bsdf: &str) -> Material {
    material_of(&read(bsdf).expect("reads")).clone()
}

fn blend(weight: f32, a: &str, b: &str) -> String {
    format!(r#"<bsdf type="blendbsdf"><float name="weight" value="{weight}"/>{a}{b}</bsdf>"#)
}

/// Returns the outermost element with the id that the wall refers to.
fn named(bsdf: &str) -> String {
    bsdf.replacen("<bsdf ", "<bsdf id=\"m\" ", 1)
}

fn diffuse(rgb: &str) -> String {
    format!(r#"<bsdf type="diffuse"><rgb name="reflectance" value="{rgb}"/></bsdf>"#)
}

fn metal(alpha: f32, rgb: &str) -> String {
    format!(
        r#"<bsdf type="roughconductor"><string name="material" value="none"/><string name="distribution" value="ggx"/>
        <float name="alpha" value="{alpha}"/><rgb name="specular_reflectance" value="{rgb}"/></bsdf>"#
    )
}

fn by_wavelength(bsdf: &str, values: &str) -> String {
    let start = bsdf.find("<rgb").expect("a colour");
    let text = bsdf[start..].replace("<rgb", "<spectrum");
    let value = text.find("value=").expect("a value");
    format!(
        "{}{}value=\"{values}\"/></bsdf>",
        &bsdf[..start],
        &text[..value]
    )
}

fn textured(bsdf: &str, file: &str) -> String {
    let start = bsdf.find("<rgb").expect("a colour");
    let name = if bsdf.contains("specular") {
        "specular_reflectance"
    } else {
        "reflectance"
    };
    format!(
        r#"{}<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/></texture></bsdf>"#,
        &bsdf[..start]
    )
}

#[test]
fn a_blend_of_blends_has_the_shares_of_their_products() {
    let inner = blend(0.25, &metal(0.2, "0.9"), &diffuse("0.2 0.4 0.6"));
    let outer = blend(
        0.5,
        &diffuse("0.5"),
        &blend(0.5, &inner, &metal(0.05, "0.6")),
    );
    let both = format!("<bsdf type=\"twosided\">{outer}</bsdf>");
    for (bsdf, two_sided) in [(outer, false), (both, true)] {
        let m = material(&named(&bsdf));
        let expected = [
            lambertian(0.5, 0.5),
            conductor(0.1875, 0.2, 0.9),
            lambertian(0.0625, 0.4),
            conductor(0.25, 0.05, 0.6),
        ];
        alike(&parts(&m), &expected);
        assert_eq!(m.two_sided, two_sided);
        let all: f32 = expected
            .iter()
            .map(|p| p.weight * p.lobe.reflectance())
            .sum();
        assert!((m.rgb.iter().sum::<f32>() / 3.0 - all).abs() < 1e-6);
        assert!(
            (m.rgb[2] - m.rgb[0] - 0.0625 * 0.4).abs() < 1e-6,
            "{:?}",
            m.rgb
        );
    }
}

#[test]
fn two_lambertians_and_two_conductors_are_read_too() {
    let m = material(&named(&blend(0.25, &diffuse("0.2"), &diffuse("0.6"))));
    alike(&parts(&m), &[lambertian(0.75, 0.2), lambertian(0.25, 0.6)]);
    let m = material(&named(&blend(0.25, &metal(0.1, "0.8"), &metal(0.4, "0.8"))));
    alike(
        &parts(&m),
        &[conductor(0.75, 0.1, 0.8), conductor(0.25, 0.4, 0.8)],
    );
}

#[test]
fn what_is_one_part_or_one_of_each_stays_what_it_was() {
    let (d, c) = (diffuse("0.2 0.4 0.6"), metal(0.2, "0.7"));
    let pair = blend(0.3, &d, &c);
    let plain = material(&named(&pair));
    let expected = Bsdf::Mixed {
        reflectance: (0.2 + 0.4 + 0.6) / 3.0,
        alpha: 0.2,
        distribution: Distribution::Ggx,
        specular_reflectance: 0.7,
        weight: 0.3,
    };
    assert_eq!(plain.bsdf, expected);
    // Equal parts are merged, and parts without a share are dropped.
    for tree in [
        blend(0.5, &pair, &pair),
        blend(0.0, &pair, &diffuse("0.9")),
        blend(1.0, &blend(0.5, &metal(0.4, "1"), &diffuse("1")), &pair),
    ] {
        assert_eq!(material(&named(&tree)).bsdf, expected, "{tree}");
    }
    for (tree, bsdf) in [
        (blend(0.5, &d, &d), &d),
        (blend(0.0, &c, &metal(0.4, "1")), &c),
        (blend(1.0, &blend(0.5, &d, &metal(0.4, "1")), &c), &c),
    ] {
        let (found, alone) = (material(&named(&tree)), material(&named(bsdf)));
        assert_eq!((found.bsdf, found.rgb), (alone.bsdf, alone.rgb), "{tree}");
    }
    // A mix in which one part has no share remains a mix.
    let m = material(&named(&blend(0.0, &d, &c)));
    assert!(matches!(m.bsdf, Bsdf::Mixed { weight: 0.0, .. }));
    let m = material(&named(&blend(0.3, &c, &d)));
    assert!(matches!(m.bsdf, Bsdf::Mixed { weight, .. } if weight == 1.0 - 0.3));
}

#[test]
fn what_differs_in_hue_or_sides_is_noted() {
    let notes = |bsdf: &str| read(&named(bsdf)).expect("reads").provenance.notes;
    let grey = notes(&blend(0.5, &diffuse("0.2"), &diffuse("0.6")));
    assert!(
        !grey.keys().any(|k| k.starts_with("import.blends")),
        "{grey:?}"
    );
    let hues = notes(&blend(0.5, &diffuse("0.2 0.1 0.1"), &diffuse("0.6")));
    assert!(hues.contains_key("import.blends.hues"));
    let both = format!("<bsdf type=\"twosided\">{}</bsdf>", diffuse("0.2"));
    let half = read(&named(&blend(0.5, &both, &diffuse("0.6")))).expect("reads");
    assert!(!material_of(&half).two_sided);
    assert!(half.provenance.notes.contains_key("import.blends.sides"));
}

#[test]
fn one_bitmap_scales_all_parts() {
    let d = textured(&diffuse("1"), "a.png");
    let metals = [0.1, 0.4].map(|alpha| textured(&metal(alpha, "1"), "a.png"));
    let tree = blend(0.5, &d, &blend(0.5, &metals[0], &metals[1]));
    let expected = [
        lambertian(0.5, 1.0),
        conductor(0.25, 0.1, 1.0),
        conductor(0.25, 0.4, 1.0),
    ];
    alike(&parts(&material(&named(&tree))), &expected);
    // A black part has no texture to scale.
    let dark = blend(0.5, &tree, &diffuse("0"));
    let halved = expected.map(|p| Part {
        weight: p.weight / 2.0,
        ..p
    });
    alike(&parts(&material(&named(&dark))), &halved);
}

fn row(nm: f32, reflectance: f32, specular: Option<f32>) -> SpectrumPoint {
    SpectrumPoint {
        nm,
        reflectance,
        specular_reflectance: specular,
    }
}

#[test]
fn lambertians_of_several_spectra_are_one_of_their_mean() {
    let (a, b) = (
        by_wavelength(&diffuse(""), "400:0, 800:1"),
        by_wavelength(&diffuse(""), "500:1, 600:0.5"),
    );
    let m = material(&named(&blend(0.25, &a, &b)));
    assert!(matches!(m.bsdf, Bsdf::Diffuse { .. }));
    let expected = [
        row(400.0, 0.25, None),
        row(500.0, 0.4375, None),
        row(600.0, 0.5, None),
        row(800.0, 0.875, None),
    ];
    assert_eq!(m.spectrum, expected);
    let m = material(&named(&blend(
        0.5,
        &metal(0.2, "0.7"),
        &blend(0.25, &a, &b),
    )));
    assert!(
        matches!(m.bsdf, Bsdf::Mixed { weight: 0.5, .. }),
        "{:?}",
        m.bsdf
    );
    assert_eq!(m.spectrum, expected);
}

#[test]
fn several_parts_have_one_spectrum_of_lambertians_and_one_of_conductors() {
    let d = by_wavelength(&diffuse(""), "400:0, 600:0.5");
    let c = |alpha, values: &str| by_wavelength(&metal(alpha, ""), values);
    let two = |values: &str| blend(0.5, &c(0.1, values), &c(0.4, values));
    let m = material(&named(&blend(0.5, &d, &two("500:0.25"))));
    let expected = [
        row(400.0, 0.0, Some(0.25)),
        row(500.0, 0.25, Some(0.25)),
        row(600.0, 0.5, Some(0.25)),
    ];
    assert_eq!(m.spectrum, expected);
    for (part, r) in parts(&m).iter().zip([0.25, 0.25, 0.25]) {
        let at = m.part(part).at(500.0);
        assert_eq!(at.lambertian + at.conductor, r);
    }
    let m = material(&named(&two("500:0.25, 600:0.75")));
    assert_eq!(parts(&m).len(), 2);
    assert!(
        parts(&m)
            .iter()
            .all(|p| m.part(p).at(550.0).conductor == 0.5)
    );
    // Conductors without spectra retain their reflectance.
    let m = material(&named(&blend(
        0.5,
        &d,
        &blend(0.5, &metal(0.1, "0.8"), &metal(0.4, "0.6")),
    )));
    let at: Vec<f32> = parts(&m)
        .iter()
        .map(|p| m.part(p).at(600.0))
        .map(|a| a.lambertian + a.conductor)
        .collect();
    assert_eq!(at, [0.5, 0.8, 0.6]);
}

#[test]
fn blends_that_cannot_be_are_refused_by_element() {
    let nine = (0..9).fold(diffuse("0"), |tree, k| match k % 2 {
        0 => blend(0.5, &metal(0.1 + 0.05 * k as f32, "1"), &tree),
        _ => tree,
    });
    let nine = blend(
        0.5,
        &nine,
        &(1..5).fold(diffuse("0"), |tree, k| {
            blend(0.5, &diffuse(&format!("0.{k}")), &tree)
        }),
    );
    let deep = (0..9).fold(diffuse("0.5"), |tree, _| blend(0.5, &tree, &diffuse("0.2")));
    let c = |alpha, values: &str| by_wavelength(&metal(alpha, ""), values);
    let picture = textured(&diffuse("1"), "a.png");
    for (bsdf, expected) in [
        (
            nine,
            "line 7, <bsdf type=\"blendbsdf\">: has 9 different parts, expected 8 at most",
        ),
        (deep, "nested deeper than 8"),
        (
            blend(
                0.5,
                &diffuse("1"),
                &blend(1.5, &diffuse("0"), &metal(0.1, "1")),
            ),
            "weight: 1.5 lies outside [0, 1]",
        ),
        (
            blend(0.5, &diffuse("1"), &blend(0.5, &diffuse("0"), "")),
            "expected two BSDFs, found 1",
        ),
        (
            blend(0.0, &diffuse("1"), "<bsdf type=\"plastic\"/>"),
            "bsdf \"plastic\" is not supported",
        ),
        (
            blend(0.5, &diffuse("1"), "<bsdf type=\"thindielectric\"/>"),
            "thindielectric by itself",
        ),
        (
            blend(0.5, &picture, &diffuse("0.5")),
            "give all the same bitmap",
        ),
        (
            blend(0.5, &picture, &textured(&diffuse("1"), "b.png")),
            "give all the same bitmap",
        ),
        (
            blend(0.5, &c(0.1, "500:0.5"), &c(0.2, "500:0.6")),
            "give all the same <spectrum>, or none",
        ),
        (
            blend(0.5, &c(0.1, "500:0.5"), &metal(0.2, "0.5")),
            "conductors of one blend differ in their spectra",
        ),
        (
            blend(0.5, "<ref id=\"m\"/>", &diffuse("0.5")),
            "nested deeper than 8",
        ),
    ] {
        let error = read(&named(&bsdf)).expect_err(expected).to_string();
        assert!(
            error.contains("scene.xml: line ") && error.contains(expected),
            "{error}"
        );
    }
}

/// A tree of blends over leaves with distinct numbers.
#[derive(Debug, Clone)]
enum Tree {
    Leaf(bool),
    Blend(f32, Box<Tree>, Box<Tree>),
}

fn tree() -> impl Strategy<Value = Tree> {
    let leaf = any::<bool>().prop_map(Tree::Leaf);
    leaf.prop_recursive(7, 15, 2, |inner| {
        let weight = prop_oneof![0.0f32..=1.0, Just(0.0), Just(1.0)];
        (weight, inner.clone(), inner).prop_map(|(w, a, b)| Tree::Blend(w, a.into(), b.into()))
    })
}

impl Tree {
    /// Returns the tree's text; its leaves with their shares are added to `leaves`.
    fn text(&self, share: f64, leaves: &mut Vec<Part>) -> String {
        match self {
            Tree::Leaf(is_metal) => {
                let number = 0.1 + 0.02 * leaves.len() as f32;
                let (part, text) = match is_metal {
                    true => (conductor(share as f32, number, 0.5), metal(number, "0.5")),
                    false => (
                        lambertian(share as f32, number),
                        diffuse(&number.to_string()),
                    ),
                };
                leaves.push(part);
                text
            }
            Tree::Blend(weight, a, b) => {
                let w = f64::from(*weight);
                let a = a.text(share * (1.0 - w), leaves);
                blend(*weight, &a, &b.text(share * w, leaves))
            }
        }
    }
}

proptest! {
    #[test]
    fn shares_are_the_products_of_weights_and_sum_to_1(tree in tree()) {
        let mut leaves = Vec::new();
        let text = named(&tree.text(1.0, &mut leaves));
        leaves.retain(|p| p.weight > 0.0);
        let read = read(&text);
        if leaves.len() > 8 {
            let error = read.expect_err("too many parts").to_string();
            prop_assert!(error.contains("different parts, expected 8 at most"), "{}", error);
            return Ok(());
        }
        let scene = read.expect("reads");
        let m = material_of(&scene);
        let found = match m.bsdf {
            Bsdf::Several { parts } => parts.list().to_vec(),
            Bsdf::Mixed { reflectance, alpha, specular_reflectance, weight, .. } => {
                let mut two = vec![lambertian(1.0 - weight, reflectance), conductor(weight, alpha, specular_reflectance)];
                two.retain(|p| p.weight > 0.0);
                if leaves.first().is_some_and(|p| matches!(p.lobe, Lobe::RoughConductor { .. })) {
                    two.reverse();
                }
                two
            }
            Bsdf::Diffuse { reflectance } => vec![lambertian(1.0, reflectance)],
            Bsdf::RoughConductor { alpha, reflectance, .. } => vec![conductor(1.0, alpha, reflectance)],
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => unreachable!("no leaf is glass"),
        };
        alike(&found, &leaves);
        let sum: f32 = found.iter().map(|p| p.weight).sum();
        prop_assert!((sum - 1.0).abs() < 1e-5);
        let albedo: f32 = found.iter().map(|p| p.weight * p.lobe.reflectance()).sum();
        prop_assert!(m.rgb.iter().all(|c| (c - albedo).abs() < 1e-5));
    }
}
