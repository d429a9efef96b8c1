//! Depth and shadows from a histogram of each spot alone, by the two methods that were published
//! for such captures. They are what one flash is compared with.
//!
//! The matched filter is that of PlatoNeRF (Klinghoffer et al., CVPR 2024), whose code compares
//! with bounce-flash lidar in this way. The likelihood ratio is that of bounce-flash lidar itself
//! (Henley et al., 2022). Both follow a pixel's ray to where the two-bounce path of a spot ends,
//! and combine the ranges of all spots that light the pixel.

mod likelihood;
mod matched;
mod returns;

use picofarm_scene::Vec3;
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Capture, DemultiplexError, Demultiplexed, Ground, Place,
    demultiplex::{LEAP, NEAR, relative, spot_normal},
    geometry::{Rays, Source, normals, places},
};
use returns::{Return, Timing};

/// Version of the methods: changes whenever any bit of a result may change.
pub const SEPARATE_VERSION: &str = "separate-2";

/// A published method for separate captures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Separate {
    /// Correlation with the one-bounce pulse: the place of its maximum is the two-bounce time, and
    /// a pixel is lit where the maximum is high enough. Depth is the median over the spots.
    MatchedFilter,
    /// Peak statistics: mean, width and photons of a return. Depth is the mean over the spots,
    /// weighted by inverse variance. A pixel is lit where a likelihood ratio of the photons at the
    /// expected time exceeds a limit.
    Likelihood,
}

/// Deviation of a spot's range from the pixel's up to which it agrees, metres.
const AGREES_M: f32 = 0.05;
/// Least cosine that is assumed: a normal from a map of depths may be wrong, and the light decides.
const LEAST_COSINE: f32 = 0.1;
/// Least cos·cos/r², 1/m², from which the energy of a pair tells the albedo.
const LEAST_SHAPE: f32 = 0.02;

/// Returns depth and shadows by a method for separate captures.
///
/// `read` returns the histogram of a spot by its index in `capture.spots`, `[row][column][bin]`. It
/// is called once or twice for each spot, so that a caller need not hold all of them.
/// `capture.histogram` is not used. `photons` is the number of photons for a unit of the
/// histograms. The result has no mirrors. The same bytes on any number of threads.
///
/// # Errors
/// [`DemultiplexError`] names the argument that cannot be used; the errors of `read`.
pub fn separate<E: From<DemultiplexError>>(
    capture: &Capture,
    method: Separate,
    photons: f32,
    read: &mut dyn FnMut(usize) -> Result<Vec<f32>, E>,
) -> Result<Demultiplexed, E> {
    if !(photons.is_finite() && photons > 0.0) {
        let what = format!("is {photons}, expected a positive number of photons for a unit");
        return Err(DemultiplexError::invalid("photons", what).into());
    }
    let width = capture.gate.bin_width_m;
    if method == Separate::Likelihood && width > likelihood::WIDEST_M {
        let what = format!(
            "are {width} m wide; the likelihood ratio judges the widths of returns, for which bins \
             of at most {} m are narrow enough: import narrower bins, or use matched-filter",
            likelihood::WIDEST_M
        );
        return Err(DemultiplexError::invalid("gate: bins", what).into());
    }
    let rays = Rays::new(capture.camera.intrinsics);
    let (pixels, count) = (rays.len(), capture.spots.len());
    let mut found = Found {
        rays,
        places: vec![None; count],
        sources: Vec::new(),
        returns: vec![Return::NONE; count * pixels],
    };
    for spot in 0..count {
        let histogram = read(spot)?;
        let one = Capture {
            histogram: &histogram,
            spots: &capture.spots[spot..=spot],
            ..*capture
        };
        one.check().map_err(|e| e.in_spot(spot))?;
        let Some(place) = places(&one)[0] else {
            continue;
        };
        found.places[spot] = Some(place);
        let source = Source::new(spot, capture.camera.to_camera(place.point), place.path_m);
        let part = &mut found.returns[spot * pixels..][..pixels];
        let timing = Timing::new(&capture.gate, &source);
        match method {
            Separate::MatchedFilter => matched::returns(&histogram, &timing, part),
            Separate::Likelihood => likelihood::returns(&histogram, photons, &timing, part),
        }
        found.sources.push(source);
    }
    if found.sources.is_empty() {
        return Err(DemultiplexError::NoReturn { count }.into());
    }
    let surface = found.surface(method)?;
    let (lit, albedo) = found.light(&surface);
    let lit = match method {
        Separate::MatchedFilter => lit,
        Separate::Likelihood => {
            let mut all = vec![0.0; count * pixels];
            for (source, normal) in found.sources.iter().zip(&surface.at) {
                let histogram = read(source.beam)?;
                let judge = likelihood::Judge {
                    timing: Timing::new(&capture.gate, source),
                    photons,
                    source,
                    normal: *normal,
                    rays: &found.rays,
                    surface: &surface,
                    albedo: &albedo,
                };
                judge.lit(&histogram, &mut all[source.beam * pixels..][..pixels]);
            }
            all
        }
    };
    let camera = capture.camera;
    let world = |n: &Vec3| camera.right * n.x + camera.down * n.y + camera.forward * n.z;
    Ok(Demultiplexed {
        places: found.places,
        depth_m: surface.depth,
        confidence: surface.confidence,
        normals: surface.normals.iter().map(world).collect(),
        ground: vec![Ground::Light; lit.len()],
        lit,
        albedo: relative(albedo),
        mirror: None,
        mirror_probability: vec![0.0; pixels],
    })
}

