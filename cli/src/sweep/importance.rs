//! `picofarm sweep importance`: shows the importance of each parameter.

use std::fmt::Write;

use picofarm_model::report::trials::Weight;
use picofarm_search::importance::{FEW, Importance, LEAST, importance};

use super::records::Records;
use crate::{
    error::{CliError, Code, Result},
    output::{Output, table},
};

/// Prints the importance of each parameter.
///
/// # Errors
/// Fails if too few trials have ended.
pub fn run(records: &Records, output: Output) -> Result<()> {
    let Some(found) = importance(&records.space()?, &records.tried()) else {
        let what = format!(
            "{} trials of {:?} have ended, and it takes {LEAST} to tell the best from the others",
            records.ended.len(),
            records.name
        );
        return Err(CliError::new(Code::Failed, what).hint("`picofarm sweep extend` adds trials"));
    };
    output.result(&found, || {
        let header = ["parameter", "share", "chance"].map(str::to_owned).to_vec();
        let rows = found.parameters.iter().map(|p| {
            vec![
                p.parameter.clone(),
                format!("{:.0} %", 100.0 * p.share),
                format!("{:.3}", p.chance),
            ]
        });
        let rows: Vec<Vec<String>> = std::iter::once(header).chain(rows).collect();
        format!("{}{}\n", table(&rows), note(&found))
    });
    Ok(())
}

/// Explains shares and chances, and how reliable they are.
pub fn note(found: &Importance) -> String {
    let mut note = format!(
        "share: how differently the {} best of {} trials are spread over the parameter (PED-ANOVA); chance: how often a \
         parameter without effect would come as far",
        found.top, found.trials
    );
    if found.trials < FEW {
        let _ = write!(
            note,
            ". {} trials are few: below {FEW}, the order of shares is often chance",
            found.trials
        );
    }
    note
}

/// Returns the same for a page; nothing if too few trials have ended.
pub fn weights(records: &Records) -> Result<(Vec<Weight>, String)> {
    let Some(found) = importance(&records.space()?, &records.tried()) else {
        return Ok((Vec::new(), String::new()));
    };
    let note = note(&found);
    let weight = |p: picofarm_search::importance::Share| Weight {
        parameter: p.parameter,
        share: p.share,
        chance: p.chance,
    };
    Ok((found.parameters.into_iter().map(weight).collect(), note))
}
