//! The same bits with any threads, order, interruption, machine and profile; other bits from
//! another seed.

use crate::common;

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use common::{grey, ok, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Bsdf, Distribution, Material, Scene, Texture, Wrap};
use picofarm_transient::{
    Budget, Part, PartOf, Progress, RENDERER_VERSION, RenderError, Rendered, Settings, Strategy,
    join_parts, render, render_part,
};

/// Returns a scene with a mirror, a glossy surface, a mix, a texture, curved objects and four
/// spots.
pub(crate) fn everything(size: u32) -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let mix = Material {
        bsdf: Bsdf::Mixed {
            reflectance: 0.5,
            alpha: 0.2,
            distribution: Distribution::Ggx,
            specular_reflectance: 0.9,
            weight: 0.4,
        },
        ..grey(0.5)
    };
    objects.push(sphere(v(-0.7, -0.9, -2.5), 0.5, 2, mix));
    objects.push(sphere(
        v(0.9, -1.0, -2.2),
        0.4,
        2,
        Material::mirror("ball", 0.05),
    ));
    objects.push(quad(
        v(-1.9, -0.5, -3.0),
        v(0.1, 1.2, 0.0),
        v(0.0, 0.0, 1.5),
        Material::mirror("m", 0.01),
    ));
    objects.push(quad(
        v(-1.2, -0.6, -1.6),
        v(0.8, 0.0, 0.1),
        v(0.0, 0.9, 0.0),
        Material::glass("pane"),
    ));
    let solid = Material::solid_glass("glass ball");
    objects.push(sphere(v(0.2, -1.1, -1.9), 0.3, 2, solid));
    let texels = vec![[200, 100, 50], [20, 240, 90], [90, 90, 90], [255, 255, 255]];
    let mut checkers = grey(0.8);
    checkers.texture = Some(
        Texture::new("t", 2, 2, texels, Wrap::Mirror)
            .unwrap()
            .into(),
    );
    let mut picture = quad(
        v(-0.5, 0.0, -3.9),
        v(1.0, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        checkers,
    );
    let mut mesh = (*picture.mesh).clone();
    mesh.uv = vec![[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]];
    picture.mesh = mesh.into();
    objects.push(picture);
    let beams = [
        v(0.3, 0.2, -1.0),
        v(-0.4, -0.1, -1.0),
        v(-0.3, 0.3, -1.0),
        v(0.1, -0.6, -1.0),
    ];
    scene(objects, size, &beams)
}

fn set(budget: Budget) -> Settings {
    Settings {
        one_bounce: true,
        groups: vec![vec![0, 2]],
        ..settings(budget)
    }
}

/// Returns FNV-1a over every output bit.
fn hash(r: &Rendered) -> u64 {
    let mut h = 0xcbf2_9ce4_8422_2325u64;
    let mut eat = |bytes: &[u8]| {
        for &b in bytes {
            h = (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3);
        }
    };
    let s = r.split.as_ref().unwrap();
    let t = &r.truth;
    let floats = [
        &r.transient,
        &s.two,
        &s.two_se,
        &s.multi,
        &s.multi_se,
        &s.multi_noise,
        &s.two_noise,
        &r.groups[0],
        &t.depth,
        &t.range,
        &t.normal,
        &t.rgb,
    ];
    for list in floats {
        list.iter().for_each(|x| eat(&x.to_bits().to_le_bytes()));
    }
    t.instance.iter().for_each(|x| eat(&x.to_le_bytes()));
    t.label.iter().for_each(|x| eat(&x.to_le_bytes()));
    eat(&t.specular);
    eat(&t.visibility);
    for spot in r.spots.iter().flatten() {
        let p = spot.point;
        [p.x, p.y, p.z, spot.path_m]
            .iter()
            .for_each(|x| eat(&x.to_bits().to_le_bytes()));
    }
    let e = &r.error;
    eat(&r.overflow.energy.to_bits().to_le_bytes());
    for x in [e.median_relative, e.p95_relative, e.total_relative] {
        eat(&x.to_bits().to_le_bytes());
    }
    eat(&e.samples.to_le_bytes());
    eat(&r.rays.to_le_bytes());
    h
}

/// Sleeps occasionally, so that threads steal tiles from each other in varying orders.
struct Dawdle(AtomicU64);

impl Progress for Dawdle {
    fn at(&self, _done: f32) -> bool {
        let k = self
            .0
            .fetch_add(1, Ordering::Relaxed)
            .wrapping_mul(0x9e37_79b9_7f4a_7c15);
        if k >> 56 < 16 {
            std::thread::sleep(Duration::from_micros(k >> 50 & 1023));
        }
        true
    }
}

/// Stops after a number of progress calls.
struct StopAfter(AtomicU64);

impl Progress for StopAfter {
    fn at(&self, _done: f32) -> bool {
        self.0.fetch_sub(1, Ordering::Relaxed) > 1
    }
}

#[test]
fn any_order_of_tiles_and_any_threads_give_the_same_bits() {
    let s = everything(40);
    let budget = set(Budget::Error(0.4));
    let run = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let dawdle = Dawdle(AtomicU64::new(seed));
        pool.install(|| hash(&render(&s, &budget, &dawdle).unwrap()))
    };
    let first = run(1, 0);
    for (threads, seed) in [(2, 1), (7, 2), (7, 3)] {
        assert_eq!(first, run(threads, seed), "{threads} threads");
    }
}