/// The returns of all pairs of pixel and spot.
struct Found {
    rays: Rays,
    places: Vec<Option<Place>>,
    sources: Vec<Source>,
    /// `[spot][row][column]`.
    returns: Vec<Return>,
}

/// The surface that all spots together give.
struct Surface {
    depth: Vec<f32>,
    confidence: Vec<f32>,
    /// Camera axes; zero where unknown.
    normals: Vec<Vec3>,
    /// Normals at the sources, in their order.
    at: Vec<Vec3>,
}

impl Found {
    fn surface(&self, method: Separate) -> Result<Surface, DemultiplexError> {
        let rays = &self.rays;
        let each = |p: usize| self.range(p, method);
        let ranges: Vec<Option<(f32, f32)>> = (0..rays.len()).into_par_iter().map(each).collect();
        let Some(nearest) = nearest(rays, &ranges) else {
            let what = "no pixel has a two-bounce return in any capture; see whether gate, laser and \
                        spots belong to these histograms";
            return Err(DemultiplexError::invalid("histogram", what));
        };
        let pixel = |p: usize| {
            let (range, _) = ranges[nearest[p]].expect("nearest has a range");
            // A pixel without a return takes its neighbour's depth.
            let z = range / rays.slant[nearest[p]];
            (z, ranges[p].map_or(0.0, |(_, agree)| agree))
        };
        let (depth, confidence): (Vec<f32>, Vec<f32>) = (0..rays.len()).map(pixel).unzip();
        let normals = normals(rays, &depth, NEAR * rays.step(), LEAP);
        let at = |s: &Source| spot_normal(rays, &depth, &normals, s);
        Ok(Surface {
            at: self.sources.iter().map(at).collect(),
            depth,
            confidence,
            normals,
        })
    }

    /// Returns the range of a pixel, and the share of its returns that agree with it.
    fn range(&self, pixel: usize, method: Separate) -> Option<(f32, f32)> {
        let pixels = self.rays.len();
        let ray = self.rays.unit[pixel];
        let own = self.sources.iter().filter_map(|source| {
            let found = self.returns[source.beam * pixels + pixel];
            let (range, slope) = along(source, ray, found.path_m)?;
            found
                .lit
                .then_some((range, found.variance_m2 * slope * slope))
        });
        let own: Vec<(f32, f32)> = own.collect();
        let range = match method {
            _ if own.is_empty() => return None,
            Separate::MatchedFilter => median(own.iter().map(|(range, _)| *range).collect()),
            Separate::Likelihood => {
                let (mut sum, mut weights) = (0.0f64, 0.0f64);
                for (range, variance) in &own {
                    let weight = 1.0 / f64::from(variance.max(f32::MIN_POSITIVE));
                    sum += weight * f64::from(*range);
                    weights += weight;
                }
                (sum / weights) as f32
            }
        };
        let agree = own.iter().filter(|(r, _)| (r - range).abs() <= AGREES_M);
        Some((range, agree.count() as f32 / own.len() as f32))
    }

    /// Returns the masks of the returns, and the albedo of each pixel in energy for cos·cos/r².
    fn light(&self, surface: &Surface) -> (Vec<f32>, Vec<f32>) {
        let pixels = self.rays.len();
        let lit = self.returns.iter().map(|r| f32::from(u8::from(r.lit)));
        let albedo = |p: usize| {
            let each = self.sources.iter().zip(&surface.at).filter_map(|(s, n)| {
                let found = self.returns[s.beam * pixels + p];
                let shape = shape(&self.rays, surface, s, *n, p);
                (found.lit && shape > LEAST_SHAPE).then_some(found.energy / shape)
            });
            let each: Vec<f32> = each.collect();
            (!each.is_empty()).then(|| median(each))
        };
        let albedo: Vec<Option<f32>> = (0..pixels).into_par_iter().map(albedo).collect();
        let known: Vec<f32> = albedo.iter().copied().flatten().collect();
        let usual = if known.is_empty() { 1.0 } else { median(known) };
        let albedo = albedo.into_iter().map(|a| a.unwrap_or(usual)).collect();
        (lit.collect(), albedo)
    }
}

