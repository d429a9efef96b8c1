//! Blends of blends in Mitsuba scenes are read or refused by element.

use picofarm_scene::{
    Bsdf, Distribution, Material, Scene, SceneError, SpectrumPoint, import::read_scene,
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

/// Reflectances of the Lambertian and of the conductor, roughness, and share of the conductor.
fn mixed(m: &Material) -> [f32; 4] {
    match m.bsdf {
        Bsdf::Mixed {
            reflectance,
            alpha,
            specular_reflectance,
            weight,
            ..
        } => [reflectance, specular_reflectance, alpha, weight],
        other => panic!("expected a mix, found {other:?}"),
    }
}

fn alike(found: &[f32], expected: &[f32]) {
    let close = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-6;
    assert!(
        found.iter().zip(expected).all(close),
        "{found:?} {expected:?}"
    );
}

#[test]
fn a_blend_of_blends_has_the_shares_of_their_products() {
    let inner = blend(0.25, &metal(0.2, "0.9"), &diffuse("0.2 0.4 0.6"));
    let outer = blend(
        0.5,
        &diffuse("0.5"),
        &blend(0.5, &inner, &metal(0.2, "0.6")),
    );
    let both = format!("<bsdf type=\"twosided\">{outer}</bsdf>");
    for (bsdf, two_sided) in [(outer, false), (both, true)] {
        let m = material(&named(&bsdf));
        // Shares: 0.5 and 0.0625 of Lambertians, 0.1875 and 0.25 of conductors.
        let lambertian = (0.5 * 0.5 + 0.0625 * 0.4) / 0.5625;
        let conductor = (0.1875 * 0.9 + 0.25 * 0.6) / 0.4375;
        alike(&mixed(&m), &[lambertian, conductor, 0.2, 0.4375]);
        assert_eq!(m.two_sided, two_sided);
        let all = 0.5625 * lambertian + 0.4375 * conductor;
        alike(&[m.rgb.iter().sum::<f32>() / 3.0], &[all]);
        alike(&[m.rgb[2] - m.rgb[0]], &[0.0625 * 0.4]);
    }
}

#[test]
fn parts_that_differ_in_colour_alone_are_one_of_their_mean() {
    let m = material(&named(&blend(0.25, &diffuse("0.2"), &diffuse("0.6"))));
    let Bsdf::Diffuse { reflectance } = m.bsdf else {
        panic!("{:?}", m.bsdf);
    };
    alike(&[reflectance], &[0.3]);
    let m = material(&named(&blend(0.25, &metal(0.1, "0.8"), &metal(0.1, "0.4"))));
    let Bsdf::RoughConductor {
        alpha, reflectance, ..
    } = m.bsdf
    else {
        panic!("{:?}", m.bsdf);
    };
    alike(&[alpha, reflectance], &[0.1, 0.7]);
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
fn one_bitmap_scales_both_parts() {
    let d = textured(&diffuse("1"), "a.png");
    let c = textured(&metal(0.1, "1"), "a.png");
    let tree = blend(0.5, &d, &blend(0.5, &d, &c));
    let m = material(&named(&tree));
    alike(&mixed(&m), &[1.0, 1.0, 0.1, 0.25]);
    assert!(m.texture.is_some());
    // A black surface has no texture to scale.
    let m = material(&named(&blend(0.5, &tree, &diffuse("0"))));
    alike(&mixed(&m), &[0.375 / 0.875, 1.0, 0.1, 0.125]);
    assert!(m.texture.is_some());
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
fn a_mix_has_the_mean_spectrum_of_its_lambertians_and_of_its_conductors() {
    let d = by_wavelength(&diffuse(""), "400:0, 600:0.5");
    let c = |values: &str| by_wavelength(&metal(0.1, ""), values);
    let two = blend(0.5, &c("500:0.25"), &c("500:0.75"));
    let m = material(&named(&blend(0.5, &d, &two)));
    let expected = [
        row(400.0, 0.0, Some(0.5)),
        row(500.0, 0.25, Some(0.5)),
        row(600.0, 0.5, Some(0.5)),
    ];
    assert_eq!(m.spectrum, expected);
    let at = m.at(600.0);
    assert_eq!((at.lambertian, at.conductor), (0.5, 0.5));
}

#[test]
fn blends_that_cannot_be_are_refused_by_element() {
    let deep = (0..9).fold(diffuse("0.5"), |tree, _| blend(0.5, &tree, &diffuse("0.2")));
    let picture = textured(&diffuse("1"), "a.png");
    for (bsdf, expected) in [
        (
            blend(
                0.5,
                &metal(0.1, "1"),
                &blend(0.5, &diffuse("1"), &metal(0.4, "1")),
            ),
            "has conductors of alpha 0.1 (ggx), alpha 0.4 (ggx), expected one roughness",
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
            blend(0.0, &diffuse("1"), "<bsdf type=\"velvet\"/>"),
            "bsdf \"velvet\" is not supported",
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

/// A tree of blends over Lambertians and conductors of one roughness.
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
    /// Its text; its leaves' shares, and whether they are conductors, are added to `leaves`.
    fn text(&self, share: f64, leaves: &mut Vec<(f64, bool, f64)>) -> String {
        match self {
            Tree::Leaf(is_metal) => {
                let number = 0.1 + 0.02 * leaves.len() as f32;
                leaves.push((share, *is_metal, f64::from(number)));
                match is_metal {
                    true => metal(0.3, &number.to_string()),
                    false => diffuse(&number.to_string()),
                }
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
    fn a_part_reflects_what_its_leaves_do_together(tree in tree()) {
        let mut leaves = Vec::new();
        let text = named(&tree.text(1.0, &mut leaves));
        let scene = read(&text).expect("reads");
        let m = material_of(&scene);
        let (lambertian, conductor) = match m.bsdf {
            Bsdf::Mixed { reflectance, specular_reflectance, weight, .. } => {
                ((1.0 - weight) * reflectance, weight * specular_reflectance)
            }
            Bsdf::Diffuse { reflectance } => (reflectance, 0.0),
            Bsdf::RoughConductor { reflectance, .. } => (0.0, reflectance),
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => unreachable!("no leaf is glass"),
        };
        let expected = |metal: bool| -> f64 {
            let of = leaves.iter().filter(|l| l.1 == metal);
            of.map(|l| l.0 * l.2).sum()
        };
        for (found, metal) in [(lambertian, false), (conductor, true)] {
            let expected = expected(metal);
            prop_assert!((f64::from(found) - expected).abs() < 1e-5, "{} {}", found, expected);
        }
        prop_assert!(m.rgb.iter().all(|c| (c - lambertian - conductor).abs() < 1e-5));
    }
}
