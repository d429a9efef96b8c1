//! Adversarial scenes: each render ends in finite results or in a clear error.
//! PICOFARM_LONG_TESTS=n tests n times as many scenes.

use crate::common;

use common::{Quiet, object};
use picofarm_scene::{
    Beam, Bsdf, Camera, Distribution, Intrinsics, Laser, Material, Object, Provenance, Scene,
    SpectrumPoint, Spot, Vec3,
};
use picofarm_transient::{
    BeamWidth, Budget, Gate, Optics, RenderError, Rendered, Settings, Strategy, Wavelength, render,
};
use proptest::{prelude::*, strategy::Strategy as Draw};

/// A coordinate, mostly of a room's size and sometimes extreme.
fn coordinate() -> impl Draw<Value = f32> {
    prop_oneof![
        600 => -4.0f32..4.0,
        150 => (-4i8..=4).prop_map(|x| f32::from(x) * 0.5),
        50 => Just(0.0),
        50 => power(-38, 8),
        1 => power(9, 30),
    ]
}

/// ±10^e.
fn power(low: i32, high: i32) -> impl Draw<Value = f32> {
    (low..=high, any::<bool>()).prop_map(|(e, minus)| {
        let x = 10f64.powi(e) as f32;
        if minus { -x } else { x }
    })
}

fn point() -> impl Draw<Value = Vec3> {
    (coordinate(), coordinate(), coordinate()).prop_map(|(x, y, z)| Vec3::new(x, y, z))
}

fn tame_point() -> impl Draw<Value = Vec3> {
    (-4.0f32..4.0, -4.0f32..4.0, -4.0f32..4.0).prop_map(|(x, y, z)| Vec3::new(x, y, z))
}

fn unit() -> impl Draw<Value = Vec3> {
    prop_oneof![
        3 => tame_point().prop_map(|p| {
            let u = p.normalized();
            if u.is_finite() { u } else { Vec3::new(0.0, 0.0, -1.0) }
        }),
        1 => (0usize..3, any::<bool>()).prop_map(|(axis, s)| {
            let mut d = [0.0f32; 3];
            d[axis] = if s { -1.0 } else { 1.0 };
            Vec3::from(d)
        }),
    ]
}

fn material() -> impl Draw<Value = Material> {
    let share = || prop_oneof![Just(0.0f32), Just(1.0), 0.0f32..=1.0];
    let alpha = || prop_oneof![Just(1e-3f32), Just(1.0), Just(0.01), 1e-3f32..=1.0];
    let kind = || prop_oneof![Just(Distribution::Beckmann), Just(Distribution::Ggx)];
    let bsdf = prop_oneof![
        2 => share().prop_map(|reflectance| Bsdf::Diffuse { reflectance }),
        2 => (alpha(), kind(), share()).prop_map(|(alpha, distribution, reflectance)| {
            Bsdf::RoughConductor { alpha, distribution, reflectance }
        }),
        1 => (share(), alpha(), kind(), share(), share()).prop_map(
            |(reflectance, alpha, distribution, specular_reflectance, weight)| Bsdf::Mixed {
                reflectance, alpha, distribution, specular_reflectance, weight,
            }
        ),
    ];
    let point = (450.0f32..1000.0, share()).prop_map(|(nm, reflectance)| SpectrumPoint {
        nm,
        reflectance,
        specular_reflectance: None,
    });
    let spectrum = proptest::collection::vec(point, 0..4).prop_map(|mut rows| {
        rows.sort_by(|a, b| a.nm.total_cmp(&b.nm));
        rows
    });
    let rgb = proptest::array::uniform3(0.0f32..=1.0);
    (bsdf, any::<bool>(), spectrum, rgb).prop_map(|(bsdf, two_sided, spectrum, rgb)| Material {
        bsdf,
        two_sided,
        spectrum,
        rgb,
        ..common::grey(0.5)
    })
}

