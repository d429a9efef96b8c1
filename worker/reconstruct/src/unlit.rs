//! Pixels that no spot lights: they are neither evidence of light nor of shadow, and have no times
//! of their own. A pixel whose few times disagree with its neighbours is such a pixel too, because
//! light of three bounces arrives where none of two does. Two rules place what can be placed: a
//! wall goes on where the lit surface around it ends, unless light arrives too early for it; and a
//! dark object that a spot hits is at the distance of the spot's own return.

use picofarm_scene::Vec3;

use crate::{
    Depth, Measured,
    closed_form::{closed_form, on_ellipsoid, smooth},
    planes::planes,
    scale::{in_room, lengths},
    walls::Wall,
};

/// The greatest number of spots whose times are not believed without a surface around the pixel.
const LONELY: usize = 2;
/// The least number of spots whose first light must be known for a wall to go on.
const FEWEST_TIMES: usize = 3;
/// The number of bins by which light may be early before a wall is refused.
const EARLY_BINS: f32 = 2.0;
/// The number of dark pixels among a pixel and its eight neighbours that make a dark object.
const CORE: usize = 7;
/// The number of pixels between a spot and the middle of its dark object, which may be thin there.
const THIN: u32 = 8;
/// The extent of a dark object around its spot, metres.
const OBJECT_M: f32 = 1.0;
/// The standard error of the distance of pixels that no spot lights, metres.
const ERROR_M: f32 = 0.05;
/// The relative difference in distance up to which neighbouring pixels are on one surface.
const JOINED: f32 = 0.06;

/// Leaves lonely times unused, and sets [`Measured::unlit_range_m`] of the pixels without depth.
/// `first` has the paths of first light, `[spot][row][column]`, metres; NaN = unknown.
pub(crate) fn fill(measured: &mut Measured, first: &[f32]) {
    in_room(measured, |measured, factor| {
        fill_room(measured, &lengths(first, factor));
    });
}

fn fill_room(measured: &mut Measured, first: &[f32]) {
    let pixels = measured.pixels();
    let mut refined = measured.clone();
    let raw = closed_form(&mut refined).0;
    let mut depth = smooth(&refined, &raw);
    for p in 0..pixels {
        let pairs = || (0..measured.spots.len()).map(move |k| k * pixels + p);
        let lit = |q: &usize| measured.lit[*q] != 0 && measured.used[*q] != 0;
        let few = !measured.computed && pairs().filter(lit).count() <= LONELY;
        if few && depth.normal[p] == Vec3::ZERO && depth.range[p].is_finite() {
            depth.range[p] = f32::NAN;
            for q in pairs().collect::<Vec<_>>() {
                measured.used[q] = 0;
            }
        }
    }
    let (walls, _) = planes(&refined, &depth, (0, 1.0));
    let mut found = vec![f32::NAN; pixels];
    let wanted: Vec<Option<f32>> = (0..pixels)
        .map(|p| {
            let mirror = measured.mirror.get(p).is_some_and(|m| *m != 0);
            let dark = !depth.range[p].is_finite() && !mirror;
            dark.then(|| on_wall(&refined, &walls, first, p)).flatten()
        })
        .collect();
    join(measured, &mut depth.range, &wanted, |p, range| {
        found[p] = range
    });
    objects(&refined, &walls, &depth, &mut found);
    measured.unlit_range_m = found;
}

/// Returns the distance of the first wall on a pixel's ray, unless first light arrives before the
/// straight path by it.
fn on_wall(measured: &Measured, walls: &[Wall], first: &[f32], pixel: usize) -> Option<f32> {
    let (origin, ray) = (measured.camera.origin, measured.ray(pixel));
    let hits = walls.iter().filter_map(|w| w.hit(origin, ray));
    let range = hits.min_by(f32::total_cmp)?;
    // At a small angle, the near end of a pixel's surface is much nearer than its middle.
    let early = EARLY_BINS * measured.bin_width_m + JOINED * range;
    let pixels = measured.pixels();
    let known = (0..measured.spots.len()).filter(|k| first[k * pixels + pixel].is_finite());
    if known.count() < FEWEST_TIMES {
        return None;
    }
    let possible = measured.spots.iter().enumerate().all(|(k, spot)| {
        let seen = first[k * pixels + pixel] + early - spot.path_m;
        let far = on_ellipsoid(seen, spot.point - origin, ray);
        !(far.is_finite() && far > 0.0 && far < range)
    });
    possible.then_some(range)
}

