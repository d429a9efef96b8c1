//! Carries the arrivals at the shared vertices to the pixels.

use picofarm_scene::Vec3;

use crate::{
    film::slots::Film,
    numeric::lanes::{SIDE, Wide, widest},
    paths::{
        path_reuse::{shared::Shared, sharing::Sharing},
        tracer::Walk,
        vertex::Vertex,
    },
};

impl Sharing {
    /// Carries the arrivals to the pixels.
    pub(crate) fn spread(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        widest(Spread {
            sharing: self,
            walk,
            film,
            pixels,
        });
    }

    #[inline(always)]
    pub fn spread_wide(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        let count = self.gathers.len();
        let size = film.pixel();
        let last = film.slots as f32 - 1.0;
        let lowest = self.lowest;
        let bounded = walk.max_bounces < u32::MAX;
        // Every second arrival is summed here. An addition that waits for the previous one in the
        // same slot takes several times as long.
        let mut second = vec![0.0f32; film.slots];
        let mut sent = vec![];
        for (i, (v, k)) in self.gathers.iter().enumerate() {
            let pixel = &mut pixels[k * size..(k + 1) * size];
            let deeper = v.bounce - lowest;
            for (y, row) in self
                .shared
                .iter()
                .zip(self.weight.chunks(count).zip(self.offset.chunks(count)))
            {
                let (weight, offset) = (row.0[i], row.1[i] + 1.0);
                if weight == 0.0 {
                    continue;
                }
                let range = y.first..y.end;
                let a = &self.arrivals;
                // Whole groups; the padding past the last arrival is zero.
                let groups = y.first..y.end.next_multiple_of(SIDE);
                let values = match &y.rough {
                    None => &a.value[groups.clone()],
                    Some(surface) => {
                        self.gloss.send(y, surface, toward(y, v), &mut sent);
                        &sent
                    }
                };
                if film.channels == 1 && !bounded {
                    let first = &mut pixel[..film.slots];
                    let (bins, _) = a.bins[groups].as_chunks::<SIDE>();
                    let (values, _) = values.as_chunks::<SIDE>();
                    let mut left = range.len();
                    // Slots and values are computed with SIMD.
                    for (bins, values) in bins.iter().zip(values) {
                        let (mut slots, mut found) = ([0u32; SIDE], [0.0f32; SIDE]);
                        for (slot, b) in slots.iter_mut().zip(bins) {
                            *slot = floor(b + offset, last);
                        }
                        for (found, v) in found.iter_mut().zip(values) {
                            *found = weight * v;
                        }
                        if left >= SIDE {
                            for k in (0..SIDE).step_by(2) {
                                first[slots[k] as usize] += found[k];
                                second[slots[k + 1] as usize] += found[k + 1];
                            }
                            left -= SIDE;
                        } else {
                            for k in 0..left {
                                let sums = if k % 2 == 0 { &mut *first } else { &mut second };
                                sums[slots[k] as usize] += found[k];
                            }
                        }
                    }
                    continue;
                }
                let rest = a.spot[range.clone()].iter().zip(&a.bounces[range]);
                let each = a.bins[y.first..y.end].iter().zip(values).zip(rest);
                // The order is the same as above, so groups of spots do not change a bit.
                for (k, ((&b, &value), (&spot, &bounces))) in each.enumerate() {
                    if u32::from(bounces) + deeper > walk.max_bounces {
                        continue;
                    }
                    let slot = floor(b + offset, last) as usize;
                    let value = weight * value;
                    let first = if k % 2 == 0 {
                        &mut pixel[slot]
                    } else {
                        &mut second[slot]
                    };
                    *first += value;
                    film.add_to_groups(pixel, slot, value, usize::from(spot));
                }
            }
            for (sum, second) in pixel.iter_mut().zip(&mut second) {
                *sum += std::mem::take(second);
            }
        }
    }
}

/// Arguments of [`Sharing::spread`].
struct Spread<'a> {
    pub sharing: &'a Sharing,
    pub walk: &'a Walk<'a>,
    pub film: &'a Film,
    pub pixels: &'a mut [f32],
}

impl Wide for Spread<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let of = (self.walk, self.film);
        self.sharing.spread_wide(of, self.pixels);
    }
}

/// Unit direction from a shared vertex to a gather point.
#[inline(always)]
fn toward(y: &Shared, v: &Vertex) -> Vec3 {
    let to = v.hit.p - y.hit.p;
    to * (1.0 / to.length())
}

/// Returns ⌊x⌋ clamped to 0..=last, for last < 2²². Half an ulp of 2²³ is ½, so adding 2²³ leaves
/// the integer in the low bits, without the checks of a cast. (An x within rounding of an integer
/// may fall to either side.)
#[inline(always)]
fn floor(x: f32, last: f32) -> u32 {
    let half = x.max(0.5).min(last + 0.5) - 0.5;
    (half + 8_388_608.0).to_bits() & 0x007f_ffff
}

#[cfg(test)]
mod tests {
    use crate::paths::path_reuse::spread::floor;

    #[test]
    fn slots_are_whole_parts_within_their_range() {
        for k in 0..4000u32 {
            for part in [0.01, 0.3, 0.5, 0.7, 0.99] {
                assert_eq!(floor(k as f32 + part, 638.0), k.min(638));
            }
        }
        assert_eq!(floor(-7.5, 638.0), 0);
        assert_eq!(floor(f32::INFINITY, 638.0), 638);
        assert_eq!(floor(1_048_577.5, 1_048_577.0), 1_048_577);
    }
}
