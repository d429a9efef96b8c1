//! Maps the catalogue's categories and names to our categories.

/// The catalogue categories without objects for a room.
const OUTSIDE: [&str; 5] = [
    "Exterior",
    "Vehicles",
    "Characters",
    "Staircases",
    "Doors and windows",
];

/// Rules: (category, words of which the English name must contain one). The first matching rule
/// wins.
const RULES: &[(&str, &[&str])] = &[
    ("sofa", &["sofa", "couch"]),
    ("armchair", &["armchair", "ryokan"]),
    ("stool", &["stool", "bar chair", "puff", "piano bench"]),
    ("bed", &["bed ", "crib", "futon", "mezzanine"]),
    ("nightstand", &["bedside"]),
    ("bed", &["bed"]),
    ("chair", &["chair", "class seat"]),
    ("coffee_table", &["coffee table"]),
    ("desk", &["desk", "workbench"]),
    ("lamp", &["lamp", "light", "chandelier", "candle"]),
    (
        "tv_stand",
        &[
            "tv stand",
            "tv unit",
            "television cabinet",
            "contemporary living",
        ],
    ),
    ("tv", &["tv", "screen"]),
    (
        "table",
        &[
            "table on",
            "glass table",
            "round table",
            "square table",
            "folding table",
            "table with",
            "oak table",
            "bar table",
            "black table",
            "children table",
            "technical table",
            "wooden tab",
            "changing table",
            "dressing table",
        ],
    ),
    ("bookcase", &["bookcase"]),
    ("shelf", &["shelves", "shelf"]),
    ("wardrobe", &["wardrobe", "cupboard"]),
    ("dresser", &["chest", "dresser", "trunck"]),
    ("cabinet", &["cabinet", "island", "vanity"]),
    (
        "plant",
        &[
            "plant", "cactus", "ficus", "bamboo", "bonsai", "yucca", "spathi", "orchid", "tulip",
            "lily", "flower",
        ],
    ),
    ("vase", &["vase", "pottery", "old jar"]),
    ("rug", &["rug", "carpet", "bathmat", "doormat", "tatami"]),
    ("piano", &["piano"]),
    ("guitar", &["guitar"]),
    ("fireplace", &["fireplace", "chimney"]),
    ("radiator", &["radiator"]),
    ("picture", &["frame", "white board", "calendar"]),
    ("clock", &["clock"]),
    ("book", &["book", "newspaper"]),
    ("laptop", &["laptop", "ibook"]),
    (
        "computer",
        &["imac", "printer", "dvd", "playstation", "amplifier", "xbox"],
    ),
    ("keyboard", &["keyboard"]),
    ("phone", &["phone", "tablet", "camera", "mp3"]),
    ("speaker", &["speaker", "stereo", "radio"]),
    (
        "toy",
        &[
            "teddy",
            "doll",
            "toy",
            "rocking",
            "car model",
            "rubik",
            "biplane",
            "xylophone",
            "chess",
            "puzzle",
            "deer",
        ],
    ),
    ("basket", &["basket", "dustbin", "trash", "bin"]),
    ("box", &["box", "crate", "gift"]),
    ("bag", &["suitcase", "backpack", "handbag", "briefcase"]),
    (
        "clothes",
        &[
            "clothes", "jacket", "suit", "dress", "skirt", "trousers", "hat", "helmet", "bootie",
            "shoes", "slippers", "sneakers", "mocassin", "glove",
        ],
    ),
    ("cup", &["cup", "mug", "glass"]),
    ("bottle", &["bottle", "milk"]),
    ("bowl", &["bowl", "teapot", "creamer", "sugar"]),
    ("plate", &["plate", "tray", "chopping"]),
    (
        "kitchen_appliance",
        &[
            "fridge",
            "refrigerator",
            "oven",
            "stove",
            "cooker",
            "dishwasher",
            "washer",
            "microwave",
            "freezer",
            "washing",
            "dryer",
        ],
    ),
    (
        "small_appliance",
        &[
            "toaster",
            "coffee",
            "kettle",
            "blender",
            "mixer",
            "deep fryer",
            "espresso",
            "sandwich",
        ],
    ),
    ("sink", &["sink", "washbasin", "basin", "lavatory"]),
    ("toilet", &["toilet", "bidet", "urinal"]),
    ("bathtub", &["bath", "shower"]),
    ("curtain", &["curtain", "blind"]),
    (
        "exercise",
        &["treadmill", "bike", "fitness", "abdominal", "punching"],
    ),
    (
        "game_table",
        &["pool table", "football table", "table tennis"],
    ),
    ("ladder", &["ladder"]),
    (
        "food",
        &[
            "apples",
            "bread",
            "cake",
            "fruits",
            "hamburger",
            "hot dog",
            "sushi",
            "steak",
            "chicken",
        ],
    ),
    ("aquarium", &["aquarium"]),
    ("ball", &["ball"]),
    ("umbrella", &["umbrella"]),
    ("table", &["table"]),
];

/// Returns our category of a catalogue item, by its catalogue category and English name, or `None`
/// for objects that do not belong into a room.
pub(super) fn category_of(catalogue_category: &str, name: &str) -> Option<&'static str> {
    if OUTSIDE.contains(&catalogue_category) {
        return None;
    }
    let name = name.to_lowercase();
    RULES
        .iter()
        .find(|(_, words)| words.iter().any(|w| name.contains(w)))
        .map(|(label, _)| *label)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LABELS;

    #[test]
    fn every_rule_names_a_label_of_the_vocabulary() {
        for (label, _) in RULES {
            assert!(LABELS.contains(label), "{label}");
        }
    }

    #[test]
    fn names_find_their_category() {
        for (category, name, expected) in [
            ("Bedroom", "Bed 140x190", Some("bed")),
            ("Bedroom", "Bedside table", Some("nightstand")),
            ("Living room", "Coffee table", Some("coffee_table")),
            ("Miscellaneous", "Xbox", Some("computer")),
            ("Exterior", "Garden table", None),
            ("Miscellaneous", "Thing", None),
        ] {
            assert_eq!(category_of(category, name), expected, "{name}");
        }
    }
}
