//! The materials that our own furniture shares; each is drawn from a variant's random stream.

use crate::{Material, rng::Rng};

fn tinted(rng: &mut Rng, name: &str, base: [f32; 3], lo: f32, hi: f32) -> Material {
    let level = rng.range(lo, hi);
    let rgb = base.map(|c| (c * level * rng.range(0.92, 1.08)).clamp(0.03, 0.92));
    Material::diffuse(name, rgb)
}

/// Light to dark wood.
pub(super) fn wood(rng: &mut Rng) -> Material {
    tinted(rng, "wood", [0.75, 0.55, 0.38], 0.45, 1.1)
}

/// Painted board: near white, sometimes dark.
pub(super) fn paint(rng: &mut Rng) -> Material {
    if rng.chance(0.25) {
        tinted(rng, "paint", [0.3, 0.32, 0.36], 0.5, 1.4)
    } else {
        tinted(rng, "paint", [0.85, 0.84, 0.8], 0.8, 1.05)
    }
}

/// Wood or paint, the usual materials of furniture.
pub(super) fn board(rng: &mut Rng) -> Material {
    if rng.chance(0.6) {
        wood(rng)
    } else {
        paint(rng)
    }
}

/// Cloth of any colour.
pub(super) fn cloth(rng: &mut Rng) -> Material {
    let base = *rng.pick(&[
        [0.7, 0.68, 0.62],
        [0.35, 0.42, 0.55],
        [0.6, 0.3, 0.25],
        [0.35, 0.5, 0.38],
        [0.4, 0.4, 0.42],
        [0.75, 0.6, 0.35],
    ]);
    tinted(rng, "cloth", base, 0.7, 1.15)
}

/// Bed linen.
pub(super) fn linen(rng: &mut Rng) -> Material {
    tinted(rng, "linen", [0.85, 0.85, 0.82], 0.85, 1.05)
}

/// Plastic or coated metal, mostly dark.
pub(super) fn plastic(rng: &mut Rng) -> Material {
    tinted(rng, "plastic", [0.35, 0.35, 0.37], 0.4, 1.8)
}

/// Glazed clay of any colour.
pub(super) fn ceramic(rng: &mut Rng) -> Material {
    let base = *rng.pick(&[
        [0.85, 0.84, 0.8],
        [0.35, 0.5, 0.6],
        [0.7, 0.45, 0.3],
        [0.5, 0.6, 0.45],
    ]);
    tinted(rng, "ceramic", base, 0.8, 1.1)
}

/// Leaves.
pub(super) fn leaf(rng: &mut Rng) -> Material {
    tinted(rng, "leaf", [0.25, 0.5, 0.2], 0.7, 1.3)
}

/// Bright colours for covers, toys and fruit.
pub(super) fn bright(rng: &mut Rng) -> Material {
    let base = *rng.pick(&[
        [0.75, 0.2, 0.18],
        [0.2, 0.35, 0.7],
        [0.85, 0.7, 0.2],
        [0.3, 0.6, 0.3],
        [0.8, 0.5, 0.2],
        [0.8, 0.78, 0.7],
    ]);
    tinted(rng, "colour", base, 0.75, 1.1)
}
