//! Finds the rows of a change set that a database rejects because of their content.
//!
//! # Search
//! Only rows with content from other programs can be rejected: outputs (sizes, times), failed tasks
//! (an error message), workers (a name) and history events (both). Ranges contain only numbers that
//! the coordinator computed, and they depend on each other: a lease, the tasks that left it and its
//! neighbours change in one transaction or not at all. Therefore a change set is never committed in
//! parts. Instead its rows are tried in transactions that are rolled back, and rejected sets are
//! halved until single rows remain. The caller then changes or removes these rows, with the
//! consequences for their tasks, and commits the whole set. For `n` rows with one culprit, this
//! takes about `2 log2 n` short transactions.

use picofarm_proto::ids::{StageRef, WorkerId};

use crate::{Catalog, CatalogError, Changes};

/// A row of a change set that can be rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Row {
    /// An output, by its position in [`Changes::outputs`].
    Output(usize),
    /// A failed task in [`Changes::exceptions`].
    Exception(StageRef, u64),
    /// A worker in [`Changes::workers`].
    Worker(WorkerId),
    /// An event, by its position in [`Changes::events`].
    Event(usize),
}

/// A rejected row and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Culprit {
    /// The row.
    pub row: Row,
    /// The database's error message.
    pub why: String,
}

fn rows(changes: &Changes) -> Vec<Row> {
    let outputs = (0..changes.outputs.len()).map(Row::Output);
    let exceptions = changes.exceptions.keys();
    let exceptions = exceptions.map(|(stage, task)| Row::Exception(*stage, *task));
    let workers = changes.workers.keys().copied().map(Row::Worker);
    let events = (0..changes.events.len()).map(Row::Event);
    outputs
        .chain(exceptions)
        .chain(workers)
        .chain(events)
        .collect()
}

/// Returns a change set of these rows alone.
fn only(changes: &Changes, rows: &[Row]) -> Changes {
    let mut part = Changes::default();
    for row in rows {
        match row {
            Row::Output(at) => part.outputs.push(changes.outputs[*at].clone()),
            Row::Exception(stage, task) => {
                let key = (*stage, *task);
                part.exceptions
                    .insert(key, changes.exceptions[&key].clone());
            }
            Row::Worker(id) => {
                part.workers.insert(*id, changes.workers[id].clone());
            }
            Row::Event(at) => part.events.push(changes.events[*at].clone()),
        }
    }
    part
}

/// Returns the rows of `changes` that the database rejects, in the order of the set. The list is
/// empty if the rejection has another cause.
///
/// # Errors
/// The catalog cannot be queried.
pub async fn culprits(
    catalog: &dyn Catalog,
    changes: &Changes,
) -> Result<Vec<Culprit>, CatalogError> {
    let mut found = Vec::new();
    // The stack's top is tried first, so the second half is pushed before the first.
    let mut suspects = vec![rows(changes)];
    while let Some(mut rows) = suspects.pop() {
        if rows.is_empty() {
            continue;
        }
        let Some(why) = catalog.trial(&only(changes, &rows)).await? else {
            continue;
        };
        if let [row] = rows[..] {
            found.push(Culprit { row, why });
            continue;
        }
        let second = rows.split_off(rows.len() / 2);
        suspects.push(second);
        suspects.push(rows);
    }
    Ok(found)
}

/// Returns the reason of a rejection, if the trial of a change set was rejected because of its
/// content.
///
/// # Errors
/// The trial itself failed.
pub fn verdict(tried: Result<(), CatalogError>) -> Result<Option<String>, CatalogError> {
    match tried {
        // A conflict with another result is detected by the commit.
        Ok(()) | Err(CatalogError::Conflict(_)) => Ok(None),
        Err(CatalogError::Refused { what, .. }) => Ok(Some(what)),
        Err(error) => Err(error),
    }
}
