//! Near-mirrors: mirror images versus the light of a virtual source, and the text of the plan.

use crate::common;

use std::f64::consts::PI;

use common::{Quiet, energy, grey, quad, scene, settings, sphere, v};
use picofarm_scene::{Beam, Intrinsics, Material, Object, Scene, Spot, Vec3};
use picofarm_transient::{Budget, Settings, render};

/// Returns a lit plate to the left and a screen in front. The camera sees the screen alone.
fn stage(extra: Object) -> Scene {
    let screen = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    let plate = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(0.7),
    );
    let mut s = scene(vec![screen, plate, extra], 8, &[]);
    s.camera.intrinsics = Intrinsics::from_fov(40.0, 8, 8);
    let point = v(-1.5, 0.2, -0.5);
    s.laser.beams.push(Beam {
        direction: point.normalized(),
        spot: Some(Spot {
            point,
            normal: v(1.0, 0.0, 0.0),
            arriving: point.normalized(),
            path_m: point.length(),
            object: 1,
            material: 0,
        }),
    });
    s
}

fn three() -> Settings {
    Settings {
        max_bounces: Some(3),
        ..settings(Budget::Samples(256))
    }
}

#[test]
fn light_by_way_of_a_planar_mirror_is_that_of_the_spots_image() {
    let floor = quad(
        v(-1.5, -1.2, 1.0),
        v(3.0, 0.0, 0.0),
        v(0.0, 0.0, -3.0),
        Material::mirror("floor", 0.01),
    );
    let s = stage(floor);
    let r = render(&s, &three(), &Quiet).unwrap();
    assert!(
        r.plan
            .strategies
            .iter()
            .any(|s| s.contains("mirror images: 1"))
    );
    assert!(r.plan.approximations.is_empty());
    let multi = r.split.unwrap().multi;
    // The only path of three bounces to the screen is plate → mirror → screen.
    let image = v(-1.5, -2.6, -0.5);
    let f = 0.7 / PI;
    let mut whole = (0.0, 0.0);
    for k in 0..64 {
        let (mut expected, n) = (0.0f64, 16);
        for i in 0..n * n {
            let at = |x: usize| (x as f32 + 0.5) / n as f32;
            let (col, row) = ((k % 8) as f32 + at(i % n), (k / 8) as f32 + at(i / n));
            let x = s.camera.ray(col, row) * 2.0;
            let to = x - image;
            let d = f64::from(to.length());
            let (cos_l, cos_x) = (f64::from(to.x) / d, f64::from(-to.z) / d);
            expected += f * f * cos_l * cos_x / (d * d) / (n * n) as f64;
        }
        let got = energy(&multi[k * 637..(k + 1) * 637]);
        assert!(
            (got / expected - 1.0).abs() < 0.08,
            "pixel {k}: {got} {expected}"
        );
        whole = (whole.0 + got, whole.1 + expected);
    }
    assert!((whole.0 / whole.1 - 1.0).abs() < 0.01, "{whole:?}");
}

#[test]
fn a_curved_near_mirror_is_named_as_noisy_where_no_light_paths_go() {
    let ball = sphere(v(0.0, -3.0, -1.0), 0.5, 3, Material::mirror("ball", 0.01));
    let mut settings = three();
    for caustics in [true, false] {
        settings.strategy.caustics = Some(caustics);
        let r = render(&stage(ball.clone()), &settings, &Quiet).unwrap();
        let named = |all: &[String], what: &str| all.iter().any(|s| s.contains(what));
        assert!(!named(&r.plan.strategies, "mirror images"));
        assert_eq!(named(&r.plan.strategies, "light paths"), caustics);
        assert_eq!(named(&r.plan.approximations, "curved"), !caustics);
    }
}

#[test]
fn two_facing_mirrors_end_beams_and_paths() {
    let mirror = |z: f32, b: Vec3| {
        quad(
            v(-1.0, -1.0, z),
            v(2.0, 0.0, 0.0),
            b,
            Material::mirror("m", 0.01),
        )
    };
    let up = v(0.0, 2.0, 0.0);
    let mut s = scene(
        vec![mirror(-1.0, up), mirror(1.0, up)],
        4,
        &[v(0.0, 0.0, -1.0)],
    );
    let r = render(&s, &settings(Budget::Samples(8)), &Quiet).unwrap();
    assert_eq!(r.spots, vec![None], "the beam goes to and fro for ever");
    assert!(r.truth.specular.iter().all(|&m| m == 1));
    s.laser.beams[0].direction = v(0.3, 0.1, -1.0).normalized();
    assert_eq!(picofarm_transient::trace_spots(&s).unwrap(), vec![None]);
}