/// Returns the share of a spot's light that a pixel's surface gets if nothing is in between:
/// cos·cos/r², 1/m². A normal that is unknown counts as one that faces the other.
fn shape(rays: &Rays, surface: &Surface, source: &Source, normal: Vec3, pixel: usize) -> f32 {
    let x = rays.unit[pixel] * (surface.depth[pixel] * rays.slant[pixel]);
    let way = x - source.point;
    let square = way.dot(way).max(1e-4);
    let way = way / square.sqrt();
    let facing = |n: Vec3, d: Vec3| match n == Vec3::ZERO {
        true => 1.0,
        false => n.dot(d).max(LEAST_COSINE),
    };
    facing(normal, way) * facing(surface.normals[pixel], -way) / square
}

/// Returns the range along a ray at which the path by way of a spot has this length, and its
/// derivative with respect to the path: an ellipsoid with spot and camera as foci.
fn along(source: &Source, ray: Vec3, path_m: f32) -> Option<(f32, f32)> {
    let rest = f64::from(path_m) - f64::from(source.path_m);
    let square = f64::from(source.square);
    let denominator = rest - f64::from(ray.dot(source.point));
    let beyond = rest * rest - square;
    if !(rest > 0.0 && beyond > 0.0 && denominator > 0.0) {
        return None;
    }
    let range = beyond / (2.0 * denominator);
    let slope = (2.0 * rest * denominator - beyond) / (2.0 * denominator * denominator);
    Some((range as f32, slope as f32))
}

/// Returns the median; of an even number the mean of both in the middle.
fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    let middle = values.len() / 2;
    match values.len() % 2 {
        0 => 0.5 * (values[middle - 1] + values[middle]),
        _ => values[middle],
    }
}

/// Returns for each pixel the nearest one with a value, by steps to the four neighbours; `None` if
/// there is none at all.
fn nearest<T>(rays: &Rays, values: &[Option<T>]) -> Option<Vec<usize>> {
    let mut from: Vec<Option<usize>> = (0..values.len())
        .map(|p| values[p].is_some().then_some(p))
        .collect();
    let mut queue: std::collections::VecDeque<usize> =
        (0..values.len()).filter(|p| values[*p].is_some()).collect();
    while let Some(p) = queue.pop_front() {
        let (column, row) = (p % rays.width, p / rays.width);
        let around = [
            (row > 0).then(|| p - rays.width),
            (column > 0).then(|| p - 1),
            (column + 1 < rays.width).then(|| p + 1),
            (row + 1 < rays.height).then(|| p + rays.width),
        ];
        for q in around.into_iter().flatten() {
            if from[q].is_none() {
                from[q] = from[p];
                queue.push_back(q);
            }
        }
    }
    from.into_iter().collect()
}

/// Returns the middle of the gate's bin, metres of path.
fn middle(gate: &Gate, bin: f64) -> f64 {
    gate.start_m + (bin + 0.5) * gate.bin_width_m
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_and_its_slope_follow_from_the_path() {
        let source = Source::new(0, Vec3::new(0.4, -0.2, 1.5), 1.7);
        let ray = Vec3::new(-0.3, 0.1, 1.0).normalized();
        for range in [0.5, 1.4, 2.2] {
            let path = |range: f32| source.path(ray * range);
            let (found, slope) = along(&source, ray, path(range)).expect("a path");
            assert!((found - range).abs() < 1e-5, "{found} for {range}");
            let step = 1e-2;
            let expected = 2.0 * step / (path(range + step) - path(range - step));
            assert!((slope - expected).abs() < 1e-2 * expected, "{slope}");
        }
        assert_eq!(along(&source, ray, 1.8), None);
    }

    #[test]
    fn a_pixel_without_a_return_takes_the_nearest() {
        let lens = picofarm_scene::Intrinsics {
            fx: 3.0,
            fy: 3.0,
            cx: 1.5,
            cy: 1.0,
            width: 3,
            height: 2,
        };
        let rays = Rays::new(lens);
        let one = [None, None, Some(1.0), None, None, None];
        assert_eq!(nearest(&rays, &one), Some(vec![2; 6]));
        let two = [Some(1.0), None, None, None, None, Some(2.0)];
        assert_eq!(nearest(&rays, &two), Some(vec![0, 0, 5, 0, 5, 5]));
        assert_eq!(nearest(&rays, &[None::<f32>; 6]), None);
    }
}
