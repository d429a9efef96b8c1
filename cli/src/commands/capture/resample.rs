//! `picofarm capture resample`: another gate, scale or image.

use picofarm_exchange::capture::Resampling;
use serde_json::json;

use super::{read, show, write};
use crate::{
    args::CaptureResample,
    error::{CliError, Result},
    output::{Output, files::free_folder},
};

/// Resamples a capture.
///
/// # Errors
/// A folder that is no capture, an argument that is out of range, or a folder that is taken.
pub fn run(args: &CaptureResample, output: Output) -> Result<()> {
    free_folder(&args.out)?;
    let capture = read(&args.capture)?;
    let to = Resampling {
        start_m: args.start_m,
        bin_width_m: args.bin_width_m,
        bins: args.bins,
        scale: args.scale,
        crop: args.crop,
        pad: args.pad.unwrap_or_default(),
        centre: args.centre,
    };
    let made = capture.resampled(&to).map_err(CliError::input)?;
    write(&made, &args.out)?;
    let mut facts = show::facts(&made);
    facts["out"] = json!(args.out);
    let before = &capture.origin;
    output.result(&facts, || {
        let outside = made.origin.outside - before.outside;
        let cropped = made.origin.cropped - before.cropped;
        let text = show::describe(&made);
        format!(
            "{}: {text}  outside the new gate: {outside:.4e}; of pixels outside the new image: {cropped:.4e}\n",
            args.out.display()
        )
    });
    Ok(())
}
