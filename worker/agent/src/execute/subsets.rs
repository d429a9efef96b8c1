//! From a job's subsets of spots and chosen strategies to the renderer's settings, and from the renderer's groups to
//! the data set's arrays.

use std::collections::BTreeMap;

use picofarm_dataset::{DatasetSpec, Quantity, SubsetRecord};
use picofarm_proto::model::Choice;
use picofarm_transient::{
    Rendered, Strategy,
    sensor::{SPOTS_4_OF_100, SPOTS_25_OF_100},
};

/// The groups of beams of the data set's further transients, one after the other.
pub(super) fn groups(spec: &DatasetSpec) -> Vec<Vec<u32>> {
    let indices = |spots: &[usize]| spots.iter().map(|&s| s as u32).collect();
    let mut groups = vec![];
    for quantity in further(spec) {
        match quantity {
            Quantity::Transient4 => groups.push(indices(&SPOTS_4_OF_100)),
            Quantity::Transient25 => groups.push(indices(&SPOTS_25_OF_100)),
            _ => groups.extend((0..spec.spots).map(|spot| vec![spot])),
        }
    }
    groups
}

/// The rendered groups as the data set takes them.
pub(super) fn records<'a>(spec: &DatasetSpec, rendered: &'a Rendered) -> Vec<SubsetRecord<'a>> {
    let mut groups = rendered.groups.iter().map(Vec::as_slice);
    further(spec)
        .map(|quantity| {
            let planes = match quantity {
                Quantity::TransientSpots => spec.spots as usize,
                _ => 1,
            };
            SubsetRecord {
                quantity,
                planes: groups.by_ref().take(planes).collect(),
            }
        })
        .collect()
}

fn further(spec: &DatasetSpec) -> impl Iterator<Item = Quantity> {
    let transients = |q: &Quantity| q.is_transient() && *q != Quantity::Transient;
    spec.quantities().into_iter().filter(transients)
}

/// Names of the renderer's strategies.
pub fn strategy_names() -> Vec<String> {
    match serde_json::to_value(Strategy::default()) {
        Ok(serde_json::Value::Object(all)) => all.into_iter().map(|(name, _)| name).collect(),
        _ => unreachable!("a strategy is a plain struct"),
    }
}

/// The renderer's strategies with those chosen by name.
///
/// # Errors
/// A message that names what is unknown or of the wrong kind.
pub fn strategy(chosen: &BTreeMap<String, Choice>) -> Result<Strategy, String> {
    let names = strategy_names();
    let mut all = serde_json::Map::new();
    for (name, choice) in chosen {
        if !names.contains(name) {
            return Err(format!(
                "{name:?} is unknown; there are {}",
                names.join(", ")
            ));
        }
        let value = serde_json::to_value(choice).expect("a choice is plain data");
        let alone = serde_json::json!({ name.as_str(): value });
        if serde_json::from_value::<Strategy>(alone).is_err() {
            return Err(match choice {
                Choice::On(_) => format!("{name:?} takes a number"),
                Choice::Size(_) => format!("{name:?} is either on (true) or off (false)"),
            });
        }
        all.insert(name.clone(), value);
    }
    Ok(serde_json::from_value(all.into()).expect("each is of its kind"))
}

#[cfg(test)]
mod tests {
    use picofarm_dataset::{Gate, Profile, Subsets};

    use super::*;

    #[test]
    fn the_data_set_and_the_sensor_model_mean_the_same_spots() {
        let spec = DatasetSpec {
            scenes: 1,
            height: 4,
            width: 4,
            spots: 100,
            subsets: Subsets::of(&[4, 25]).unwrap(),
            per_spot: true,
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 0.1,
                bins: 8,
            },
            profile: Profile::default(),
        };
        let groups = groups(&spec);
        assert_eq!(groups.len(), 102);
        assert_eq!(groups[0], Quantity::Transient4.spots_of_100());
        assert_eq!(groups[1], Quantity::Transient25.spots_of_100());
        assert_eq!((&groups[2][..], &groups[101][..]), (&[0][..], &[99][..]));
    }

    #[test]
    fn strategies_are_chosen_by_name() {
        let one = |name: &str, choice| strategy(&BTreeMap::from([(name.to_owned(), choice)]));
        assert_eq!(strategy(&BTreeMap::new()), Ok(Strategy::default()));
        assert_eq!(
            one("path_reuse", Choice::Size(3)).unwrap().path_reuse,
            Some(3)
        );
        let off = one("mirror_images", Choice::On(false)).unwrap();
        assert_eq!(off.mirror_images, Some(false));
        let unknown = one("lobes", Choice::On(true)).unwrap_err();
        assert!(
            unknown.contains("\"lobes\"") && unknown.contains("path_reuse, light_vertices"),
            "{unknown}"
        );
        assert!(
            one("path_reuse", Choice::On(true))
                .unwrap_err()
                .contains("number")
        );
        assert!(
            one("mirror_images", Choice::Size(1))
                .unwrap_err()
                .contains("off")
        );
        for name in strategy_names() {
            let fits = [Choice::On(true), Choice::Size(2)].map(|c| one(&name, c).is_ok());
            assert!(fits[0] != fits[1], "{name} takes a switch or a size");
        }
    }
}
