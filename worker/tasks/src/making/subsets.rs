//! Converts a job's subsets of spots into the renderer's settings, and the renderer's groups into
//! the data set's arrays.

use picofarm_dataset::{DatasetSpec, Quantity, SubsetRecord};
use picofarm_sensor::{SPOTS_4_OF_100, SPOTS_25_OF_100};
use picofarm_transient::Rendered;

/// Returns the groups of beams of the data set's additional transients, one after the other.
pub(crate) fn groups(spec: &DatasetSpec) -> Vec<Vec<u32>> {
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

/// Returns the rendered groups in the form that the data set stores.
pub(crate) fn records<'a>(spec: &DatasetSpec, rendered: &'a Rendered) -> Vec<SubsetRecord<'a>> {
    let mut groups = rendered.groups.iter().map(Vec::as_slice);
    further(spec)
        .map(|quantity| SubsetRecord {
            quantity,
            planes: groups.by_ref().take(spec.planes(quantity)).collect(),
        })
        .collect()
}

fn further(spec: &DatasetSpec) -> impl Iterator<Item = Quantity> {
    let transients = |q: &Quantity| q.is_transient() && *q != Quantity::Transient;
    spec.quantities().into_iter().filter(transients)
}

#[cfg(test)]
mod tests {
    use picofarm_dataset::{Gate, Profile, Subsets, Wavelength};

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
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
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
}