/// A soup of triangles over few points. Slivers, duplicates and triangles without area occur by
/// themselves.
fn soup() -> impl Draw<Value = Object> {
    (
        proptest::collection::vec(point(), 3..12),
        1usize..40,
        any::<u64>(),
        material(),
    )
        .prop_map(|(mut points, count, mut seed, m)| {
            points.push((points[0] + points[1]) * 0.5);
            let n = points.len() as u64;
            let mut next = || {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                ((seed >> 33) % n) as u32
            };
            let triangles = (0..count).map(|_| [next(), next(), next()]).collect();
            object("soup", points, triangles, m)
        })
}

/// A wall of two large triangles, or the same wall of thousands, all coplanar and some twice.
fn wall() -> impl Draw<Value = Object> {
    (
        tame_point(),
        tame_point(),
        tame_point(),
        prop_oneof![4 => Just(1u32), 1 => Just(40)],
        material(),
    )
        .prop_map(|(corner, a, b, n, m)| {
            let mut positions = vec![];
            for k in 0..(n + 1) * (n + 1) {
                let at = |i: u32| i as f32 / n as f32;
                positions.push(corner + a * at(k % (n + 1)) + b * at(k / (n + 1)));
            }
            let mut triangles = vec![];
            for k in 0..n * n {
                let i = k / n * (n + 1) + k % n;
                triangles.extend([[i, i + 1, i + n + 2], [i, i + n + 2, i + n + 1]]);
                if k % 3 == 0 {
                    triangles.push([i, i + 1, i + n + 2]);
                }
            }
            object("wall", positions, triangles, m)
        })
}

fn camera() -> impl Draw<Value = Camera> {
    let focal = || prop_oneof![3 => 1.0f32..20.0, 1 => Just(1e-6f32), 1 => Just(1e8f32)];
    let centre = || prop_oneof![3 => 0.0f32..6.0, 1 => -1e6f32..1e6];
    let origin = prop_oneof![3 => Just(Vec3::ZERO), 2 => tame_point(), 1 => point()];
    (
        origin,
        unit(),
        (focal(), focal()),
        (centre(), centre()),
        (1u32..7, 1u32..7),
    )
        .prop_map(|(origin, forward, (fx, fy), (cx, cy), (width, height))| {
            let side = if forward.y.abs() > 0.9 {
                Vec3::new(1.0, 0.0, 0.0)
            } else {
                Vec3::new(0.0, 1.0, 0.0)
            };
            let right = forward.cross(side).normalized();
            Camera {
                intrinsics: Intrinsics {
                    fx,
                    fy,
                    cx,
                    cy,
                    width,
                    height,
                },
                origin,
                right,
                down: forward.cross(right),
                forward,
            }
        })
}

fn beams(objects: usize) -> impl Draw<Value = Vec<Beam>> {
    let spot = (
        point(),
        unit(),
        unit(),
        prop_oneof![3 => 0.0f32..10.0, 1 => Just(1e30f32), 1 => Just(0.0f32)],
        0..objects as u32,
    )
        .prop_map(|(point, normal, arriving, path_m, object)| Spot {
            point,
            normal,
            arriving,
            path_m,
            object,
            material: 0,
        });
    let beam = (unit(), proptest::option::weighted(0.3, spot));
    proptest::collection::vec(
        beam.prop_map(|(direction, spot)| Beam { direction, spot }),
        // More than five use another technique for finding light.
        0..12,
    )
}

fn hostile_scene() -> impl Draw<Value = Scene> {
    let objects = proptest::collection::vec(prop_oneof![soup(), wall()], 1..6);
    (objects, camera(), prop_oneof![tame_point(), point()])
        .prop_flat_map(|(objects, camera, origin)| {
            let count = objects.len();
            (Just((objects, camera, origin)), beams(count))
        })
        .prop_map(|((objects, camera, origin), beams)| Scene {
            name: "hostile".into(),
            objects,
            labels: vec!["thing".into()],
            camera,
            laser: Laser { origin, beams },
            provenance: Provenance::default(),
        })
}

