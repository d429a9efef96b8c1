//! Tests the stored errors against the spread over many seeds of the same small render.

use crate::hard_scenes as scenes;

use crate::common;

use std::sync::OnceLock;

use common::{energy, ok, settings};
use picofarm_scene::{Scene, primitive};
use picofarm_settings::{MirrorWall, PrimitiveRooms, Spots};
use picofarm_transient::{Budget, Gate, Rendered, Settings};

const SIZE: usize = 16;
const BINS: usize = 637;
const SEEDS: u64 = 100;

fn gate() -> Gate {
    Gate {
        start_m: 1.0,
        bin_width_m: 0.0384,
        bins: BINS as u32,
    }
}

/// Returns a furnished room with four spots.
fn room() -> Scene {
    let set = primitive::PrimitiveSettings {
        spots: Spots::Grid(4),
        width: SIZE as u32,
        height: SIZE as u32,
        rooms: PrimitiveRooms {
            mirror_wall: MirrorWall::None,
            ..PrimitiveRooms::LIVING
        },
        ..primitive::PrimitiveSettings::default()
    };
    primitive::generate(5, &set).unwrap()
}

fn with(seed: u64, budget: Budget) -> Settings {
    Settings {
        seed,
        gate: gate(),
        ..settings(budget)
    }
}

struct Runs {
    all: Vec<Rendered>,
    /// Mean histogram.
    mean: Vec<f64>,
}

fn runs() -> &'static Runs {
    static RUNS: OnceLock<Runs> = OnceLock::new();
    RUNS.get_or_init(|| {
        let s = room();
        println!("{} triangles", s.triangle_count());
        let all: Vec<Rendered> = (0..SEEDS)
            .map(|k| ok(&s, &with(k, Budget::Samples(16))))
            .collect();
        let mut mean = vec![0.0; all[0].transient.len()];
        for r in &all {
            for (m, &h) in mean.iter_mut().zip(&r.transient) {
                *m += f64::from(h) / SEEDS as f64;
            }
        }
        Runs { all, mean }
    })
}

/// Returns the ratio of the variance from the truth to the variance from a mean of n.
fn unbias() -> f64 {
    SEEDS as f64 / (SEEDS as f64 - 1.0)
}

#[test]
fn the_rms_of_deviations_over_stored_errors_is_one() {
    let Runs { all, mean } = runs();
    let highest = mean.iter().fold(0.0f64, |a, &b| a.max(b));
    // Bins with a signal: all bins above 10⁻⁴ of the highest, and the brighter ones separately.
    for (floor, tolerance) in [(1e-4, 0.1), (1e-2, 0.15)] {
        let (mut sum, mut count, mut emp, mut est) = (0.0, 0.0, 0.0, 0.0);
        for r in all {
            let s = r.split.as_ref().unwrap();
            for (i, &m) in mean.iter().enumerate() {
                if m < floor * highest {
                    continue;
                }
                let variance = f64::from(s.two_se[i]).powi(2) + f64::from(s.multi_se[i]).powi(2);
                let d2 = (f64::from(r.transient[i]) - m).powi(2) * unbias();
                sum += d2 / variance;
                count += 1.0;
                emp += d2;
                est += variance;
            }
        }
        let rms = f64::sqrt(sum / count);
        println!(
            "bins above {floor:e}: {:.0} a render, rms {rms:.4}, of sums {:.4}",
            count / SEEDS as f64,
            f64::sqrt(emp / est)
        );
        assert!(
            (rms - 1.0).abs() < tolerance,
            "bins above {floor:e}: rms {rms}"
        );
    }
}

