//! Pictures of stored scenes, for people: a contact sheet and light in flight.

pub mod flight;
pub mod sheet;

use picofarm_figures::Canvas;

use crate::error::{CliError, Code, Result};

/// One stored scene, decoded. Images are `[row][column]`.
pub struct View {
    pub scene: u64,
    pub width: usize,
    pub height: usize,
    pub bins: usize,
    pub gate_start_m: f64,
    pub bin_width_m: f64,
    /// `[row][column][bin]`.
    pub transient: Vec<f32>,
    pub depth: Vec<f32>,
    /// sRGB, `[row][column][3]`.
    pub rgb: Vec<u8>,
    pub specular: Vec<u8>,
    /// `[spot][row][column]`, 1 = lit.
    pub visibility: Vec<u8>,
    /// Film position in pixels of each spot; `None` if there is none or it lies behind the camera.
    pub spots: Vec<Option<[f32; 2]>>,
}

impl View {
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Sum over the bins `lo..hi` for each pixel.
    pub fn slice(&self, lo: usize, hi: usize) -> Vec<f32> {
        self.transient
            .chunks_exact(self.bins)
            .map(|h| h[lo..hi].iter().sum())
            .collect()
    }

    /// Time of a bin's start, nanoseconds after the pulse.
    pub fn nanoseconds(&self, bin: usize) -> f64 {
        (self.gate_start_m + bin as f64 * self.bin_width_m) / 0.299_792_458
    }

    /// Energy of each bin over the image, leaving out the brightest pixels: the one-bounce spots.
    pub fn energy_by_bin(&self) -> Vec<f64> {
        let intensity = self.slice(0, self.bins);
        let limit = quantile(&intensity, 0.99);
        let mut energy = vec![0.0; self.bins];
        let kept = self
            .transient
            .chunks_exact(self.bins)
            .zip(&intensity)
            .filter(|(_, i)| **i <= limit);
        for (h, _) in kept {
            for (e, v) in energy.iter_mut().zip(h) {
                *e += f64::from(*v);
            }
        }
        energy
    }
}

/// The q-quantile of the values (0 for none).
pub fn quantile(values: &[f32], q: f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let mut sorted = values.to_vec();
    let k = ((sorted.len() - 1) as f64 * q) as usize;
    *sorted.select_nth_unstable_by(k, f32::total_cmp).1
}

pub(crate) fn cannot_write(path: &std::path::Path, error: impl std::fmt::Display) -> CliError {
    CliError::new(
        Code::Resource,
        format!("cannot write {}: {error}", path.display()),
    )
    .hint("check the folder and the free space, then run the same command again")
}

/// Writes a picture as PNG, whole or not at all.
///
/// # Errors
/// The file cannot be written.
pub fn save(canvas: &Canvas, path: &std::path::Path) -> Result<()> {
    write_atomically(path, &canvas.png())
}

/// Writes a file whole or not at all.
pub(crate) fn write_atomically(path: &std::path::Path, bytes: &[u8]) -> Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let partial = path.with_file_name(format!(".{name}.partial"));
    std::fs::write(&partial, bytes)
        .and_then(|()| std::fs::rename(&partial, path))
        .map_err(|e| {
            // The partial file is ours; nothing is lost if it cannot be removed.
            let _ = std::fs::remove_file(&partial);
            cannot_write(path, e)
        })
}
