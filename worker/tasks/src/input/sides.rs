//! The training, validation and test scenes of a data set.

use picofarm_dataset::Dataset;
use picofarm_proto::split::{Rank, SplitRecord};
use picofarm_results::SplitUsed;
use picofarm_store::sha256_hex;

use crate::{
    stores::Stores,
    task::{Control, TaskError},
};

/// The requested sides of a split, each in the split's order.
pub(crate) struct Sides<const N: usize> {
    pub(crate) split: SplitUsed,
    pub(crate) scenes: [Vec<u64>; N],
}

/// Returns the scenes of the given sides of a split's newest version, in the order of the split. A
/// smaller limit therefore always selects a prefix of a larger one.
///
/// # Errors
/// [`TaskError::User`] at `field` if there is no such split.
pub(crate) fn sides<const N: usize>(
    stores: &Stores,
    dataset: &Dataset,
    (field, name): (&str, &str),
    sides: [&str; N],
    control: &Control,
) -> Result<Sides<N>, TaskError> {
    let versions = stores.wait(control, dataset.split_versions(name))?;
    let Some(version) = versions.last() else {
        return Err(TaskError::User(format!(
            "{field}: {} has no split {name:?}; make it with a split stage or `picofarm dataset split`",
            dataset.place()
        )));
    };
    let bytes = stores.wait(control, dataset.read_split(name, *version))?;
    let record = SplitRecord::parse(&bytes).map_err(|what| {
        TaskError::User(format!("{}: {what}", dataset.split_place(name, *version)))
    })?;
    let seed = record.settings.seed;
    Ok(Sides {
        scenes: sides.map(|side| {
            let mut scenes = record.scenes(side);
            scenes.sort_by_cached_key(|scene| Rank::of(seed, *scene));
            scenes
        }),
        split: SplitUsed {
            name: name.to_owned(),
            version: *version,
            sha256: sha256_hex(&bytes),
        },
    })
}

/// Truncates `scenes` to the first `limit`; 0 = all.
///
/// # Errors
/// [`TaskError::User`] at `field` if there are fewer scenes than that, or none at all.
pub(crate) fn first(scenes: &mut Vec<u64>, limit: u64, field: &str) -> Result<(), TaskError> {
    let there = scenes.len() as u64;
    if there == 0 || limit > there {
        return Err(TaskError::User(format!(
            "{field}: {limit} scenes are asked for (0 = all), but that side of the split has {there}"
        )));
    }
    if limit > 0 {
        scenes.truncate(limit as usize);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_scenes_are_the_first_and_more_than_there_are_is_an_error() {
        let mut scenes = vec![5, 2, 9];
        first(&mut scenes, 0, "train.scenes").unwrap();
        first(&mut scenes, 2, "train.scenes").unwrap();
        assert_eq!(scenes, [5, 2]);
        let said = first(&mut scenes, 3, "train.scenes").unwrap_err();
        assert!(said.to_string().contains("train.scenes: 3"), "{said}");
        assert!(first(&mut Vec::new(), 0, "train.scenes").is_err());
    }
}
