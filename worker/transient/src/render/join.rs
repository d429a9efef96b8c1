//! Joins a tile's new passes with its earlier ones.

use crate::render::{
    done::Done,
    draws::{self, Draw},
    frame::Frame,
    image::Image,
    spread::joined_variance,
    stat::Stat,
};

impl Image {
    /// Joins a tile's new passes with its earlier ones, weighted by passes. `two` is the weight of
    /// the new two-bounce part, 0 if there is none. `more` is true if more rounds may follow.
    pub fn join(&mut self, frame: &Frame, (t, two, more): (usize, f64, bool), done: &Done) {
        let (film, region, bins) = (frame.film, self.tiles[t], self.bins);
        let (spent, added) = (f64::from(self.passes), f64::from(done.passes));
        let b = match spent == 0.0 {
            true => 1.0,
            false => added / (spent + added),
        };
        let (a, stays) = (1.0 - b, 1.0 - two);
        // Converts render units to metres: every path has one 1/d² left over.
        let unit = f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale);
        let unit2 = unit * unit;
        let blend = |(a, b): (f64, f64), old: f64, x: f64| old * a * a + x * b * b;
        // A single pass gives no error estimate, so its error is assumed to be that of the passes
        // before it.
        let alone = spent > 0.0 && done.passes == 1;
        let multi = |old: f64, x: f64| match alone {
            true => old * a,
            false => blend((a, b), old, x),
        };
        let before = dense(&self.tile_two[t], region.pixels() * film.pixel());
        let mut after = before.clone();
        if two > 0.0 {
            for (after, new) in after.iter_mut().zip(done.two()) {
                *after = (f64::from(*after) * stays + f64::from(*new) * two) as f32;
            }
        }
        // Joins both parts of a slot, from their previous sum.
        let joined = |old: f32, at: usize, x: f64| {
            let (before, after) = (f64::from(before[at]) * unit, f64::from(after[at]) * unit);
            // A rounding residue is not light.
            let old = (f64::from(old) - before).max(0.0);
            let x = x * unit;
            ((after + old * a + x * b) as f32, x - old)
        };
        for k in 0..region.pixels() {
            let row = region.row as usize + k / region.cols as usize;
            let col = region.col as usize + k % region.cols as usize;
            let pixel = row * self.width + col;
            let mut stat = Stat::default();
            let mut difference2 = 0.0;
            for bin in 0..bins {
                let m = done.moments(film, k, bin + 1);
                let at = pixel * bins + bin;
                let place = k * film.pixel() + bin + 1;
                let (h, difference) = joined(self.transient[at], place, m.multi);
                self.transient[at] = h;
                stat.norm2 += f64::from(h) * f64::from(h);
                stat.total += f64::from(h);
                difference2 += difference * difference;
                if let Some(s) = &mut self.split {
                    let root = |variance: f64| variance.sqrt() as f32;
                    let square = |x: f32| f64::from(x) * f64::from(x);
                    let mean = |(a, b): (f64, f64), old: f32, x: f64| {
                        (f64::from(old) * a + x * unit * b) as f32
                    };
                    let of_two = (stays, two);
                    s.two[at] = mean((0.0, 1.0), 0.0, f64::from(after[place]));
                    let variance = blend(of_two, square(s.two_se[at]), m.two_variance * unit2);
                    s.two_se[at] = root(variance);
                    let noise = done.two_noise(film, k, bin + 1);
                    s.two_noise[at] = mean(of_two, s.two_noise[at], noise);
                    s.multi[at] = mean((a, b), s.multi[at], m.multi);
                    s.multi_noise[at] = match alone {
                        true => (f64::from(s.multi_noise[at]) * a.sqrt()) as f32,
                        false => mean((a, b), s.multi_noise[at], done.noise(film, k, bin + 1)),
                    };
                    let old = square(s.multi_se[at]);
                    s.multi_se[at] = root(multi(old, m.multi_variance * unit2));
                }
            }
            for (g, group) in self.groups.iter_mut().enumerate() {
                for bin in 0..bins {
                    let at = pixel * bins + bin;
                    let place = k * film.pixel() + (g + 1) * film.slots + bin + 1;
                    let x = done.multi(film, k, g + 1, bin + 1);
                    group[at] = joined(group[at], place, x).0;
                }
            }
            let (two_variance, multi_variance) = done.pixel_variance(k);
            let old = self.stats[pixel];
            let variances = (old.multi_variance, multi_variance * unit2);
            self.stats[pixel] = Stat {
                two_variance: blend((stays, two), old.two_variance, two_variance * unit2),
                multi_variance: joined_variance((spent, added), variances, difference2),
                ..stat
            };
        }
        // Errors of rounds are independent, so on average their squares add up. For few passes,
        // their variance replaces the draws.
        let of = &mut self.of_tiles[t];
        of.draws.resize(draws::count(&region), Draw::default());
        of.two_draws.resize(of.draws.len(), 0.0);
        let pixels = draws::watched(&region).map(|k| {
            let (row, col) = (k / region.cols as usize, k % region.cols as usize);
            (region.row as usize + row) * self.width + region.col as usize + col
        });
        for ((draw, new), pixel) in of.draws.iter_mut().zip(done.draws()).zip(pixels) {
            if draws::are_drawn(done.passes) {
                for (old, new) in draw.iter_mut().zip(new) {
                    *old = blend((a, b), *old, new * unit2);
                }
            } else if draws::are_drawn(self.passes) {
                draw.iter_mut().for_each(|old| *old *= a);
            } else {
                *draw = draws::of_variance(self.stats[pixel].multi_variance);
            }
        }
        for (old, new) in of.two_draws.iter_mut().zip(done.two_draws()) {
            *old = blend((stays, two), *old, new * unit2);
        }
        let (energy, spread) = done.multi_energy();
        let (energy, spread) = (energy * unit, spread.scaled(unit));
        of.spread = of.spread.joined((spent, of.multi), spread, (added, energy));
        of.multi = of.multi * a + energy * b;
        let two_variance = done.two_energy_variance() * unit2;
        of.two_variance = blend((stays, two), of.two_variance, two_variance);
        let outside = done.overflow(film);
        of.overflow.0 = of.overflow.0 * stays + outside.0 * unit * two;
        of.overflow.1 = of.overflow.1 * a + outside.1 * unit * b;
        if two > 0.0 && more {
            self.tile_two[t] = sparse(&after);
        }
    }
}

/// Returns the nonzero values with their indices.
fn sparse(values: &[f32]) -> Vec<(u32, f32)> {
    let each = (0u32..).zip(values.iter().copied());
    each.filter(|(_, v)| *v != 0.0).collect()
}

/// Expands sparse values to all `count` values.
fn dense(values: &[(u32, f32)], count: usize) -> Vec<f32> {
    let mut all = vec![0.0; count];
    for &(at, v) in values {
        all[at as usize] = v;
    }
    all
}
