//! Carrying light of several wavelengths to the pixels: as [`super::arrivals`] does it of one, in the same order, so that a main
//! wavelength that is the brightest everywhere has the bits that it has alone.

use std::f32::consts::PI;

use super::{Shared, Sharing, arrivals::floor};
use crate::{
    film::Film,
    lanes::{Wide, widest},
    spectra::{Light, ONES, Ratios, times},
    walk::Walk,
    world::Hit,
};

/// [`Sharing::spread_spectral`].
struct SpreadSpectral<'a> {
    sharing: &'a Sharing,
    walk: &'a Walk<'a>,
    film: &'a Film,
    pixels: &'a mut [f32],
}

impl Wide for SpreadSpectral<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let of = (self.walk, self.film);
        self.sharing.spread_wavelengths(of, self.pixels);
    }
}

/// Sums of one pixel, all wavelengths of a slot side by side. Every second arrival is summed in `second`.
struct Sums {
    first: Vec<Ratios>,
    second: Vec<Ratios>,
}

impl Sums {
    /// What a pixel has already.
    fn take(&mut self, film: &Film, pixel: &[f32]) {
        for wavelength in 0..film.wavelengths {
            let from = film.first_channel(wavelength) * film.slots;
            let of = &pixel[from..from + film.slots];
            for (sum, x) in self.first.iter_mut().zip(of) {
                sum[wavelength] = *x;
            }
        }
    }

    /// Gives it back with what came.
    fn give(&mut self, film: &Film, pixel: &mut [f32]) {
        for wavelength in 0..film.wavelengths {
            let from = film.first_channel(wavelength) * film.slots;
            let of = &mut pixel[from..from + film.slots];
            for ((first, second), x) in self.first.iter().zip(&self.second).zip(of) {
                *x = first[wavelength] + second[wavelength];
            }
        }
        self.second.fill([0.0; ONES.len()]);
    }
}

#[inline(always)]
fn add(to: &mut Ratios, x: Ratios) {
    for (to, x) in to.iter_mut().zip(x) {
        *to += x;
    }
}

impl Sharing {
    /// Carries the arrivals to the pixels, where there are several wavelengths.
    pub(super) fn spread_spectral(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        widest(SpreadSpectral {
            sharing: self,
            walk,
            film,
            pixels,
        });
    }

    #[inline(always)]
    fn spread_wavelengths(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        let count = self.gathers.len();
        let size = film.pixel();
        let last = film.slots as f32 - 1.0;
        let lowest = self.lowest();
        let bounded = walk.max_bounces < u32::MAX;
        let grouped = film.channels > film.wavelengths;
        let a = &self.arrivals;
        let rough: Vec<Ratios> = self.shared.iter().map(|y| own(walk, y)).collect();
        let mut sums = Sums {
            first: vec![ONES; film.slots],
            second: vec![[0.0; ONES.len()]; film.slots],
        };
        for (i, (v, k)) in self.gathers.iter().enumerate() {
            let pixel = &mut pixels[k * size..(k + 1) * size];
            sums.take(film, pixel);
            let deeper = v.bounce - lowest;
            // Every vertex here is settled on a lobe, whose ratios no direction changes.
            let seen = times(v.ratios, walk.world.ratios(&v.hit, v.wo, v.wo));
            let rows = self.weight.chunks(count).zip(self.offset.chunks(count));
            for ((y, own), row) in self.shared.iter().zip(&rough).zip(rows) {
                let (weight, offset) = (row.0[i], row.1[i] + 1.0);
                if weight == 0.0 {
                    continue;
                }
                let weight = times([weight; ONES.len()], times(seen, *own));
                let range = y.first..y.end;
                let bins = &a.bins[range.clone()];
                let each = bins.iter().zip(&a.light[range.clone()]);
                let to = (v.hit.p - y.hit.p).normalized();
                for (k, (&b, &light)) in each.enumerate() {
                    let at = range.start + k;
                    if bounded && u32::from(a.bounces[at]) + deeper > walk.max_bounces {
                        continue;
                    }
                    let slot = floor(b + offset, last) as usize;
                    let (found, sum) = match &y.rough {
                        None if k % 2 == 0 => (light, &mut sums.first[slot]),
                        None => (light, &mut sums.second[slot]),
                        Some(surface) => {
                            // In place of the white Lambertian's 1/π.
                            let (n, from) = (y.hit.n, a.from[at]);
                            let scatter = surface.scatter(n, to, from);
                            // Light along the surface, whose cosine is 0, is no number.
                            if scatter.is_nan() || scatter <= 0.0 {
                                continue;
                            }
                            let cos = n.dot(from);
                            let found = light.map(|x| x * PI * scatter / cos);
                            (found, &mut sums.first[slot])
                        }
                    };
                    let found = times(weight, found);
                    add(sum, found);
                    if grouped {
                        let found = Light {
                            value: 1.0,
                            ratios: found,
                        };
                        film.add_to_groups(pixel, slot, &found, usize::from(a.spot[at]));
                    }
                }
            }
            sums.give(film, pixel);
        }
    }
}

/// The ratios of a rough vertex, whose arrivals are those of a white one.
fn own(walk: &Walk, y: &Shared) -> Ratios {
    match y.rough {
        None => ONES,
        Some(surface) => {
            let rough = Hit { surface, ..y.hit };
            walk.world.ratios(&rough, y.hit.n, y.hit.n)
        }
    }
}
