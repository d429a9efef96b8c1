//! Measures which class of paths has the most variance, from a few tiles of the image.

use picofarm_scene::Scene;
use rayon::prelude::*;

use crate::{
    api::{RenderError, Settings, Stop, Unstopped},
    film::{
        class::{CLASSES, class_name},
        slots::Film,
        technique::TECHNIQUES,
    },
    paths::{
        path_reuse::{sharing::Sharing, tile::Tile},
        scratch::Scratch,
    },
    render::{
        forecast::{places, regions},
        frame::{Frame, unit},
        layer::Layer,
        prepare::prepare,
        region::Region,
        sources::Sources,
        thin::Thin,
        tile::{Order, TileRenderer},
        watch::Watch,
    },
};

/// The contribution of one class of paths to the part of three bounces and more, or to the light
/// drawn into the image outside the tiles.
#[derive(Debug, Clone, PartialEq)]
pub struct ClassVariance {
    /// The place on the path, and the technique.
    pub class: String,
    /// Fraction of the energy.
    pub energy: f64,
    /// Sum over the pixels of the class's squared error relative to the pixel, as a fraction of
    /// that of all classes.
    pub variance: f64,
    /// Like `variance`, over the middle half of the pixels ordered by their error, which determine
    /// the median.
    pub middle: f64,
}

/// The number of classes of the tiles' paths, and of techniques that draw into the image.
const ALL: usize = CLASSES + TECHNIQUES.len();

/// Sums of one tile's pixels.
struct Found {
    pub region: Region,
    /// h by pixel and bin.
    pub light: Vec<f32>,
    /// Energy and variance, by pixel and class.
    pub classes: Vec<[(f64, f64); ALL]>,
}

/// Returns the fractions of the classes in the energy and variance of three bounces and more, and
/// of all light drawn into the image outside the tiles, after `passes` passes over a few tiles. The
/// largest variance is first, and classes without light are omitted. Runs on the caller's rayon
/// pool.
///
/// # Errors
/// Returns the errors of [`crate::render::driver`].
pub fn variance(
    scene: &Scene,
    settings: &Settings,
    passes: u32,
) -> Result<Vec<ClassVariance>, RenderError> {
    prepare(scene, settings, Stop(&Unstopped), |ready| {
        if !ready.walks() {
            return Ok(vec![]);
        }
        let film = Film::by_class(&settings.gate);
        let by_class = Frame {
            film: &film,
            ..ready.frame
        };
        let passes = passes.max(2);
        let mut found: Vec<Found> = regions(&ready.frame)
            .into_par_iter()
            .map(|region| look((&ready.frame, &by_class), region, passes))
            .collect();
        drawn(&ready.frame, &mut found, passes)?;
        Ok(shares(ready.frame.film, &found))
    })
}

/// Adds the light drawn into the image. Light paths cross tiles, so all of them are traced for the
/// sampled tiles.
fn drawn(frame: &Frame, found: &mut [Found], passes: u32) -> Result<(), RenderError> {
    let Some(sources) = Sources::of(frame) else {
        return Ok(());
    };
    let mut layers = TECHNIQUES.map(|_| Layer::new(frame));
    let watch = Watch::new(&Unstopped, 0.0, 1.0);
    let regions: Vec<Region> = found.iter().map(|f| f.region).collect();
    // The number of light paths equals that of a render, because their variance is measured.
    let thin = Thin {
        regions: &regions,
        ..Thin::WHOLE
    };
    for pass in 0..passes {
        let (mut splats, _) = sources.pass(frame, (u32::MAX - passes + pass, &watch), thin);
        splats.sort_by_key(|s| (s.technique as usize, s.pixel, s.slot));
        for of in splats.chunk_by(|a, b| a.technique == b.technique) {
            layers[of[0].technique as usize].add(frame, of, pass)?;
        }
    }
    let bins = frame.film.slots - 2;
    let places = places(frame, &regions);
    let unit = unit(frame);
    for (technique, layer) in layers.iter_mut().enumerate() {
        layer.settle(frame)?;
        layer.each(frame, passes, Stop(&Unstopped), |pixel, of| {
            let Some(&(tile, k)) = places.get(&pixel) else {
                return;
            };
            let Found { light, classes, .. } = &mut found[tile];
            let (energy, variance) = &mut classes[k][CLASSES + technique];
            for (bin, mean, _) in of.light() {
                light[k * bins + bin] += (mean / unit) as f32;
                *energy += mean / unit;
            }
            *variance += of.pixel_variance() / (unit * unit);
        })?;
    }
    Ok(())
}

