//! Carries light of several wavelengths to the pixels, as [`super::arrivals`] does for one
//! wavelength. The order is the same, so if the main wavelength is the brightest everywhere, it has
//! the same bits as it does alone.

use picofarm_scene::Vec3;

use super::{
    Shared, Sharing,
    spread::{floor, toward},
};
use crate::{
    bsdf::Surface,
    film::Film,
    lanes::{Wide, widest},
    spectra::{Light, ONES, Ratios, mix, times},
    walk::Walk,
    world::Hit,
};

/// Arguments of [`Sharing::spread_spectral`].
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

/// Sums of one pixel, with all wavelengths of a slot adjacent. Every second arrival is summed in
/// `second`.
struct Sums {
    first: Vec<Ratios>,
    second: Vec<Ratios>,
}

impl Sums {
    /// Loads a pixel's previous values.
    fn take(&mut self, film: &Film, pixel: &[f32]) {
        for wavelength in 0..film.wavelengths {
            let from = film.first_channel(wavelength) * film.slots;
            let of = &pixel[from..from + film.slots];
            for (sum, x) in self.first.iter_mut().zip(of) {
                sum[wavelength] = *x;
            }
        }
    }

    /// Stores the pixel's values with the additions.
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
    /// Carries the arrivals to the pixels if there are several wavelengths.
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
        let lowest = self.lowest;
        let bounded = walk.max_bounces < u32::MAX;
        let grouped = film.channels > film.wavelengths;
        let a = &self.arrivals;
        let rough: Vec<[Ratios; 2]> = self.shared.iter().map(|y| own(walk, y)).collect();
        let mut sent = vec![];
        let mut sums = Sums {
            first: vec![ONES; film.slots],
            second: vec![[0.0; ONES.len()]; film.slots],
        };
        for (i, (v, k)) in self.gathers.iter().enumerate() {
            let pixel = &mut pixels[k * size..(k + 1) * size];
            sums.take(film, pixel);
            let deeper = v.bounce - lowest;
            let here = walk.world.lobe_ratios(&v.hit);
            let rows = self.weight.chunks(count).zip(self.offset.chunks(count));
            for ((y, own), row) in self.shared.iter().zip(&rough).zip(rows) {
                let (weight, offset) = (row.0[i], row.1[i] + 1.0);
                if weight == 0.0 {
                    continue;
                }
                let to = toward(y, v);
                let seen = joined(&v.hit.surface, &here, (v.hit.n, v.wo, -to));
                let weight = times([weight; ONES.len()], times(v.ratios, seen));
                let range = y.first..y.end;
                let bins = &a.bins[range.clone()];
                if let Some(surface) = &y.rough {
                    self.gloss.send(y, surface, to, &mut sent);
                }
                let each = bins.iter().zip(&a.light[range.clone()]);
                for (k, (&b, &light)) in each.enumerate() {
                    let at = range.start + k;
                    if bounded && u32::from(a.bounces[at]) + deeper > walk.max_bounces {
                        continue;
                    }
                    let slot = floor(b + offset, last) as usize;
                    let sum = match k % 2 {
                        0 => &mut sums.first[slot],
                        _ => &mut sums.second[slot],
                    };
                    let found = match &y.rough {
                        None => light,
                        Some(_) if a.value[at] == 0.0 => continue,
                        Some(surface) => {
                            let ratios = joined(surface, own, (y.hit.n, to, a.from[at]));
                            let (sent, carried) = (sent[k], a.value[at]);
                            times(ratios, light.map(|x| sent * (x / carried)))
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

/// Returns the ratios of a rough vertex by lobe. Its arrivals are those of a white one.
fn own(walk: &Walk, y: &Shared) -> [Ratios; 2] {
    match y.rough {
        None => [ONES; 2],
        Some(surface) => walk.world.lobe_ratios(&Hit { surface, ..y.hit }),
    }
}

/// Returns the ratios with which a surface with normal `n` scatters from `i` to `o`, computed from
/// those of its Lambertian part and its conductor.
#[inline(always)]
fn joined(surface: &Surface, of: &[Ratios; 2], (n, i, o): (Vec3, Vec3, Vec3)) -> Ratios {
    match surface.is_mixed() {
        false => of[0],
        true => mix(surface.parts(n, i, o), of),
    }
}
