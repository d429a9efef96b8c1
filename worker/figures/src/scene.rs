//! Pictures of stored scenes: a contact sheet and light in flight.

mod flight;
mod sheet;

pub use flight::flight;
pub use sheet::sheet;

/// One stored scene, decoded. Images are `[row][column]`.
pub struct View {
    /// Scene index.
    pub scene: u64,
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Number of bins of a histogram.
    pub bins: usize,
    /// Path length at the first bin's start, metres.
    pub gate_start_m: f64,
    /// Path length of a bin, metres.
    pub bin_width_m: f64,
    /// `[row][column][bin]`.
    pub transient: Vec<f32>,
    /// z-depth in metres; 0 = nothing.
    pub depth: Vec<f32>,
    /// sRGB, `[row][column][3]`.
    pub rgb: Vec<u8>,
    /// 1 = a mirror.
    pub specular: Vec<u8>,
    /// `[spot][row][column]`, 1 = lit.
    pub visibility: Vec<u8>,
    /// Image position in pixels of each spot; `None` if there is none or it is behind the camera.
    pub spots: Vec<Option<[f32; 2]>>,
}

impl View {
    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Returns the sum over the bins `lo..hi` for each pixel.
    pub fn slice(&self, lo: usize, hi: usize) -> Vec<f32> {
        self.transient
            .chunks_exact(self.bins)
            .map(|h| h[lo..hi].iter().sum())
            .collect()
    }

    /// Returns the time of a bin's start, in nanoseconds after the pulse.
    pub fn nanoseconds(&self, bin: usize) -> f64 {
        (self.gate_start_m + bin as f64 * self.bin_width_m) / 0.299_792_458
    }

    /// Returns the energy of each bin over the image, without the brightest pixels: the one-bounce
    /// spots.
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

/// Returns the q-quantile of the values (0 for none).
pub fn quantile(values: &[f32], q: f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let mut sorted = values.to_vec();
    let k = ((sorted.len() - 1) as f64 * q) as usize;
    *sorted.select_nth_unstable_by(k, f32::total_cmp).1
}
