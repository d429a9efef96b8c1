//! Ownership of the places that a job writes into. A place belongs to its first submitter. Jobs of
//! other users may only reuse its results.

use picofarm_catalog::{OwnedPlace, Owner, Sight, StageRecord};
use picofarm_proto::spec::{Destination, SpecError, StageSpec};

use crate::auth::Caller;

/// Returns the places that a job's stages write into, each with its stage's position. `owner`
/// submits the job.
pub(super) fn written(
    specs: &[StageSpec],
    stages: &[StageRecord],
    owner: &Owner,
) -> Vec<(usize, OwnedPlace)> {
    let mut places = Vec::new();
    for (position, (spec, stage)) in specs.iter().zip(stages).enumerate() {
        let destination = spec.task.results().destination;
        if let Some(place) = destination.place() {
            let mine = OwnedPlace {
                place: place.normal(),
                record: matches!(destination, Destination::Record(_)),
                owner: owner.clone(),
                job: stage.id.job,
            };
            places.push((position, mine));
        }
    }
    places
}

/// Returns others' places `near` the place `mine`, each with whether `by` may write there.
pub(super) fn owned_by_others<'a>(
    mine: &OwnedPlace,
    near: &'a [OwnedPlace],
    by: &Caller,
) -> Vec<(&'a OwnedPlace, bool)> {
    // The owner of a data set may change every record in it.
    let owns_around = mine.record
        && near
            .iter()
            .any(|o| !o.record && mine.place.starts_with(&o.place) && by.may_change(&o.owner));
    near.iter()
        .filter(|other| other.record == mine.record && other.owner.user != *by.name)
        .map(|other| (other, owns_around || by.may_change(&other.owner)))
        .collect()
}

/// Returns the error for a stage that would write into another owner's place `other`. `sight`
/// decides how much the error reveals.
pub(super) fn refused(
    stage: &StageSpec,
    mine: &OwnedPlace,
    other: &OwnedPlace,
    sight: &Sight,
) -> SpecError {
    let destination = stage.task.results().destination;
    let field = destination.place().map_or("output", |place| place.field);
    let (place, whose) = match sight.sees(&other.owner) {
        true => (
            format!("{:?}", other.place),
            format!("belongs to {:?}", other.owner.user),
        ),
        false => (
            "a place".to_owned(),
            "belongs to a user whose jobs you may not see".to_owned(),
        ),
    };
    let how = if other.place == mine.place {
        whose
    } else if mine.place.starts_with(&other.place) {
        format!("lies in {place}, which {whose}")
    } else {
        format!("encloses {place}, which {whose}")
    };
    let what = format!(
        "{:?} {how}; choose another place, or ask the owner or an administrator to submit the job",
        mine.place
    );
    SpecError::new(field, what)
}
