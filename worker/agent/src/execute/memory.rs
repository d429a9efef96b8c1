//! How much memory a render takes, and whether this machine has it.

use std::fs;

use picofarm_transient::Settings;

/// Share of the machine's memory that a render may take.
const SHARE: f64 = 0.75;
/// Pixels of the tiles that each thread works on, and the sums it keeps of each slot.
const TILE_PIXELS: u64 = 256;
const TILE_SUMS: u64 = 3;

/// Bytes that the histograms of a render of `width`×`height` pixels take, those of its threads' tiles included.
pub fn render_bytes(settings: &Settings, width: u32, height: u32, threads: usize) -> u64 {
    let histogram = 4 * u64::from(settings.gate.bins);
    let (groups, pixels) = (
        settings.groups.len() as u64,
        u64::from(width) * u64::from(height),
    );
    let parts = if settings.split { 5 } else { 0 };
    let image = pixels * histogram * (1 + groups + parts);
    let tile = TILE_PIXELS.min(pixels) * histogram * (1 + groups) * TILE_SUMS;
    image + tile * threads as u64
}

/// Checks that a render fits into three quarters of this machine's memory, where the system tells how much there is.
///
/// # Errors
/// A message with what is needed, what is there, and how to mend it.
pub fn check_memory(
    settings: &Settings,
    width: u32,
    height: u32,
    threads: usize,
) -> Result<(), String> {
    let needed = render_bytes(settings, width, height, threads);
    match memory() {
        Some(there) if needed as f64 > SHARE * there as f64 => Err(format!(
            "{} histograms of {width}x{height} pixels x {} bins take {:.1} GB of memory, more than three quarters of \
             this machine's {:.1} GB; ask for fewer of them, or for fewer pixels or bins",
            1 + settings.groups.len(),
            settings.gate.bins,
            needed as f64 / 1e9,
            there as f64 / 1e9,
        )),
        _ => Ok(()),
    }
}

/// MiB of memory that tasks may take on this machine; 0 where the system does not tell.
pub fn memory_mib() -> u64 {
    memory().map_or(0, |bytes| (SHARE * bytes as f64) as u64 >> 20)
}

/// Bytes of memory of this machine, or of the control group that this process is in, whichever is less.
fn memory() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemTotal:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    let limit = fs::read_to_string("/sys/fs/cgroup/memory.max").ok();
    let limit = limit.and_then(|l| l.trim().parse().ok());
    Some((kib * 1024).min(limit.unwrap_or(u64::MAX)))
}

#[cfg(test)]
mod tests {
    use picofarm_transient::{Budget, Gate, Strategy};

    use super::*;

    #[test]
    fn a_render_that_no_machine_holds_is_refused_with_what_it_takes() {
        let mut settings = Settings {
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 0.0384,
                bins: 637,
            },
            budget: Budget::Samples(4),
            max_bounces: None,
            one_bounce: true,
            seed: 0,
            split: false,
            groups: vec![],
            strategy: Strategy::default(),
        };
        assert_eq!(check_memory(&settings, 16, 16, 2), Ok(()));
        settings.groups = (0..100).map(|beam| vec![beam]).collect();
        let bytes = render_bytes(&settings, 256, 256, 1) as f64;
        assert!((16.8e9..17.2e9).contains(&bytes), "{bytes}");
        if memory().is_some() {
            let refused = check_memory(&settings, 16_384, 16_384, 1).unwrap_err();
            assert!(
                refused.contains("101 histograms of 16384x16384"),
                "{refused}"
            );
        }
    }
}
