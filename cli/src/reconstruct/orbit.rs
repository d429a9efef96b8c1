//! A walk around a reconstruction as an animation.

use picofarm_agent::reconstruct::{CELL, shaded};
use picofarm_reconstruct::{Reconstructed, render::Renderer};
use picofarm_scene::Camera;

use crate::error::{CliError, Code, Result};

/// Frames of the animation.
const FRAMES: usize = 24;
/// Hundredths of a second a frame.
const DELAY: u16 = 12;

/// The surface from views all around, as a GIF.
///
/// # Errors
/// The animation cannot be coded.
pub fn orbit(made: &Reconstructed, cameras: &[Camera]) -> Result<Vec<u8>> {
    let palette: Vec<u8> = (0..=255u8).flat_map(|i| [i; 3]).collect();
    let failed = |e: gif::EncodingError| CliError::new(Code::Failed, format!("orbit.gif: {e}"));
    let mut bytes = Vec::new();
    let side = CELL as u16;
    {
        let mut encoder = gif::Encoder::new(&mut bytes, side, side, &palette).map_err(failed)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
        let renderer = Renderer::new(&made.field);
        let frames = FRAMES.min(cameras.len());
        for k in 0..frames {
            let frame = gif::Frame {
                width: side,
                height: side,
                delay: DELAY,
                buffer: shaded(&renderer, &cameras[k * cameras.len() / frames]).into(),
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).map_err(failed)?;
        }
    }
    Ok(bytes)
}
