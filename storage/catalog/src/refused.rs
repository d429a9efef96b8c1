//! Finding what it is of a change set that a database refuses for its content.
//!
//! # What is tried by itself
//! Only rows that hold what others sent can be refused for their content: outputs (sizes, times), failed tasks (an error
//! message), workers (a name) and lines of history (both). Ranges hold numbers that the coordinator made itself, and they
//! belong together: a lease, the tasks that left it and its neighbours change at once or not at all. So a change set is never
//! committed in parts. Instead its rows are tried in transactions that are undone, halving those that are refused until single
//! rows are left. The caller changes or takes out these rows, with whatever follows from that for their tasks, and commits the
//! whole again. Of `n` rows with one culprit that takes some `2 log2 n` short transactions.

use picofarm_proto::ids::{StageRef, WorkerId};

use crate::{Catalog, CatalogError, Changes};

/// A row of a change set that can be refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Row {
    /// Of [`Changes::outputs`], by position.
    Output(usize),
    /// Of [`Changes::exceptions`].
    Exception(StageRef, u64),
    /// Of [`Changes::workers`].
    Worker(WorkerId),
    /// Of [`Changes::events`], by position.
    Event(usize),
}

/// A row and why the database refuses it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Culprit {
    /// Which.
    pub row: Row,
    /// The database's words.
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

/// A change set of these rows alone.
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

/// The rows of `changes` that the database refuses, in the order of the set; none where it is something else that it refuses.
///
/// # Errors
/// The catalog cannot be asked.
pub async fn culprits(
    catalog: &dyn Catalog,
    changes: &Changes,
) -> Result<Vec<Culprit>, CatalogError> {
    let mut found = Vec::new();
    // The last is looked at first, so the second half goes in before the first.
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

/// What a trial of a change set shows: the words of a refusal, if it was refused by its content.
///
/// # Errors
/// The trial itself failed.
pub fn verdict(tried: Result<(), CatalogError>) -> Result<Option<String>, CatalogError> {
    match tried {
        // Whether another result is there already, the commit finds.
        Ok(()) | Err(CatalogError::Conflict(_)) => Ok(None),
        Err(CatalogError::Refused { what, .. }) => Ok(Some(what)),
        Err(error) => Err(error),
    }
}
