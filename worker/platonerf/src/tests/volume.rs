//! Closed forms of volume rendering.

use burn::tensor::Device;

use crate::{
    network::host,
    render::{matrix, volume},
};

/// Renders a slab of density σ between two distances, with even samples.
fn slab(density: f32, from: f32, to: f32) -> (f32, f32) {
    let device = Device::flex();
    let n = 4001;
    let z: Vec<f32> = (0..n)
        .map(|k| 0.1 + 3.9 * k as f32 / (n - 1) as f32)
        .collect();
    let inside = |z: &f32| if (from..to).contains(z) { density } else { 0.0 };
    let densities: Vec<f32> = z.iter().map(inside).collect();
    let of = |v: &[f32]| matrix(v, [1, n], &device);
    let rendered = volume(of(&densities), of(&z));
    (host(rendered.depth)[0], host(rendered.transmittance)[0])
}

#[test]
fn a_slab_has_the_depth_and_transmittance_of_its_closed_form() {
    for (density, from, to) in [(0.7f32, 1.0f32, 2.5f32), (5.0, 1.0, 1.5), (30.0, 2.0, 3.0)] {
        let (depth, through) = slab(density, from, to);
        let (s, l) = (f64::from(density), f64::from(to - from));
        let passed = (-s * l).exp();
        // ∫ σ e^(−σ(z−a)) z dz from a to b.
        let want = (f64::from(from) + 1.0 / s) - passed * (f64::from(to) + 1.0 / s);
        assert!(
            (f64::from(through) - passed).abs() < 2e-3,
            "T {through} {passed}"
        );
        assert!((f64::from(depth) - want).abs() < 3e-3, "D {depth} {want}");
    }
}

#[test]
fn the_last_two_samples_stop_nothing_and_the_last_takes_the_rest() {
    let device = Device::flex();
    let z = [1.0, 2.0, 3.0, 4.0f32];
    for (densities, through, depth) in [
        ([0.0, 0.0, 9.0, 9.0f32], 1.0, 3.0),
        ([0.0, 0.0, 0.0, 1.0], 1.0, 4.0),
        ([0.0, 0.0, 0.0, 0.0], 1.0, 0.0),
        ([9.0, 0.0, 0.0, 0.0], (-9.0f32).exp(), 1.0),
    ] {
        let rendered = volume(
            matrix(&densities, [1, 4], &device),
            matrix(&z, [1, 4], &device),
        );
        let (t, d) = (host(rendered.transmittance)[0], host(rendered.depth)[0]);
        assert!(
            (t - through).abs() < 1e-5 && (d - depth).abs() < 1e-3,
            "{t} {d}"
        );
    }
}