fn hostile_settings() -> impl Draw<Value = Settings> {
    let width = prop_oneof![4 => 0.01f64..1.0, 1 => Just(1e-30), 1 => Just(1e30)];
    let start = prop_oneof![3 => 0.0f64..5.0, 1 => Just(1e30)];
    let bins = prop_oneof![6 => 1u32..400, 1 => Just(100_000)];
    let budget = prop_oneof![
        4 => (0u32..4).prop_map(Budget::Samples),
        1 => Just(Budget::Error(2.0)),
    ];
    let strategy = (
        proptest::option::of(1u32..=16),
        proptest::option::of(any::<bool>()),
        proptest::option::of(any::<bool>()),
    );
    let size = || prop_oneof![3 => 0.0f64..50.0, 1 => Just(1000.0), 1 => Just(-1.0)];
    let beam =
        (size(), 0.0f64..600.0, 3u32..8).prop_map(|(diameter_mm, divergence_mrad, points)| {
            BeamWidth {
                diameter_mm,
                divergence_mrad,
                points,
            }
        });
    let fill_factor =
        prop_oneof![3 => Just(1.0), 3 => 0.01f64..1.0, 1 => Just(0.01), 1 => Just(0.0)];
    let wavelength = 250.0f64..2000.0;
    let wavelengths = prop_oneof![
        2 => Just(Wavelength::NONE),
        1 => wavelength.prop_map(|nm| Wavelength::of(&[nm]).unwrap()),
    ];
    (
        start,
        width,
        bins,
        budget,
        proptest::option::of(1u32..8),
        any::<(bool, bool, u64)>(),
        strategy,
        (proptest::option::of(beam), fill_factor, wavelengths),
    )
        .prop_map(
            |(
                start_m,
                bin_width_m,
                bins,
                budget,
                max_bounces,
                (one_bounce, split, seed),
                strategy,
                (beam, fill_factor, wavelengths_nm),
            )| {
                // 10⁵ bins cost memory per pixel, and an error target would need passes without end
                // there.
                let budget = if bins > 1000 {
                    Budget::Samples(1)
                } else {
                    budget
                };
                let (share, light_vertices, mirror_images) = strategy;
                Settings {
                    gate: Gate {
                        start_m,
                        bin_width_m,
                        bins,
                    },
                    budget,
                    max_bounces: Some(max_bounces.unwrap_or(12)),
                    one_bounce,
                    seed,
                    split,
                    groups: vec![],
                    strategy: Strategy {
                        path_reuse: share,
                        light_vertices,
                        mirror_images,
                        ..Strategy::default()
                    },
                    optics: Optics {
                        beam,
                        fill_factor,
                        wavelengths_nm,
                    },
                }
            },
        )
}

/// Checks that no output is NaN or infinite, and that no amount is negative.
fn sane(r: &Rendered) -> Result<(), TestCaseError> {
    let mut amounts = vec![
        ("transient", &r.transient),
        ("depth", &r.truth.depth),
        ("range", &r.truth.range),
        ("rgb", &r.truth.rgb),
    ];
    let mut signed = vec![("normal", &r.truth.normal)];
    if let Some(s) = &r.split {
        amounts.extend([
            ("two", &s.two),
            ("two_se", &s.two_se),
            ("multi", &s.multi),
            ("multi_se", &s.multi_se),
        ]);
        signed.push(("multi_noise", &s.multi_noise));
        signed.push(("two_noise", &s.two_noise));
    }
    for (name, list) in amounts {
        let bad = list.iter().position(|x| !(x.is_finite() && *x >= 0.0));
        prop_assert!(
            bad.is_none(),
            "{name}[{}] = {}",
            bad.unwrap(),
            list[bad.unwrap()]
        );
    }
    for (name, list) in signed {
        let bad = list.iter().position(|x| !x.is_finite());
        prop_assert!(
            bad.is_none(),
            "{name}[{}] = {}",
            bad.unwrap(),
            list[bad.unwrap()]
        );
    }
    let e = &r.error;
    for x in [e.median_relative, e.p95_relative, e.total_relative] {
        prop_assert!(x.is_finite() && x >= 0.0, "{e:?}");
    }
    let o = &r.overflow;
    prop_assert!(
        o.energy.is_finite() && o.energy >= 0.0 && (0.0..=1.0).contains(&o.share),
        "{o:?}"
    );
    prop_assert!(r.truth.visibility.iter().all(|&m| m <= 1));
    for spot in r.spots.iter().flatten() {
        prop_assert!(
            spot.point.is_finite() && spot.path_m.is_finite(),
            "{spot:?}"
        );
    }
    Ok(())
}