/// Places dark objects that spots hit: the pixels around the spot that are dark with their
/// neighbours, on the plane through the spot that is parallel to a wall and most faces the camera.
fn objects(measured: &Measured, walls: &[Wall], depth: &Depth, found: &mut [f32]) {
    let i = &measured.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let dark = |p: usize| !depth.range[p].is_finite();
    let around = |p: usize| {
        let (u, v) = (p % width, p / width);
        (v.saturating_sub(1)..(v + 2).min(height)).flat_map(move |b| {
            (u.saturating_sub(1)..(u + 2).min(width)).map(move |a| b * width + a)
        })
    };
    let core = |p: usize| around(p).filter(|q| dark(*q)).count() >= CORE;
    for spot in &measured.spots {
        let Some(start) = measured.pixel_of(spot.point).filter(|p| dark(*p)) else {
            continue;
        };
        let ray = measured.ray(start);
        let normals = walls.iter().flat_map(|w| [w.plane.normal, -w.plane.normal]);
        let facing = normals.max_by(|a, b| a.dot(ray).total_cmp(&b.dot(ray)));
        let normal = facing.unwrap_or(measured.camera.forward);
        let place = |p: usize| -> Option<f32> {
            let ray = measured.ray(p);
            let range = normal.dot(spot.point - measured.camera.origin) / normal.dot(ray);
            let x = measured.camera.origin + ray * range;
            (range > 0.0 && (x - spot.point).length() < OBJECT_M).then_some(range)
        };
        let mut thin = vec![u32::MAX; width * height];
        let mut edge = std::collections::VecDeque::from([(start, 0)]);
        thin[start] = 0;
        while let Some((p, steps)) = edge.pop_front() {
            let steps = if core(p) { 0 } else { steps + 1 };
            let Some(range) = place(p).filter(|_| steps <= THIN) else {
                continue;
            };
            if core(p) || around(p).any(core) {
                found[p] = range;
            }
            for q in around(p).filter(|q| dark(*q)) {
                if steps < thin[q] {
                    thin[q] = steps;
                    edge.push_back((q, steps));
                }
            }
        }
    }
}

/// Adds the distances of pixels that no spot lights to those in closed form, and returns their
/// number.
pub(crate) fn add(measured: &Measured, raw: &mut Depth) -> usize {
    let mut count = 0;
    for (p, &range) in measured.unlit_range_m.iter().enumerate() {
        if !raw.range[p].is_finite() && range.is_finite() && range > 0.0 {
            (raw.range[p], raw.error[p]) = (range, ERROR_M);
            count += 1;
        }
    }
    count
}

/// Adds the wanted distances that continue known ones from pixel to pixel, and calls `joined` with
/// each.
fn join(
    measured: &Measured,
    range: &mut [f32],
    wanted: &[Option<f32>],
    mut joined: impl FnMut(usize, f32),
) {
    let width = measured.camera.intrinsics.width as usize;
    let mut edge: Vec<usize> = (0..wanted.len())
        .filter(|p| range[*p].is_finite())
        .collect();
    while let Some(p) = edge.pop() {
        let (u, own) = (p % width, range[p]);
        let beside = [
            p.checked_sub(width),
            Some(p + width).filter(|q| *q < wanted.len()),
            (u > 0).then(|| p - 1),
            (u + 1 < width).then(|| p + 1),
        ];
        for q in beside.into_iter().flatten() {
            let Some(new) = wanted[q].filter(|_| !range[q].is_finite()) else {
                continue;
            };
            if (new - own).abs() < JOINED * own {
                range[q] = new;
                joined(q, new);
                edge.push(q);
            }
        }
    }
}
