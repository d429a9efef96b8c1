//! Like `independent.rs`, with glass that reflects and refracts: a window and a partition, a ball
//! and a cube of glass, a vessel. `glass_tracer.rs` tests the independent tracer itself.
//! `PICOFARM_EFFORT=64 cargo test --release -p picofarm-transient --test independent_glass --
//! --nocapture` measures with 64 times the paths.

use crate::common;

use common::{
    bent::Connects,
    brute::{Noise, P},
    compare::{BATCHES, Energies, PARTS, Sums, alike, effort, joined, regions, rendered},
    glassware::{body, cuboid, inverted, thin, together},
    grey,
    light::{Energy, LONGEST, Source, Tracer, is_mirror},
    near, quad, room, scene, sphere, v,
};
use picofarm_scene::{
    AssetLibrary, Scene,
    furnished::{self, FurnishedSettings},
};
use picofarm_settings::Spots;
use picofarm_transient::trace_spots;
use rayon::prelude::*;

const PIXELS: u32 = 64;

/// Path classes by their bent legs.
const CLASSES: [&str; 5] = [
    "nothing bent",
    "bent, but not at the camera",
    "bent at the camera, not at the spot",
    "bent at both, not in between",
    "all bent",
];

/// `[class]` of `[region][part]`.
type Classes = [Sums; 5];

/// Returns the pixels of glass and those of spots. The laser and the camera are at the same place,
/// so glass in front of a spot shows the spot that it makes by reflecting the beam.
fn glassy(regions: &[usize]) -> Vec<usize> {
    let glass = (0..regions.len()).filter(|&k| regions[k] == 2);
    let spots = (0..regions.len()).filter(|&k| regions[k] == 1);
    glass.chain(spots).collect()
}

/// Returns the energies of paths that arrive at the camera by a straight leg.
fn straight(
    tracer: &Tracer,
    sources: &[Source],
    regions: &[usize],
    (paths, rng): (usize, &mut Noise),
    all: &mut Classes,
) {
    let share = paths / sources.len();
    for s in sources {
        for (part, many) in [(0, (4 * share, 2)), (1, (share, LONGEST))] {
            tracer.carry(s, many, rng, |seen| {
                if usize::from(seen.more) == part {
                    let class = usize::from(seen.bends.any);
                    all[class][regions[seen.pixel]][part] += seen.value;
                }
            });
        }
    }
}

/// Returns the energies of paths that arrive at the camera by a bent leg, with as many camera
/// paths, and as many light paths to connect them to.
fn bent(
    tracer: &Tracer,
    (sources, connects): (&[Source], Connects),
    regions: &[usize],
    (cameras, lights, rng): (usize, usize, &mut Noise),
    all: &mut Classes,
) {
    let lights = tracer.lights(sources, lights, connects, rng);
    let from = (sources, &lights[..], connects);
    tracer.past_glass(from, &glassy(regions), cameras, rng, |found| {
        let class = 2 + found.ends as usize;
        all[class][regions[found.pixel]][usize::from(found.more)] += found.value;
    });
}

/// Returns the tracer's energies, summed over all classes.
fn traced(tracer: &Tracer, sources: &[Source], regions: &[usize], effort: usize) -> Energies {
    let lights = 1_000 * (effort as f64).sqrt() as usize;
    let batches: Vec<Classes> = (0..BATCHES)
        .into_par_iter()
        .map(|batch| {
            let mut rng = Noise(1_000 + batch);
            let mut all = Classes::default();
            let paths = (12_000 * effort, &mut rng);
            straight(tracer, sources, regions, paths, &mut all);
            let paths = (3_000 * effort, lights, &mut rng);
            let connects = (sources, Connects::NearestToSpot);
            bent(tracer, connects, regions, paths, &mut all);
            all
        })
        .collect();
    for (class, name) in CLASSES.iter().enumerate() {
        let sums: Vec<Sums> = batches.iter().map(|b| b[class]).collect();
        for (part, which) in PARTS.iter().enumerate() {
            let e = joined(&sums);
            let all = e[0][part] + e[1][part] + e[2][part];
            println!("  {name}, {which}: {:.5e} ± {:.1e}", all.mean, all.se);
        }
    }
    let whole = |b: &Classes| -> Sums {
        std::array::from_fn(|r| std::array::from_fn(|part| b.iter().map(|c| c[r][part]).sum()))
    };
    joined(&batches.iter().map(whole).collect::<Vec<_>>())
}

/// Compares and prints both sides, and fails if they differ by more than four standard errors and
/// 0.05 %.
#[track_caller]
fn agrees(name: &str, scene: &Scene) {
    let materials = scene.objects.iter().flat_map(|o| &o.mesh.materials);
    let mirrors = materials.filter(|m| is_mirror(m.bsdf)).count();
    assert_eq!(mirrors, 0, "near-mirrors are not for this test");
    let tracer = Tracer::new(scene);
    let beams: Vec<Vec<Source>> = (0..scene.laser.beams.len())
        .map(|k| tracer.sources(k))
        .collect();
    let sources = beams.concat();
    println!("{name}: {} spots of {} beams", sources.len(), beams.len());
    let regions = regions(&tracer, &sources, Tracer::meets_glass);
    let theirs = traced(&tracer, &sources, &regions, effort());
    // The transmitted part of each beam determines its spot.
    let spots = trace_spots(scene).unwrap();
    for (k, (spot, found)) in spots.iter().zip(&beams).enumerate() {
        let first = P::from(spot.expect("a spot").point) - found[0].p;
        assert!(first.length() < 1e-3, "{name}: spot of beam {k}");
    }
    let ours = rendered(scene, &regions, effort());
    alike(name, "pixels of glass", 2, &ours, &theirs);
}