fn cases() -> u32 {
    let times = std::env::var("PICOFARM_LONG_TESTS").ok();
    300 * times.map_or(1, |t| t.parse::<u32>().map_or(10, |n| n.max(1)))
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, max_shrink_time: 20_000, ..ProptestConfig::with_cases(cases()) })]

    #[test]
    fn a_hostile_scene_gives_finite_results_or_a_clear_error(s in hostile_scene(), set in hostile_settings()) {
        match render(&s, &set, &Quiet) {
            Ok(r) => sane(&r)?,
            Err(RenderError::Stopped) => prop_assert!(false, "nobody asked to stop"),
            Err(e) => prop_assert!(!e.to_string().is_empty()),
        }
    }
}

/// A scene 100 m wide, seen from 10⁻¹⁸ m above one of its surfaces.
#[test]
fn a_camera_that_all_but_touches_a_surface_is_served_in_time() {
    let wall = |z: f32| {
        let corner = Vec3::new(-50.0, -50.0, z);
        let (a, b) = (Vec3::new(100.0, 0.0, 0.0), Vec3::new(0.0, 100.0, 0.0));
        let positions = vec![corner, corner + a, corner + a + b, corner + b];
        object(
            "wall",
            positions,
            vec![[0, 1, 2], [0, 2, 3]],
            common::grey(0.5),
        )
    };
    let mut objects: Vec<Object> = (0..40).map(|k| wall(-1e-18 * (k + 1) as f32)).collect();
    objects.push(wall(1e-18));
    let s = common::scene(objects, 4, &[Vec3::new(0.0, 0.0, -1.0)]);
    match render(&s, &common::settings(Budget::Samples(1)), &Quiet) {
        Ok(r) => sane(&r).unwrap(),
        Err(e) => panic!("{e}"),
    }
}

