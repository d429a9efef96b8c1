//! Verdicts on right and wrong calibrations of captures that show much, little or nothing: a line
//! for each capture. A verdict that is wrong itself ends with `FALSE`.
//!
//! In the environment: `SIDES` (32,64), `SPOTS` (1,4,16,25), `WIDTHS` (1,4,16 bins of 6 mm in one),
//! `PHOTONS` (3,100; of the brightest bin of the median pixel and one spot), `SEEDS` (7), `SUMS`
//! (set: captures of all spots at once).

#[path = "../tests/it/common/mod.rs"]
mod common;

use std::{env, fmt::Display, str::FromStr, time::Instant};

use common::Room;
use picofarm_calibrate::{Measurement, Verdict, check};
use picofarm_transient::Gate;

fn list<T: FromStr + Display>(name: &str, usual: &str) -> Vec<T> {
    let text = env::var(name).unwrap_or_else(|_| usual.into());
    let parse = |part: &str| {
        part.parse()
            .unwrap_or_else(|_| panic!("{name}={text:?} cannot be read; see the example's head"))
    };
    text.split(',').map(parse).collect()
}

fn main() {
    let sums = env::var_os("SUMS").is_some();
    let fine = Gate {
        start_m: 1.0,
        bin_width_m: 0.006,
        bins: 2048,
    };
    let (mut all, mut odd) = (0, 0);
    for seed in list::<u64>("SEEDS", "7") {
        for side in list::<u32>("SIDES", "32,64") {
            for spots in list::<u32>("SPOTS", "1,4,16,25") {
                let room = Room::in_gate(seed, side, 0, spots, fine);
                for width in list::<u32>("WIDTHS", "1,4,16") {
                    for photons in list::<f64>("PHOTONS", "3,100") {
                        let plain = room.measure_in(width, photons, 1, |_| {});
                        for (name, capture, right) in common::doubts(&plain, !sums) {
                            let begun = Instant::now();
                            let found = check(&Measurement {
                                capture: capture.capture(),
                                per_spot: (!sums).then_some(&capture.per_spot),
                                masks: None,
                                pulses: None,
                            })
                            .expect("a capture");
                            let report = found.report;
                            let causes: Vec<String> = report
                                .causes
                                .iter()
                                .map(|c| format!("{:?} {:.2}", c.fault, c.value))
                                .collect();
                            let bad = match right {
                                Some(true) => report.verdict == Verdict::Wrong,
                                Some(false) => report.verdict == Verdict::Good,
                                None => matches!(report.verdict, Verdict::Good | Verdict::Usable),
                            };
                            all += 1;
                            odd += u32::from(bad);
                            println!(
                                "{seed} {side}px {spots} spots, {:.0} mm, {photons} photons: {name}: {} [{}] {:.2} {:.1}s{}",
                                6 * width,
                                report.verdict.name(),
                                causes.join(", "),
                                report.stated.map_or(f64::NAN, |s| s.share),
                                begun.elapsed().as_secs_f64(),
                                if bad { " FALSE" } else { "" }
                            );
                        }
                    }
                }
            }
        }
    }
    println!("{odd} of {all} verdicts are wrong");
}
