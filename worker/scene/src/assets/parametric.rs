//! The list of builders of our own furniture.
//!
//! Every builder draws its dimensions from a variant's own random stream, so variant k of a
//! category never changes. The front is +z, units are metres, and y is up.

use crate::{Mesh, rng::Rng};

use super::{devices, small, storage, upholstery};

/// A builder of one variant.
pub(super) type Build = fn(&mut Rng) -> Mesh;

/// (category, number of variants, builder), in the order that fixes the variants' seeds: append
/// only.
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
