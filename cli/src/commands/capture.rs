//! `picofarm capture …`: what a laboratory measured.

mod calibrate;
mod calibration_picture;
mod import;
mod resample;
mod show;

use std::path::Path;

use futures::executor::block_on;
use picofarm_exchange::capture::Capture;

use crate::{
    args::Capture as Command,
    commands::{
        rendered::unreadable,
        scene::preview::{self, Preview},
    },
    error::{CliError, Code, Result},
    output::Output,
};

pub async fn run(command: Command, output: Output) -> Result<()> {
    let done = tokio::task::spawn_blocking(move || match command {
        Command::Import(args) => import::run(&args, output),
        Command::Check { capture } => calibrate::check(&capture, output),
        Command::Calibrate { capture, out } => calibrate::calibrate(&capture, &out, output),
        Command::Resample(args) => resample::run(&args, output),
        Command::Show { capture } => show::run(&capture, output),
    });
    done.await
        .map_err(|e| CliError::new(Code::Failed, format!("the command broke: {e}")))?
}

/// Reads a capture's folder on a thread for blocking work.
///
/// # Errors
/// Fails on another folder, or a damaged one.
pub fn read(folder: &Path) -> Result<Capture> {
    let hint = match folder.exists() {
        true => {
            "expected a folder that `picofarm capture import FILES --out FOLDER` or `picofarm scene render FILE --out FOLDER` wrote"
        }
        false => {
            "there is no such folder; make it with `picofarm capture import FILES --out FOLDER`"
        }
    };
    block_on(Capture::read(folder)).map_err(|e| unreadable(folder, e).hint(hint))
}

/// Writes a capture and its picture to a new folder.
///
/// # Errors
/// Fails for values that no data set holds, or if the folder cannot be written.
pub fn write(capture: &Capture, out: &Path) -> Result<()> {
    let picture = preview::draw(&Preview {
        width: capture.width as usize,
        height: capture.height as usize,
        bins: capture.gate.bins as usize,
        gate_start_m: capture.gate.start_m,
        bin_width_m: capture.gate.bin_width_m,
        transient: &capture.sum,
        depth: capture.depth.as_deref(),
    });
    block_on(capture.write(out, &picture.png())).map_err(|e| CliError::new(Code::Resource, e))
}