/// One corner of a surface is 10⁻²⁸ m from the camera, so that squares of distances underflow.
#[test]
fn a_surface_nearer_than_squares_can_tell_gives_finite_results() {
    let positions = [
        [-1.5, 0.0, 1.3586438],
        [-3.274711, -3.2796097, -2.2765107],
        [1.0, -1.4868157, -3.095264],
        [-1.5, 1e-17, -1.7481439],
        [2.3049014, 2.276526, 2.9968834],
        [1e-28, 1e-29, 0.0],
        [2.0, -2.0, 2.3408718],
        [-1.9006321, 0.0, 3.4168699],
        [2.0674775, -3.0975115, 0.014293911],
        [-2.3873553, -1.6398048, -0.45893347],
    ];
    let triangles = vec![
        [2, 4, 7],
        [0, 4, 9],
        [3, 3, 6],
        [1, 7, 2],
        [7, 0, 3],
        [3, 8, 2],
        [9, 1, 3],
        [6, 2, 4],
        [1, 7, 9],
        [0, 2, 6],
        [8, 5, 7],
        [0, 3, 7],
        [8, 1, 1],
        [5, 7, 7],
        [8, 1, 7],
        [4, 1, 9],
        [1, 6, 1],
        [2, 5, 0],
        [5, 4, 3],
        [7, 7, 7],
        [5, 2, 9],
        [7, 6, 4],
        [3, 3, 8],
        [6, 7, 2],
        [5, 4, 3],
        [8, 9, 1],
        [4, 1, 1],
        [7, 4, 4],
        [4, 6, 6],
        [7, 8, 9],
        [1, 4, 9],
        [2, 2, 1],
        [9, 9, 2],
    ];
    let positions: Vec<Vec3> = positions.into_iter().map(Vec3::from).collect();
    let rough = |alpha| Bsdf::RoughConductor {
        alpha,
        distribution: Distribution::Ggx,
        reflectance: 0.9,
    };
    let beams = [Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.6, -0.8, 0.0)];
    for bsdf in [
        Bsdf::Diffuse { reflectance: 0.0 },
        Bsdf::Diffuse { reflectance: 0.9 },
        rough(1e-3),
        rough(0.3),
    ] {
        let m = Material {
            bsdf,
            two_sided: true,
            ..common::grey(0.5)
        };
        for directions in [&[][..], &beams] {
            let soup = object("soup", positions.clone(), triangles.clone(), m.clone());
            let mut s = common::scene(vec![soup], 6, directions);
            s.camera = Camera {
                intrinsics: Intrinsics {
                    fx: 7.206_976,
                    fy: 8.300_374,
                    cx: 1.503_962,
                    cy: 438_846.5,
                    width: 6,
                    height: 5,
                },
                origin: Vec3::ZERO,
                right: Vec3::new(0.0, 0.0, 1.0),
                down: Vec3::new(0.0, -1.0, 0.0),
                forward: Vec3::new(1.0, 0.0, 0.0),
            };
            s.laser.origin = Vec3::new(0.271_982_52, -1.856_426_4, -1.123_946_9);
            for seed in 0..20 {
                let mut set = common::settings(Budget::Samples(4));
                set.seed = seed;
                sane(&render(&s, &set, &Quiet).unwrap()).unwrap();
            }
        }
    }
}

/// Identical boxes give a tree builder no information.
#[test]
fn copies_of_one_triangle_without_number_are_served_in_time() {
    let positions = vec![
        Vec3::new(-1.0, -1.0, -2.0),
        Vec3::new(1.0, -1.0, -2.0),
        Vec3::new(0.0, 1.0, -2.5),
    ];
    let set = common::settings(Budget::Samples(4));
    let [one, all] = [1, 200_000].map(|n| {
        let copies = object(
            "copies",
            positions.clone(),
            vec![[0, 1, 2]; n],
            common::grey(0.5),
        );
        let s = common::scene(vec![copies], 8, &[Vec3::new(0.0, 0.0, -1.0)]);
        render(&s, &set, &Quiet).unwrap()
    });
    assert!(one.transient == all.transient);
}

/// A closed box of a millimetre around the camera, and sheets of millions of kilometres behind it.
/// Each sheet would be cut into hundreds of pieces.
#[test]
fn more_pieces_of_huge_triangles_than_fit_are_refused_by_name() {
    let mut objects = common::room(
        Vec3::new(-1e-3, -1e-3, -1e-3),
        Vec3::new(1e-3, 1e-3, 1e-3),
        &common::grey(0.5),
    );
    let (mut positions, mut triangles) = (vec![], vec![]);
    for k in 0..20_000u32 {
        let z = -1e-2 - 1e-5 * k as f32;
        let corners = [(-9e8, -9e8), (9e8, -9e8), (0.0, 9e8)];
        positions.extend(corners.map(|(x, y)| Vec3::new(x, y, z)));
        triangles.push([3 * k, 3 * k + 1, 3 * k + 2]);
    }
    objects.push(object("sheets", positions, triangles, common::grey(0.5)));
    let s = common::scene(objects, 4, &[Vec3::new(0.0, 0.0, -1.0)]);
    let e = render(&s, &common::settings(Budget::Samples(1)), &Quiet).unwrap_err();
    let e = e.to_string();
    assert!(e.contains("objects") && e.contains("pieces"), "{e}");
}
