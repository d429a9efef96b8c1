#[path = "../tests/it/common/mod.rs"]
mod common;
use common::*;
use picofarm_calibrate::{Measurement, check};
fn main() {
    let arg = |n: usize, d: f64| std::env::args().nth(n).map_or(d, |s| s.parse().unwrap());
    let room = Room::new(arg(2, 7.0) as u64, arg(1, 48.0) as u32, arg(4, 0.0) as u32);
    let c = room.measure(arg(3, 100.0), 1, |_| {});
    for (name, c, masks, pulses) in common::faults(&room, &c) {
        let t = std::time::Instant::now();
        let m = Measurement { capture: c.capture(), per_spot: Some(&c.per_spot), masks: Some(&masks), pulses };
        let r = check(&m).unwrap();
        println!("=== {name}: {:?} {:?}, stated {:.3} {:.1} mm corrected {:.3} {:.1} mm, fwhm {:.0} ps, bg {:?}, t0 off {:.3} bins laser off {:.1} mm", r.report.verdict, t.elapsed(),
            r.report.stated.unwrap().share, 1e3 * r.report.stated.unwrap().rms_m, r.report.corrected.unwrap().share, 1e3 * r.report.corrected.unwrap().rms_m, r.report.pulse.map_or(0.0, |p| p.fwhm_ps), r.report.background,
            (r.corrected.gate.start_m - GATE.start_m) / GATE.bin_width_m, 1e3 * (r.corrected.laser - room.laser).length());
        for c in &r.report.causes { println!("   {:?} {:?}: {}", c.severity, c.fault, c.finding); }
        if std::env::var_os("V").is_some() { for n in &r.report.notes { println!("   note: {n}"); } }
    }
}
