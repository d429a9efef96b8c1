//! The whole image's energy by exactly two bounces and by three and more, against an independent
//! tracer in f64.
//!
//! The scenes include furnished rooms, and spots close to and in near-mirrors. Pixels with a spot
//! and pixels that see a near-mirror are compared separately. `PICOFARM_EFFORT=64 cargo test
//! --release -p picofarm-transient --test independent -- --nocapture` measures with 64 times the
//! paths: the figures of docs/benchmarks.md. `PICOFARM_RUN=1` and so on are runs with other seeds.

use crate::common;

use common::{
    beam_to,
    brute::Noise,
    compare::{BATCHES, Energies, Sums, alike, effort, joined, regions, rendered, run},
    grey,
    light::{LONGEST, Source, Tracer, is_mirror},
    quad, room, scene, sphere, v,
};
use picofarm_scene::{
    AssetLibrary, Bsdf, Material, Scene, Vec3,
    furnished::{self, FurnishedSettings},
    primitive,
};
use picofarm_settings::{MirrorWall, PrimitiveRooms, Spots};
use picofarm_transient::trace_spots;
use rayon::prelude::*;

const PIXELS: u32 = 64;

fn traced(tracer: &Tracer, sources: &[Source], regions: &[usize], effort: usize) -> Energies {
    let likely: Vec<usize> = (0..regions.len()).filter(|&k| regions[k] == 2).collect();
    let batches: Vec<Sums> = (0..BATCHES)
        .into_par_iter()
        .map(|batch| {
            let mut rng = Noise(1_000 + BATCHES * run() + batch);
            let mut sums = Sums::default();
            for s in sources {
                let share = effort * 2_500 / sources.len();
                for (part, many) in [(0, (8 * share, 2)), (1, (share, LONGEST))] {
                    tracer.carry(s, many, &mut rng, |seen| {
                        if !is_mirror(seen.bsdf) && usize::from(seen.more) == part {
                            sums[regions[seen.pixel]][part] += seen.value;
                        }
                    });
                }
            }
            tracer.glints(sources, effort * 2_500, &mut rng, |pixel, value| {
                sums[regions[pixel]][0] += value;
            });
            tracer.through_mirrors(
                sources,
                &likely,
                effort * 2_500,
                &mut rng,
                |pixel, value| {
                    sums[regions[pixel]][1] += value;
                },
            );
            sums
        })
        .collect();
    joined(&batches)
}

/// Compares and prints both sides, and fails if they differ by more than four standard errors and
/// 0.05 %.
#[track_caller]
fn agrees(name: &str, scene: &Scene, parts: usize) {
    let tracer = Tracer::new(scene);
    let sources: Vec<Source> = (0..scene.laser.beams.len())
        .flat_map(|k| tracer.sources(k))
        .collect();
    let spots = trace_spots(scene).unwrap();
    assert_eq!(
        spots.iter().flatten().count(),
        sources.len(),
        "{name}: spots"
    );
    let regions = regions(&tracer, &sources, |tracer, ray| {
        let hit = tracer.tree.hit(tracer.origin(), ray, f64::INFINITY);
        hit.is_some_and(|h| is_mirror(h.bsdf))
    });
    let ours = rendered(scene, &regions, effort());
    let theirs = traced(&tracer, &sources, &regions, effort());
    alike(name, "pixels of near-mirrors", parts, &ours, &theirs);
}

fn furnished(seed: u64, mirrors: u32) -> Scene {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let set = FurnishedSettings {
        spots: Spots::Grid(25),
        width: PIXELS,
        height: PIXELS,
        specular_at_least: mirrors,
        ..FurnishedSettings::default()
    };
    furnished::generate(seed, &set, &library).unwrap()
}

#[test]
fn furnished_rooms_have_the_energy_of_an_independent_tracer() {
    agrees("furnished 5", &furnished(5, 0), 2);
    agrees("furnished 8", &furnished(8, 0), 2);
    agrees("furnished 21, with a mirror", &furnished(21, 1), 2);
}

#[test]
fn a_room_with_a_mirror_on_its_wall_has_the_energy_of_an_independent_tracer() {
    let set = primitive::PrimitiveSettings {
        spots: Spots::Grid(25),
        width: PIXELS,
        height: PIXELS,
        rooms: PrimitiveRooms {
            mirror_wall: MirrorWall::Back,
            ..PrimitiveRooms::LIVING
        },
        ..primitive::PrimitiveSettings::default()
    };
    agrees("primitive 3", &primitive::generate(3, &set).unwrap(), 2);
}

/// Returns a room with a mirror on its far wall, and beams to the points `beams`.
fn mirrored(beams: &[Vec3]) -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let pane = Material::mirror("pane", 0.01);
    objects.push(quad(
        v(-0.6, -0.8, -3.98),
        v(1.2, 0.0, 0.0),
        v(0.0, 1.6, 0.0),
        pane,
    ));
    objects.push(sphere(v(1.0, -1.0, -2.8), 0.5, 3, grey(0.3)));
    scene(objects, PIXELS, beams)
}

