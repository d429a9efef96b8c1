//! Our own furniture: which builders there are, and the materials they share.
//!
//! Every builder draws its dimensions from a variant's own random stream, so variant k of a category is
//! the same piece for ever. Front is +z, units are metres, y is up.

use crate::{Material, Mesh, rng::Rng};

use super::{devices, small, storage, upholstery};

/// A builder of one variant.
pub(super) type Build = fn(&mut Rng) -> Mesh;

/// (category, number of variants, builder), in the order that fixes the variants' seeds: append only.
pub(super) fn catalogue() -> Vec<(&'static str, u64, Build)> {
    vec![
        ("sofa", 8, upholstery::sofa),
        ("armchair", 8, upholstery::armchair),
        ("stool", 6, upholstery::stool),
        ("bed", 8, upholstery::bed),
        ("chair", 10, upholstery::chair),
        ("coffee_table", 8, storage::coffee_table),
        ("table", 10, storage::table),
        ("desk", 8, storage::desk),
        ("nightstand", 6, storage::nightstand),
        ("tv_stand", 6, storage::tv_stand),
        ("bookcase", 8, storage::bookcase),
        ("shelf", 6, storage::shelf),
        ("wardrobe", 6, storage::wardrobe),
        ("dresser", 6, storage::dresser),
        ("cabinet", 8, storage::cabinet),
        ("kitchen_appliance", 6, storage::kitchen_appliance),
        ("sink", 4, storage::sink),
        ("piano", 2, storage::piano),
        ("radiator", 4, storage::radiator),
        ("fireplace", 3, storage::fireplace),
        ("lamp", 8, small::table_lamp),
        ("lamp", 6, small::floor_lamp),
        ("plant", 8, small::plant),
        ("vase", 6, small::vase),
        ("rug", 6, small::rug),
        ("tv", 4, devices::tv),
        ("computer", 4, devices::computer),
        ("laptop", 4, devices::laptop),
        ("keyboard", 3, devices::keyboard),
        ("phone", 2, devices::phone),
        ("speaker", 4, devices::speaker),
        ("clock", 3, devices::clock),
        ("book", 8, small::books),
        ("cup", 6, small::cup),
        ("bottle", 6, small::bottle),
        ("bowl", 5, small::bowl),
        ("plate", 4, small::plate),
        ("food", 5, small::fruit),
        ("toy", 4, small::blocks),
        ("toy", 4, small::teddy),
        ("basket", 4, small::basket),
        ("box", 8, small::carton),
        ("bag", 4, small::bag),
        ("ball", 4, small::ball),
        ("small_appliance", 5, devices::kettle),
        ("exercise", 3, small::dumbbell),
    ]
}

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

/// Wood or paint, as furniture is made.
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
