//! Compares the renderer's energy with the independent tracer's, by regions of the image and by
//! bounces.

use picofarm_scene::Scene;
use picofarm_transient::{Budget, Gate, Settings};

use super::{
    brute::P,
    energy,
    light::{Energy, Source, Tracer},
    ok, settings,
};

/// The number of independent estimates on each side.
pub const BATCHES: u64 = 16;
pub const PARTS: [&str; 2] = ["two", "more"];

/// `[region][part]`: the regions are other pixels, pixels of spots, and a third kind.
pub type Sums = [[f64; 2]; 3];
pub type Energies = [[Energy; 2]; 3];

pub fn effort() -> usize {
    whole("PICOFARM_EFFORT", "1") as usize
}

/// Returns the index of this run among independent runs.
pub fn run() -> u64 {
    whole("PICOFARM_RUN", "0")
}

fn whole(name: &str, default: &str) -> u64 {
    let text = std::env::var(name).unwrap_or_else(|_| default.into());
    text.parse()
        .unwrap_or_else(|_| panic!("{name} is a whole number"))
}

pub fn joined(batches: &[Sums]) -> Energies {
    std::array::from_fn(|region| {
        std::array::from_fn(|part| {
            Energy::of(&batches.iter().map(|b| b[region][part]).collect::<Vec<_>>())
        })
    })
}

/// Returns the region of each pixel: 1 if it contains a spot, 2 if a ray through one of nine points
/// of it is of the third kind.
pub fn regions(
    tracer: &Tracer,
    sources: &[Source],
    third: impl Fn(&Tracer, P) -> bool,
) -> Vec<usize> {
    let i = &tracer.scene.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let mut all: Vec<usize> = (0..width * height)
        .map(|k| {
            let mut corners = (0..9).map(|c| (k % width, k / width, c % 3, c / 3));
            let seen = corners.any(|(x, y, i, j)| {
                let at = (x as f64 + 0.5 * f64::from(i), y as f64 + 0.5 * f64::from(j));
                third(tracer, tracer.ray(at))
            });
            2 * usize::from(seen)
        })
        .collect();
    for s in sources {
        if let Some(at) = tracer
            .film(s.p)
            .filter(|_| tracer.tree.free(tracer.origin(), s.p))
        {
            all[tracer.pixel(at)] = 1;
        }
    }
    all
}

pub fn rendered(scene: &Scene, regions: &[usize], effort: usize) -> Energies {
    let batches: Vec<Sums> = (0..BATCHES)
        .map(|seed| {
            let set = Settings {
                seed: BATCHES * run() + seed,
                gate: Gate {
                    start_m: 0.0,
                    bin_width_m: 1.0,
                    bins: 400,
                },
                ..settings(Budget::Samples(3 * effort as u32))
            };
            let r = ok(scene, &set);
            let split = r.split.expect("a split was asked for");
            let mut sums = Sums::default();
            for (part, h) in [&split.two, &split.multi].into_iter().enumerate() {
                for (pixel, h) in h.chunks_exact(400).enumerate() {
                    sums[regions[pixel]][part] += energy(h);
                }
            }
            sums
        })
        .collect();
    joined(&batches)
}

/// Prints both sides, and fails if they differ by more than four standard errors and 0.05 %.
#[track_caller]
pub fn alike(name: &str, third: &str, parts: usize, ours: &Energies, theirs: &Energies) {
    let names = ["other pixels", "pixels of spots", third];
    for part in 0..parts {
        let all = |e: &Energies| e[0][part] + e[1][part] + e[2][part];
        let rows = (0..3).map(|k| (names[k], ours[k][part], theirs[k][part]));
        let whole = all(theirs).mean;
        for (region, a, b) in rows.chain([("whole image", all(ours), all(theirs))]) {
            // Far tails of lobes, far below the precision of a sum of f32.
            if a.mean.max(b.mean) < 1e-9 * whole {
                continue;
            }
            let se = a.se.hypot(b.se);
            println!(
                "{name}, {}, {region} ({:.1} %): {:+.3} % ± {:.3} % (ours {:.3} %), z {:+.2}",
                PARTS[part],
                100.0 * b.mean / whole,
                100.0 * (a.mean / b.mean - 1.0),
                100.0 * se / b.mean,
                100.0 * a.se / b.mean,
                (a.mean - b.mean) / se
            );
            let slack = 5e-4 * b.mean + 4.0 * se;
            assert!(
                (a.mean - b.mean).abs() <= slack,
                "{name}, {}, {region}",
                PARTS[part]
            );
        }
    }
}