fn look((frame, by_class): (&Frame, &Frame), region: Region, passes: u32) -> Found {
    let first = u32::MAX - passes;
    let order = Order {
        first,
        count: passes,
        two: true,
    };
    let mut renderer = TileRenderer::new(frame);
    renderer
        .render(frame, &region, &order, &|_| true)
        .expect("nobody stops it");
    let pixels = region.pixels();
    let slots = 1..frame.film.slots - 1;
    let light = (0..pixels).flat_map(|k| {
        let h = |slot| renderer.done.value(frame.film, k, 0, slot) as f32;
        slots.clone().map(h).collect::<Vec<f32>>()
    });
    let light = light.collect();
    let (walk, film, side) = (&by_class.walk, by_class.film, by_class.effort.side);
    let size = film.pixel();
    let (mut sum, mut square) = (vec![0.0f32; pixels * size], vec![0.0f32; pixels * size]);
    let mut scratch = Scratch::new(walk.world, walk.emitters, walk.mirrors);
    let (mut sharing, mut found) = (Sharing::default(), vec![]);
    for pass in 0..passes {
        for row in (0..region.rows).step_by(side as usize) {
            for col in (0..region.cols).step_by(side as usize) {
                let (rows, cols) = (side.min(region.rows - row), side.min(region.cols - col));
                found.clear();
                found.resize((rows * cols) as usize * size, 0.0);
                let tile = Tile {
                    row: region.row + row,
                    col: region.col + col,
                    cols,
                    width: by_class.width,
                    seed: by_class.seed,
                    pass: u64::from(first + pass),
                    mirrors: &by_class.sampling.refined,
                };
                sharing.pass(
                    (walk, film, &by_class.effort),
                    &tile,
                    &mut scratch,
                    &mut found,
                );
                for (k, from) in found.chunks(size).enumerate() {
                    let (r, c) = (row + k as u32 / cols, col + k as u32 % cols);
                    let at = (r * region.cols + c) as usize * size;
                    for (i, &x) in from.iter().enumerate().filter(|(_, x)| **x != 0.0) {
                        sum[at + i] += x;
                        square[at + i] += x * x;
                    }
                }
            }
        }
    }
    let n = f64::from(passes);
    let pixel = |k: usize| {
        let mut classes = [(0.0, 0.0); ALL];
        for (class, of) in classes.iter_mut().take(CLASSES).enumerate() {
            let first = k * size + (class + 1) * film.slots;
            let slots = first + 1..first + film.slots - 1;
            for (&x, &x2) in sum[slots.clone()].iter().zip(&square[slots]) {
                let (x, x2) = (f64::from(x), f64::from(x2));
                of.0 += x / n;
                of.1 += (x2 - x * x / n).max(0.0) / (n - 1.0) / n;
            }
        }
        classes
    };
    Found {
        region,
        light,
        classes: (0..pixels).map(pixel).collect(),
    }
}

fn shares(film: &Film, found: &[Found]) -> Vec<ClassVariance> {
    let bins = film.slots - 2;
    // Relative squared error by pixel: of all classes, and of each.
    let mut pixels: Vec<(f64, [f64; ALL])> = vec![];
    let mut energy = [0.0; ALL];
    for tile in found {
        for (h, classes) in tile.light.chunks(bins).zip(&tile.classes) {
            let norm2: f64 = h.iter().map(|&x| f64::from(x).powi(2)).sum();
            for (all, of) in energy.iter_mut().zip(classes) {
                *all += of.0;
            }
            if norm2 > 0.0 {
                let each = classes.map(|of| of.1 / norm2);
                pixels.push((each.iter().sum(), each));
            }
        }
    }
    pixels.sort_by(|a, b| a.0.total_cmp(&b.0));
    let of = |range: std::ops::Range<usize>| {
        let mut sums = [0.0; ALL];
        for (_, each) in &pixels[range] {
            for (sum, x) in sums.iter_mut().zip(each) {
                *sum += x;
            }
        }
        let all = sums.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        sums.map(|x| x / all)
    };
    let (all, middle) = (
        of(0..pixels.len()),
        of(pixels.len() / 4..pixels.len() * 3 / 4),
    );
    let light = energy.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let mut classes: Vec<ClassVariance> = (0..ALL)
        .filter(|&c| energy[c] > 0.0)
        .map(|c| ClassVariance {
            class: match c.checked_sub(CLASSES) {
                Some(technique) => TECHNIQUES[technique].into(),
                None => class_name(c),
            },
            energy: energy[c] / light,
            variance: all[c],
            middle: middle[c],
        })
        .collect();
    classes.sort_by(|a, b| b.variance.total_cmp(&a.variance));
    classes
}
