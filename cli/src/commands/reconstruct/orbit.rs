//! An animation that orbits a reconstruction.

use picofarm_figures::animation;
use picofarm_reconstruct::{Reconstructed, render::Renderer};
use picofarm_scene::Camera;
use picofarm_tasks::reconstruct::{CELL, shaded};

/// Frames of the animation.
const FRAMES: usize = 24;
/// Duration of a frame, in hundredths of a second.
const DELAY: u16 = 12;

/// Renders the surface from views all around, as a GIF.
pub fn orbit(made: &Reconstructed, cameras: &[Camera]) -> Vec<u8> {
    let palette: Vec<u8> = (0..=255u8).flat_map(|i| [i; 3]).collect();
    let renderer = Renderer::new(&made.field);
    let frames = FRAMES.min(cameras.len());
    let frame = |k: usize| shaded(&renderer, &cameras[k * cameras.len() / frames]);
    animation((CELL, CELL), &palette, DELAY, &mut (0..frames).map(frame))
}
