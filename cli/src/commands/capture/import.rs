//! `picofarm capture import`: reads a laboratory's files.

use picofarm_dataset::SINGLE_PICTURE;
use picofarm_exchange::{capture, import::ImportError};
use picofarm_files::Opener;
use picofarm_proto::show;
use serde_json::json;

use super::{calibrate::geometry, show as shown, write};
use crate::{
    args::CaptureImport,
    error::{CliError, Code, Result},
    output::{Output, files::free_folder},
};

/// Imports a capture.
///
/// # Errors
/// Files that cannot be read or do not fit together, and a folder that is taken.
pub fn run(args: &CaptureImport, output: Output) -> Result<()> {
    free_folder(&args.out)?;
    let describe = args.describe.as_deref();
    let made = capture::import(&args.files, describe, &Opener::anywhere()).map_err(refused)?;
    write(&made, &args.out)?;
    let doubts = geometry(&made);
    let mut facts = shown::facts(&made);
    facts["doubts"] = json!(doubts);
    facts["out"] = json!(args.out);
    facts["picture"] = json!(args.out.join(SINGLE_PICTURE));
    output.result(&facts, || {
        let out = show::path(&args.out);
        let mut text = format!("{}: {}", args.out.display(), shown::describe(&made));
        for note in made.origin.conversions.iter().chain(&doubts) {
            text += &format!("  note: {note}\n");
        }
        let next = match made.origin.format.as_str() {
            // Its paths count from a relay wall: nothing else here reads them.
            capture::RELAY_ZONES => format!("picofarm capture show {out}"),
            _ => format!(
                "picofarm demultiplex {out} --out flash; picofarm reconstruct {out} --out room-3d"
            ),
        };
        text + &format!(
            "  picture: {}\n  next: {next}\n",
            args.out.join(SINGLE_PICTURE).display()
        )
    });
    Ok(())
}

fn refused(e: ImportError) -> CliError {
    match e {
        ImportError::Io { .. } | ImportError::Dataset(_) => CliError::new(Code::Resource, e),
        e => CliError::input(e),
    }
}