/// Glass that reflects nothing, because near-mirrors together with reflections at glass need the
/// machinery of both sides at once.
///
/// The room has a slanted partition across it, a show-case of single pane faces with a curved
/// near-mirror in it, a window in front of the mirror, and one between the laser and a spot. A spot
/// in a corner behind the partition has a zone. `independent_glass.rs` tests reflecting glass.
#[test]
fn rooms_with_tinted_panes_have_the_energy_of_an_independent_tracer() {
    let glass = |transmittance, face| Material {
        bsdf: Bsdf::ThinDielectric {
            ior: 1.0,
            transmittance,
            face,
        },
        ..Material::glass("glass")
    };
    let beams = [
        v(0.3, 0.3, -3.98),
        v(-2.0, 0.4, -2.5),
        v(0.8, -1.5, -1.8),
        v(-0.9, 1.5, -3.2),
        v(-1.985, 0.9, -4.0),
    ];
    let mut s = mirrored(&beams);
    s.objects.push(quad(
        v(-2.0, -1.5, -2.2),
        v(4.0, 0.0, 0.6),
        v(0.0, 2.2, 0.0),
        glass(0.65, false),
    ));
    // The case is above the floor: if glass is in one plane with a wall, neither side can determine
    // which is in front.
    s.objects.extend(room(
        v(-1.6, -1.49, -3.6),
        v(-0.9, -0.6, -2.9),
        &glass(0.8, true),
    ));
    s.objects.push(quad(
        v(-0.7, -0.9, -3.9),
        v(1.4, 0.0, 0.0),
        v(0.0, 1.8, 0.0),
        glass(0.9, false),
    ));
    s.objects.push(quad(
        v(-0.8, 0.2, -1.2),
        v(0.6, 0.0, 0.0),
        v(0.0, 0.6, 0.3),
        glass(0.4, false),
    ));
    let ball = Material::mirror("ball", 0.05);
    s.objects.push(sphere(v(-1.25, -1.1, -3.25), 0.3, 3, ball));
    let mut rough = furnished(8, 0);
    let middle = rough.camera.origin + rough.camera.forward * 1.2;
    let (right, down) = (rough.camera.right, rough.camera.down);
    rough.objects.push(quad(
        middle - right * 0.9 - down * 0.7,
        right * 1.8 + rough.camera.forward * 0.4,
        down * 1.1,
        glass(0.7, false),
    ));
    agrees("glass", &s, 2);
    agrees("furnished 8 behind glass", &rough, 2);
}

#[test]
fn spots_beside_a_mirror_and_folded_by_it_have_the_energy_of_an_independent_tracer() {
    // 1 and 5 cm from the mirror's edges, onto the wall behind it; two beams that the mirror folds;
    // one far from it.
    let beams = [
        v(0.61, 0.2, -4.0),
        v(0.1, 0.85, -4.0),
        v(0.3, 0.3, -3.98),
        v(-0.2, -0.4, -3.98),
        v(-2.0, 0.4, -2.5),
    ];
    agrees("beside a mirror", &mirrored(&beams), 2);
}

#[test]
fn a_spot_on_a_mirror_has_the_energy_of_an_independent_tracer() {
    // A mirror on the left wall reflects the beam onto the far one.
    let mut s = mirrored(&[]);
    let pane = Material::mirror("pane", 0.01);
    s.objects.push(quad(
        v(-1.98, -0.5, -3.0),
        v(0.0, 1.0, 0.0),
        v(0.0, 0.0, 1.0),
        pane,
    ));
    let object = s.objects.len() as u32 - 1;
    s.laser
        .beams
        .push(beam_to(v(-1.98, 0.2, -2.6), v(1.0, 0.0, 0.0), object));
    agrees("on a mirror", &s, 1);
}

#[test]
fn glints_of_curved_and_angled_mirrors_have_the_energy_of_an_independent_tracer() {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let pane = |alpha| Material::mirror("pane", alpha);
    objects.push(quad(
        v(-1.8, -1.2, -3.6),
        v(1.1, 0.0, -0.2),
        v(0.0, 2.0, 0.0),
        pane(0.01),
    ));
    objects.push(quad(
        v(1.4, -1.2, -3.6),
        v(0.4, 0.0, 1.2),
        v(0.0, 2.0, 0.0),
        pane(0.002),
    ));
    objects.push(sphere(v(0.3, -0.9, -2.4), 0.4, 4, pane(0.01)));
    let beams = [
        v(0.75, 0.55, -1.0),
        v(-0.8, -0.5, -1.0),
        v(-0.3, 0.35, -1.0),
        v(0.05, -0.1, -1.0),
    ];
    // Some light of three bounces and more is found by chance alone here, on both sides.
    agrees("angled", &scene(objects, PIXELS, &beams), 1);
}
