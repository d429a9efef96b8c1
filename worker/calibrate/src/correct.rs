//! The corrected calibration, and the corrected histograms.

use picofarm_demultiplex::Spot;
use picofarm_scene::{Camera, Vec3};
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    causes::Findings,
    hypotheses::Turn,
    pixels::unpile,
    report::{Cause, Fault},
};

/// Pixels up to which a neighbour fills in.
const REACH: usize = 6;

/// The nearest good pixel of each pixel; of equally near ones the first. Padding stays as it is.
fn sources(good: &[bool], padding: &[bool], width: usize) -> Vec<Option<usize>> {
    let height = good.len() / width;
    (0..good.len())
        .map(|p| {
            if good[p] || padding[p] {
                return Some(p);
            }
            let (u, v) = (p % width, p / width);
            let rows = v.saturating_sub(REACH)..(v + REACH + 1).min(height);
            let near = rows.flat_map(|y| {
                let columns = u.saturating_sub(REACH)..(u + REACH + 1).min(width);
                columns.map(move |x| y * width + x)
            });
            near.filter(|q| good[*q])
                .min_by_key(|q| (q % width).abs_diff(u).pow(2) + (q / width).abs_diff(v).pow(2))
        })
        .collect()
}

/// A corrected calibration, and what must be done to the histograms.
#[derive(Debug, Clone, PartialEq)]
pub struct Corrected {
    /// The gate.
    pub gate: Gate,
    /// The camera.
    pub camera: Camera,
    /// The laser, world axes, metres.
    pub laser: Vec3,
    /// The spot of each histogram.
    pub spots: Vec<Spot>,
    /// How the stored image is turned.
    pub turn: Turn,
    /// The stated mask of each histogram's spot; `None` if masks were not stated.
    pub mask_order: Option<Vec<usize>>,
    /// Whether stated masks are stored as the histograms are, so that they are turned with them.
    pub turn_masks: bool,
    /// The stored pixel whose histogram each stored pixel takes, `[row][column]`: its own, or that
    /// of the nearest good pixel if it is dead or hot; `None` if none is near.
    pub source: Vec<Option<usize>>,
    /// Pulses of a histogram, if pile-up is to be corrected.
    pub pulses: Option<u64>,
    /// Bins before any light, if their mean is to be subtracted.
    pub dark_bins: Option<usize>,
}

impl Corrected {
    pub(crate) fn new(f: &Findings, causes: &[Cause]) -> Self {
        let capture = &f.m.capture;
        let has = |fault| causes.iter().any(|c| c.fault == fault);
        let model = &f.refined.fitted.model;
        let moved = |own: f64, stated: f64| (own - stated).abs() > 1e-12;
        let mut gate = capture.gate;
        if moved(model.start, gate.start_m) || moved(model.width, gate.bin_width_m) {
            gate = model.gate(gate.bins);
        }
        let mut camera = *capture.camera;
        if has(Fault::FieldOfView) {
            camera.intrinsics = model.intrinsics(&camera.intrinsics);
        }
        let laser = match has(Fault::Laser) {
            true => model.laser(capture.camera),
            false => capture.laser,
        };
        let h = &f.chosen.hypothesis;
        let stated: Vec<Spot> = h.order.iter().map(|j| capture.spots[*j]).collect();
        let placed: Vec<bool> = (0..stated.len())
            .map(|k| stated[k].place.is_some() || f.observed.returns[k].is_some())
            .collect();
        let found = model.spots(capture.camera, &stated, &placed);
        let same = !has(Fault::Laser) && !has(Fault::Spot);
        let spots = stated
            .iter()
            .zip(found)
            .map(|(stated, found)| match stated.place.is_some() && same {
                true => *stated,
                false => found,
            })
            .collect();
        Self {
            gate,
            camera,
            laser,
            spots,
            turn: h.turn,
            mask_order: f.masks.map(|(m, _)| m.order.clone()),
            turn_masks: f.masks.is_none_or(|(_, turned)| !turned),
            source: sources(&f.pixels.good(), &f.pixels.padding, f.m.width()),
            pulses: f.pixels.pulses.filter(|_| has(Fault::PileUp)),
            dark_bins: has(Fault::Background).then_some(f.pixels.dark_bins),
        }
    }

    /// Returns corrected histograms of the stored image, `[…][row][column][bin]`: pile-up undone,
    /// background subtracted, dead and hot pixels filled from their neighbours, the image turned.
    pub fn histograms(&self, stored: &[f32]) -> Vec<f32> {
        let bins = self.gate.bins as usize;
        let (width, height) = self.size();
        let pixels = width * height;
        let mut all = vec![0.0; stored.len()];
        all.par_chunks_mut(pixels * bins)
            .zip(stored.par_chunks(pixels * bins))
            .for_each(|(out, stored)| {
                for (p, source) in self.source.iter().enumerate() {
                    let Some(source) = source else { continue };
                    let h = &stored[source * bins..][..bins];
                    let q = self.turn.pixel(p, width, height);
                    let out = &mut out[q * bins..][..bins];
                    out.copy_from_slice(h);
                    if let Some(pulses) = self.pulses {
                        unpile(out, pulses);
                    }
                    if let Some(n) = self.dark_bins {
                        let sum: f64 = out[..n].iter().map(|x| f64::from(*x)).sum();
                        let dark = (sum / n as f64) as f32;
                        out.iter_mut().for_each(|x| *x = (*x - dark).max(0.0));
                    }
                }
            });
        all
    }

    /// Returns an image of the stored pixels, `[…][row][column]`, turned.
    pub fn image<T: Copy + Default>(&self, stored: &[T]) -> Vec<T> {
        let (width, height) = self.size();
        let pixels = width * height;
        let mut all = vec![T::default(); stored.len()];
        for (out, stored) in all.chunks_mut(pixels).zip(stored.chunks(pixels)) {
            for (p, x) in stored.iter().enumerate() {
                out[self.turn.pixel(p, width, height)] = *x;
            }
        }
        all
    }

    /// Returns stated masks, `[spot][row][column]`, in the order and orientation of the corrected
    /// histograms.
    pub fn masks(&self, stored: &[u8]) -> Vec<u8> {
        let (width, height) = self.size();
        let pixels = width * height;
        let turned = self.turn_masks.then(|| self.image(stored));
        let masks = turned.as_deref().unwrap_or(stored);
        match &self.mask_order {
            Some(order) => order
                .iter()
                .flat_map(|j| masks[j * pixels..][..pixels].iter().copied())
                .collect(),
            None => masks.to_vec(),
        }
    }

    fn size(&self) -> (usize, usize) {
        let i = &self.camera.intrinsics;
        (i.width as usize, i.height as usize)
    }
}
