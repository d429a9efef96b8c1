//! The contributions of light paths, summed over passes.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::{
    api::{RenderError, Stop},
    film::splat::Splat,
    render::{
        error::Errors,
        frame::{Frame, unit},
        image::Image,
        layer::Layer,
        sources::Sources,
        spread::Spread,
        thin::Thin,
        watch::Watch,
    },
};

/// The contributions of light paths, summed over passes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Splats {
    /// Exactly two bounces.
    pub two: Layer,
    /// Three bounces and more.
    pub multi: Layer,
    /// Energy of the whole image, by pass.
    pub all: Vec<f64>,
    pub passes: u32,
}

impl Splats {
    pub fn new(frame: &Frame) -> Self {
        Self {
            two: Layer::new(frame),
            multi: Layer::new(frame),
            all: vec![],
            passes: 0,
        }
    }

    /// Returns whether the splats were made for an image of this shape.
    pub fn fits(&self, frame: &Frame) -> bool {
        self.two.fits(frame) && self.multi.fits(frame)
    }

    /// Makes `wave` more passes and returns the number of rays traced.
    pub fn round(
        &mut self,
        (frame, sources): (&Frame, &Sources),
        wave: u32,
        watch: &Watch,
    ) -> Result<u64, RenderError> {
        let mut rays = 0;
        for _ in 0..wave {
            let (all, traced) = sources.pass(frame, (self.passes, watch), Thin::WHOLE);
            rays += traced;
            if watch.stopped() {
                return Err(RenderError::Stopped);
            }
            self.add(frame, all)?;
            if !watch.go_on() {
                return Err(RenderError::Stopped);
            }
        }
        self.two.settle(frame)?;
        self.multi.settle(frame)?;
        Ok(rays)
    }

    /// Adds one pass.
    pub fn add(&mut self, frame: &Frame, splats: Vec<Splat>) -> Result<(), RenderError> {
        let (mut two, mut multi): (Vec<_>, Vec<_>) =
            splats.into_iter().partition(|s| s.bounces == 2);
        let mut all = 0.0;
        for (layer, splats) in [(&mut self.two, &mut two), (&mut self.multi, &mut multi)] {
            // The sort is stable, so contributions to one slot are summed in the order of the
            // paths.
            splats.sort_by_key(|s| (s.pixel, s.slot));
            all += layer.add(frame, splats, self.passes)?;
        }
        self.all.push(all);
        self.passes += 1;
        Ok(())
    }

    /// Returns the errors of the image with these passes.
    pub fn errors(&self, frame: &Frame, image: &Image, stop: Stop) -> Result<Errors, RenderError> {
        let bins = frame.film.gate.bins as usize;
        let mut errors = image.errors();
        let watched = errors.draws.iter().enumerate();
        let places: HashMap<usize, usize> = watched.map(|(k, (pixel, _))| (*pixel, k)).collect();
        for layer in [&self.two, &self.multi] {
            layer.each(frame, self.passes, stop, |pixel, found| {
                let h = &image.transient[pixel * bins..(pixel + 1) * bins];
                let stat = &mut errors.stats[pixel];
                for (bin, mean, _) in found.light() {
                    stat.norm2 += mean * (mean + 2.0 * f64::from(h[bin]));
                    stat.total += mean;
                }
                // Two bounces are included, because their variance falls with the passes as that of
                // more bounces does.
                stat.multi_variance += found.pixel_variance();
                if let (Some(own), Some(&k)) = (found.draw(), places.get(&pixel)) {
                    // The errors come from different paths, so on average their squares add up.
                    for (square, of_layer) in errors.draws[k].1.iter_mut().zip(own) {
                        *square += of_layer;
                    }
                }
            })?;
        }
        let own = Spread::of(&self.all).scaled(unit(frame));
        errors.spread = errors.spread.plus(own);
        Ok(errors)
    }

    /// Adds these passes to the finished image.
    pub fn join(&self, frame: &Frame, image: &mut Image, stop: Stop) -> Result<(), RenderError> {
        let bins = frame.film.gate.bins as usize;
        for (layer, is_two) in [(&self.two, true), (&self.multi, false)] {
            layer.each(frame, self.passes, stop, |pixel, found| {
                let of_pixel = pixel * bins..(pixel + 1) * bins;
                let h = &mut image.transient[of_pixel.clone()];
                for (bin, mean, _) in found.light() {
                    h[bin] += mean as f32;
                }
                let Some(s) = &mut image.split else { return };
                let (value, se, draw) = match is_two {
                    true => (&mut s.two, &mut s.two_se, &mut s.two_noise),
                    false => (&mut s.multi, &mut s.multi_se, &mut s.multi_noise),
                };
                let (value, draw) = (&mut value[of_pixel.clone()], &mut draw[of_pixel.clone()]);
                for (bin, mean, noise) in found.light() {
                    value[bin] += mean as f32;
                    draw[bin] += noise as f32;
                }
                for (se, variance) in se[of_pixel].iter_mut().zip(found.variance()) {
                    let old = f64::from(*se);
                    *se = (old * old + variance).sqrt() as f32;
                }
            })?;
            layer.join(frame, self.passes, image);
        }
        Ok(())
    }
}
