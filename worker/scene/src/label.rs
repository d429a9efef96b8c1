//! The fixed vocabulary of categories that every generated scene uses.

/// The category names of generated scenes, in the order of their ids. Append only, because data
/// sets store ids.
pub const LABELS: [&str; 62] = [
    "floor",
    "ceiling",
    "wall",
    "door",
    "window",
    "mirror",
    "picture",
    "cube",
    "cylinder",
    "sofa",
    "armchair",
    "stool",
    "bed",
    "chair",
    "coffee_table",
    "desk",
    "nightstand",
    "lamp",
    "tv_stand",
    "tv",
    "table",
    "bookcase",
    "shelf",
    "wardrobe",
    "dresser",
    "cabinet",
    "plant",
    "vase",
    "rug",
    "piano",
    "guitar",
    "fireplace",
    "radiator",
    "clock",
    "book",
    "laptop",
    "computer",
    "keyboard",
    "phone",
    "speaker",
    "toy",
    "basket",
    "box",
    "bag",
    "clothes",
    "cup",
    "bottle",
    "bowl",
    "plate",
    "kitchen_appliance",
    "small_appliance",
    "sink",
    "toilet",
    "bathtub",
    "curtain",
    "exercise",
    "game_table",
    "ladder",
    "food",
    "aquarium",
    "ball",
    "umbrella",
];

/// Returns the vocabulary in the form that a scene stores.
pub(crate) fn vocabulary() -> Vec<String> {
    LABELS.iter().map(|&l| l.to_owned()).collect()
}

/// Returns the id of a name of the vocabulary. Generators only use names that are in it.
pub(crate) fn label_id(name: &str) -> u16 {
    LABELS
        .iter()
        .position(|&l| l == name)
        .expect("generators use names of the fixed vocabulary") as u16
}

#[cfg(test)]
mod tests {
    use super::LABELS;

    #[test]
    fn no_label_occurs_twice() {
        let mut sorted = LABELS.to_vec();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), LABELS.len());
    }
}