#[test]
fn a_render_stopped_and_started_again_gives_the_same_bits() {
    let s = everything(24);
    let budget = set(Budget::Samples(6));
    let whole = hash(&ok(&s, &budget));
    for after in [1, 40, 300] {
        let stop = StopAfter(AtomicU64::new(after));
        let stopped = render(&s, &budget, &stop);
        assert!(
            matches!(stopped, Err(RenderError::Stopped)),
            "after {after}"
        );
        assert_eq!(whole, hash(&ok(&s, &budget)));
    }
}

struct Unwatched;

impl Progress for Unwatched {
    fn at(&self, _done: f32) -> bool {
        true
    }
}

/// Returns all parts, as another machine reads them.
fn parts(s: &Scene, settings: &Settings, of: u32) -> Vec<Part> {
    let part = |which| {
        let part = render_part(s, settings, which, &Unwatched).unwrap();
        let text = serde_json::to_string(&part).unwrap();
        serde_json::from_str(&text).unwrap()
    };
    PartOf::all(of).map(part).collect()
}

#[test]
fn parts_rendered_apart_join_to_the_bits_of_the_whole() {
    let s = everything(40);
    for caustics in [false, true] {
        let settings = Settings {
            strategy: Strategy {
                caustics: Some(caustics),
                ..Strategy::default()
            },
            ..set(Budget::Samples(8))
        };
        let whole = ok(&s, &settings);
        let drawn = whole
            .plan
            .strategies
            .iter()
            .any(|s| s.starts_with("light paths: caustics"));
        assert_eq!(drawn, caustics, "{:?}", whole.plan);
        // 9 tiles: in one range, in uneven ranges, and with empty ranges.
        for of in [1, 4, 11] {
            let mut parts = parts(&s, &settings, of);
            parts.reverse();
            let joined = join_parts(&s, &settings, parts, &Unwatched).unwrap();
            assert_eq!(
                hash(&whole),
                hash(&joined),
                "{of} parts, caustics {caustics}"
            );
            assert_eq!(whole.plan, joined.plan);
        }
    }
}

#[test]
fn parts_that_do_not_belong_together_are_refused_by_number() {
    let s = everything(24);
    let settings = set(Budget::Samples(2));
    let refused = |parts: Vec<Part>, said: &str| {
        let error = join_parts(&s, &settings, parts, &Unwatched)
            .unwrap_err()
            .to_string();
        assert!(error.contains(said), "{error}");
    };
    let all = parts(&s, &settings, 2);
    refused(vec![], "parts: there are none");
    refused(all[..2].to_vec(), "parts[2]: is missing");
    refused(
        vec![all[0].clone(), all[0].clone()],
        "parts[0]: is there twice",
    );
    let other = Settings {
        seed: 9,
        ..settings.clone()
    };
    let stranger = parts(&s, &other, 2).swap_remove(1);
    refused(
        vec![all[0].clone(), stranger],
        "parts[1]: is of another scene",
    );
    let stranger = parts(&s, &settings, 3).swap_remove(1);
    refused(
        vec![all[0].clone(), stranger],
        "parts[1]: is of another scene",
    );
    let bare = everything(16);
    let stranger = parts(&bare, &settings, 2).swap_remove(1);
    refused(
        vec![all[0].clone(), stranger],
        "parts[1]: is of another scene",
    );

    let which = PartOf { index: 4, of: 3 };
    let error = render_part(&s, &settings, which, &Unwatched).unwrap_err();
    assert!(error.to_string().contains("part: 4 of 3"), "{error}");
    let which = PartOf { index: 0, of: 3 };
    let error = render_part(&s, &set(Budget::Error(0.1)), which, &Unwatched).unwrap_err();
    assert!(error.to_string().contains("budget.error"), "{error}");
}

#[test]
fn another_seed_gives_other_bits_and_the_same_light() {
    let s = everything(16);
    let run = |seed| {
        ok(
            &s,
            &Settings {
                seed,
                ..set(Budget::Samples(32))
            },
        )
    };
    let (a, b) = (run(1), run(2));
    assert_ne!(hash(&a), hash(&b));
    assert_ne!(a.split.as_ref().unwrap().two, b.split.as_ref().unwrap().two);
    let (x, y) = (common::energy(&a.transient), common::energy(&b.transient));
    let se = f64::from(a.error.total_relative).hypot(f64::from(b.error.total_relative));
    common::near("seeds", y, x, 0.0, x * se);
    // The ground truth is that of the pixels' centres, without random numbers.
    assert_eq!(a.truth.depth, b.truth.depth);
    assert_eq!(a.truth.visibility, b.truth.visibility);
}

/// The recorded bits of one render. They are the same on any machine, with any kernel, in debug and
/// in release. A change here means that outputs have changed: give RENDERER_VERSION a new name and
/// copy both from the failure's message.
#[test]
fn the_bits_are_those_written_down() {
    const VERSION: &str = "transient-21";
    const HASH: u64 = 0x8a91_c5bd_3088_d486;
    // From eight paths on, errors are drawn.
    let found = hash(&ok(&everything(20), &set(Budget::Samples(8))));
    assert_eq!(
        (RENDERER_VERSION, found),
        (VERSION, HASH),
        "the renderer's bits are now {found:#018x}"
    );
}