#[test]
fn the_noise_draw_predicts_the_variance_of_sums_over_blocks() {
    let Runs { all, .. } = runs();
    let (side, wide) = (8, 13);
    let sums = |h: &[f32]| -> Vec<f64> {
        let blocks = SIZE / side;
        let groups = BINS / wide;
        let mut out = vec![0.0; blocks * blocks * groups];
        for (k, pixel) in h.chunks(BINS).enumerate() {
            let block = k / SIZE / side * blocks + k % SIZE / side;
            for (b, &x) in pixel[..groups * wide].iter().enumerate() {
                out[block * groups + b / wide] += f64::from(x);
            }
        }
        out
    };
    let parts: Vec<_> = all
        .iter()
        .map(|r| {
            let s = r.split.as_ref().unwrap();
            let own: Vec<f32> = s.multi_se.iter().map(|x| x * x).collect();
            (sums(&s.multi), sums(&s.multi_noise), sums(&own))
        })
        .collect();
    let n = SEEDS as f64;
    let (mut spread, mut claimed, mut alone) = (0.0, 0.0, 0.0);
    let mut ratios = vec![];
    for i in 0..parts[0].0.len() {
        let mean = parts.iter().map(|p| p.0[i]).sum::<f64>() / n;
        let got = parts.iter().map(|p| (p.0[i] - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let says = parts.iter().map(|p| p.1[i].powi(2)).sum::<f64>() / n;
        spread += got;
        claimed += says;
        alone += parts.iter().map(|p| p.2[i]).sum::<f64>() / n;
        if mean > 0.0 && got > 0.0 {
            ratios.push(says / got);
        }
    }
    ratios.sort_by(f64::total_cmp);
    let median = ratios[ratios.len() / 2];
    println!(
        "variance claimed / found: all {:.3}, median of {} sums {median:.3}; by multi_se alone {:.3}",
        claimed / spread,
        ratios.len(),
        alone / spread
    );
    assert!(
        (0.75..1.33).contains(&(claimed / spread)),
        "{}",
        claimed / spread
    );
    assert!((0.7..1.4).contains(&median), "{median}");
}

/// Returns the median over pixels of ‖h − mean‖ / ‖mean‖ of one render.
fn true_median(h: &[f32], mean: &[f64]) -> f64 {
    let mut all: Vec<f64> = h
        .chunks(BINS)
        .zip(mean.chunks(BINS))
        .map(|(h, m)| {
            let d2: f64 = h
                .iter()
                .zip(m)
                .map(|(&x, y)| (f64::from(x) - y).powi(2))
                .sum();
            (d2 / m.iter().map(|y| y * y).sum::<f64>()).sqrt()
        })
        .collect();
    all.sort_by(f64::total_cmp);
    all[all.len() / 2]
}

#[test]
fn median_and_total_errors_agree_with_the_scatter_over_seeds() {
    let Runs { all, mean } = runs();
    let n = SEEDS as f64;
    let truth = all
        .iter()
        .map(|r| true_median(&r.transient, mean))
        .sum::<f64>()
        / n
        * unbias().sqrt();
    let says = all
        .iter()
        .map(|r| f64::from(r.error.median_relative))
        .sum::<f64>()
        / n;
    println!("median: says {says:.4}, is {truth:.4}");
    assert!((says / truth - 1.0).abs() < 0.15);
    let totals: Vec<f64> = all.iter().map(|r| energy(&r.transient)).collect();
    let whole = totals.iter().sum::<f64>() / n;
    let spread =
        (totals.iter().map(|t| (t - whole).powi(2)).sum::<f64>() / (n - 1.0)).sqrt() / whole;
    let squares = all
        .iter()
        .map(|r| f64::from(r.error.total_relative).powi(2))
        .sum::<f64>();
    let says = (squares / n).sqrt();
    println!("total: says {says:.5}, is {spread:.5}");
    assert!((says / spread - 1.0).abs() < 0.15);
}

#[test]
fn a_budget_of_ten_per_cent_ends_at_a_true_median_error_of_ten_per_cent() {
    let mean = &runs().mean;
    let s = room();
    let (mut truth, count) = (0.0, 6);
    for seed in 0..count {
        let r = ok(&s, &with(1000 + seed, Budget::Error(0.1)));
        let got = true_median(&r.transient, mean);
        println!(
            "{} passes: says {:.4}, is {got:.4}",
            r.error.samples, r.error.median_relative
        );
        assert!(r.error.median_relative <= 0.1);
        truth += got / count as f64;
    }
    assert!((0.08..0.12).contains(&truth), "{truth}");
}

/// Renders a hard room at 24×24 with 32 paths, and returns the stated median error, the true one,
/// and that of the standard errors. The reference has `longer` times as many paths.
fn medians(name: &str, longer: u32) -> [f64; 3] {
    const SIDE: u32 = 24;
    const PATHS: u32 = 32;
    let rooms = scenes::all(SIDE).into_iter();
    let (_, room) = rooms.filter(|(of, _)| of == name).last().unwrap();
    let truth = ok(&room, &with(1000, Budget::Samples(longer * PATHS))).transient;
    let truth: Vec<f64> = truth.into_iter().map(f64::from).collect();
    let all: Vec<Rendered> = (0..6)
        .map(|k| ok(&room, &with(k, Budget::Samples(PATHS))))
        .collect();
    let mean = |of: &dyn Fn(&Rendered) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
    let says = mean(&|r| f64::from(r.error.median_relative));
    let standard = mean(&|r| {
        let split = r.split.as_ref().unwrap();
        let noise: Vec<f32> = (0..truth.len())
            .map(|i| truth[i] as f32 + split.multi_se[i].hypot(split.two_se[i]))
            .collect();
        true_median(&noise, &truth)
    });
    // The reference has an error as well.
    let is = mean(&|r| true_median(&r.transient, &truth));
    let is = is / (1.0 + 1.0 / f64::from(longer)).sqrt();
    println!("{name}: says {says:.4}, is {is:.4}; standard errors {standard:.4}");
    [says, is, standard]
}

#[test]
fn the_median_error_holds_where_the_bins_of_a_pixel_err_together() {
    let [says, is, standard] = medians("far-03", 16);
    assert!((says / is - 1.0).abs() < 0.1, "says {says}, is {is}");
    // Paths that contribute to many bins make the standard errors too large for most pixels.
    assert!(standard > 1.15 * is, "{standard} {is}");
}

#[test]
fn the_median_error_holds_where_light_paths_are_drawn_into_the_image() {
    let [says, is, standard] = medians("bodies", 64);
    assert!((says / is - 1.0).abs() < 0.1, "says {says}, is {is}");
    // Few light paths reach a pixel, and some contribute much.
    assert!(standard > 1.25 * is, "{standard} {is}");
}