/// Returns a room with a window in front of its far wall, a slanted partition and a grey ball.
/// Beams pass through both, and four beams hit neither of them first.
fn windows() -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.push(quad(
        v(-1.6, -1.1, -3.8),
        v(3.0, 0.0, 0.0),
        v(0.0, 2.2, 0.0),
        thin(1.5, 1.0, false),
    ));
    objects.push(quad(
        v(-2.0, -1.5, -2.2),
        v(4.0, 0.0, 0.6),
        v(0.0, 2.2, 0.0),
        thin(1.6, 0.8, false),
    ));
    objects.push(sphere(v(1.0, -1.0, -2.9), 0.4, 3, grey(0.3)));
    let beams = [
        v(0.3, 0.3, -3.98),
        v(-2.0, 0.4, -1.6),
        v(0.8, -1.5, -1.1),
        v(-0.9, 1.5, -1.3),
        v(2.0, 0.6, -0.9),
    ];
    scene(objects, PIXELS, &beams)
}

/// Returns a room with a ball of glass and a tinted cube. A beam passes through the ball.
fn ball_and_cube() -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.push(sphere(v(-0.7, -0.5, -2.4), 0.5, 3, body(1.5, 1.0)));
    objects.push(cuboid(
        v(0.8, -0.8, -2.6),
        v(0.4, 0.5, 0.35),
        0.5,
        body(1.45, 0.8),
    ));
    let beams = [
        v(-0.78, -0.45, -2.4),
        v(0.6, 0.7, -4.0),
        v(-2.0, 0.3, -2.0),
        v(0.7, 1.5, -2.2),
    ];
    scene(objects, PIXELS, &beams)
}

/// Returns a room with a hollow vessel and a window with its thickness in the mesh, and a beam
/// through each.
fn vessel() -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let middle = v(-0.6, -0.4, -2.3);
    let outside = sphere(middle, 0.55, 3, body(1.5, 0.95));
    let inside = inverted(&sphere(middle, 0.45, 3, body(1.5, 0.95)));
    objects.push(together(&outside, &inside));
    objects.push(cuboid(
        v(0.9, 0.0, -2.6),
        v(0.7, 0.9, 0.01),
        -0.4,
        thin(1.5, 0.9, true),
    ));
    let beams = [
        v(-0.5, -0.35, -2.3),
        v(0.9, 0.2, -2.6),
        v(-2.0, 0.5, -2.0),
        v(0.2, 1.5, -2.0),
    ];
    scene(objects, PIXELS, &beams)
}

/// Returns a furnished room behind a pane. It is one of the few without any near-mirror.
fn furnished_behind_glass() -> Scene {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let set = FurnishedSettings {
        spots: Spots::Grid(16),
        width: PIXELS,
        height: PIXELS,
        specular_at_least: 0,
        ..FurnishedSettings::default()
    };
    let mut s = furnished::generate(7, &set, &library).unwrap();
    let middle = s.camera.origin + s.camera.forward * 1.2;
    let (right, down) = (s.camera.right, s.camera.down);
    s.objects.push(quad(
        middle - right * 0.85 - down * 0.65,
        right * 1.8 + s.camera.forward * 0.4,
        down * 1.1,
        thin(1.5, 0.8, false),
    ));
    s
}

#[test]
fn a_furnished_room_behind_glass_has_the_energy_of_an_independent_tracer() {
    agrees("furnished 7 behind glass", &furnished_behind_glass());
}

#[test]
fn a_room_with_windows_has_the_energy_of_an_independent_tracer() {
    agrees("windows", &windows());
}

#[test]
fn a_room_with_bodies_of_glass_has_the_energy_of_an_independent_tracer() {
    agrees("ball and cube", &ball_and_cube());
}

#[test]
fn a_room_with_a_vessel_has_the_energy_of_an_independent_tracer() {
    agrees("vessel", &vessel());
}

#[test]
fn either_straight_leg_gives_the_tracer_the_energy_of_paths_bent_at_both_ends() {
    for (name, s) in [
        ("windows", windows()),
        ("ball and cube", ball_and_cube()),
        ("vessel", vessel()),
    ] {
        let tracer = Tracer::new(&s);
        let sources: Vec<Source> = (0..s.laser.beams.len())
            .flat_map(|k| tracer.sources(k))
            .collect();
        let regions = regions(&tracer, &sources, Tracer::meets_glass);
        let [a, b] = [Connects::NearestToSpot, Connects::NearestToCamera].map(|connects| {
            let sums = |batch| {
                let mut all = Classes::default();
                let paths = (8_000, 1_500, &mut Noise(700 + batch));
                bent(&tracer, (&sources, connects), &regions, paths, &mut all);
                all
            };
            let batches: Vec<Classes> = (0..BATCHES).into_par_iter().map(sums).collect();
            let both = |b: &Classes| b[3].iter().map(|r| r[1]).sum::<f64>();
            Energy::of(&batches.iter().map(both).collect::<Vec<_>>())
        });
        near(name, a.mean, b.mean, 0.0, a.se.hypot(b.se));
    }
}
