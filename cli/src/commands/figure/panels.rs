//! The panels of a figure.

use picofarm_figures::{
    paper::{Bar, Curve, Image, Key, Mark, Panel, Style},
    scene::quantile,
};

use super::{map, source::Source};
use crate::{
    args::{Figure, PanelArg},
    error::{CliError, Result},
};

/// Metres that light travels in a nanosecond.
const METRES_PER_NS: f64 = 0.299_792_458;
/// The colour of pixels without a value.
const NOTHING: [u8; 3] = [225, 225, 225];
/// Colours of labels and masks: Paul Tol's bright and muted schemes, which people with colour
/// blindness distinguish (SRON technical note EPS/TN/09-002).
const CATEGORIES: [[u8; 3]; 14] = [
    [68, 119, 170],
    [238, 102, 119],
    [34, 136, 51],
    [204, 187, 68],
    [102, 204, 238],
    [170, 51, 119],
    [51, 34, 136],
    [153, 153, 51],
    [136, 34, 85],
    [17, 119, 51],
    [221, 204, 119],
    [204, 102, 119],
    [68, 170, 153],
    [136, 204, 238],
];
/// Share of the pixels that a scale of light covers; the spots are brighter.
const COVERED: f64 = 0.99;
/// Exponent of scales of light, whose range is large.
const EXPONENT: f64 = 0.5;
/// Shares of the light that have arrived at the times without `--times`.
const SHARES: [f64; 3] = [0.1, 0.4, 0.75];
/// Share of a pixel's light before the end of its histogram's panel.
const ARRIVED: f64 = 0.99;
/// Unit of the histograms.
const RADIANCE: &str = "1/(m² sr)";

/// Returns the panels of one kind: one for each time of light in flight, otherwise one.
///
/// # Errors
/// Names the option that the scene does not fit.
pub(super) fn panels(kind: PanelArg, args: &Figure, source: &Source) -> Result<Vec<Panel>> {
    let view = &source.view;
    let picture = |title: &str| Image {
        title: title.to_owned(),
        width: view.width,
        height: view.height,
        rgb: vec![],
        bar: None,
        keys: vec![],
        marks: vec![],
    };
    let image = match kind {
        PanelArg::Image => Image {
            rgb: view.rgb.clone(),
            marks: spots(source),
            keys: vec![Key {
                colour: [255, 51, 51],
                text: "laser spot".into(),
            }],
            ..picture("camera image")
        },
        PanelArg::Depth => scale(picture("depth"), &view.depth, args, "z-depth", "m"),
        PanelArg::Range => scale(picture("range"), &source.range, args, "range", "m"),
        PanelArg::Normals => normals(picture("normals"), source),
        PanelArg::Labels => labels(picture("labels"), source),
        PanelArg::Masks => masks(picture("lit by spots"), args, source),
        PanelArg::Mask(spot) => {
            let count = source.spots.len();
            if spot >= count {
                return Err(CliError::input(format!(
                    "--panels mask:{spot}: the scene has {count} spots, counted from 0"
                )));
            }
            let lit = &view.visibility[spot * view.pixels()..][..view.pixels()];
            binary(picture(&format!("spot {spot}")), lit, ["in shadow", "lit"])
        }
        PanelArg::Mirrors => binary(picture("mirrors"), &view.specular, ["other", "mirror"]),
        PanelArg::Error => {
            let errors = source.error.as_deref().unwrap_or_default();
            let percent: Vec<f32> = errors
                .iter()
                .map(|e| if e.is_finite() { 100.0 * e } else { 0.0 })
                .collect();
            scale(picture("error"), &percent, args, "relative error", "%")
        }
        PanelArg::Light => {
            let light = view.slice(0, view.bins);
            bright(picture("light"), &light, args, "all bins")
        }
        PanelArg::Transient => return in_flight(&picture, args, source),
        PanelArg::Histogram => return Ok(vec![histogram(args, source)?]),
    };
    Ok(vec![Panel::Image(image)])
}

/// Returns the positions of the spots in the image, in pixels.
fn spots(source: &Source) -> Vec<[f64; 2]> {
    let view = &source.view;
    let inside = |[x, y]: &[f64; 2]| {
        (0.0..view.width as f64).contains(x) && (0.0..view.height as f64).contains(y)
    };
    let spots = view.spots.iter().flatten();
    spots
        .map(|[x, y]| [f64::from(*x), f64::from(*y)])
        .filter(inside)
        .collect()
}

/// Colours positive values by a linear scale over all of them.
fn scale(
    image: Image,
    values: &[f32],
    args: &Figure,
    name: &'static str,
    unit: &'static str,
) -> Image {
    let known = values.iter().copied().filter(|v| *v > 0.0);
    let (low, high) = known.fold((f32::INFINITY, 0.0f32), |(l, h), v| (l.min(v), h.max(v)));
    let low = if low.is_finite() { low } else { 0.0 };
    let bar = Bar {
        low: low.into(),
        high: high.into(),
        clipped: false,
        exponent: 1.0,
        name,
        unit,
        map: map(args.colours),
    };
    coloured(image, values, |v| v > 0.0, bar)
}

/// Colours light by a scale that the brightest pixels exceed.
fn bright(image: Image, light: &[f32], args: &Figure, name: &'static str) -> Image {
    let lit: Vec<f32> = light.iter().copied().filter(|v| *v > 0.0).collect();
    let high = quantile(&lit, COVERED);
    let bar = Bar {
        low: 0.0,
        high: high.into(),
        clipped: lit.iter().any(|v| *v > high),
        exponent: EXPONENT,
        name,
        unit: RADIANCE,
        map: map(args.colours),
    };
    coloured(image, light, |_| true, bar)
}

fn coloured(image: Image, values: &[f32], known: impl Fn(f32) -> bool, bar: Bar) -> Image {
    let span = bar.high - bar.low;
    let colour = |v: &f32| match known(*v) {
        true if span > 0.0 => {
            let share = ((f64::from(*v) - bar.low) / span).clamp(0.0, 1.0);
            (bar.map)(share.powf(bar.exponent) as f32)
        }
        true => (bar.map)(0.0),
        false => NOTHING,
    };
    Image {
        rgb: values.iter().flat_map(colour).collect(),
        bar: Some(bar),
        ..image
    }
}

fn normals(image: Image, source: &Source) -> Image {
    let code = |n: f32| ((0.5 * n + 0.5) * 255.0).round() as u8;
    let pixel = |n: &[i16]| match n.iter().all(|x| *x == 0) {
        true => NOTHING,
        false => [0, 1, 2].map(|k| code(f32::from(n[k]) / 32767.0)),
    };
    let key = |axis: usize, text: &str| {
        let mut colour = [code(0.0); 3];
        colour[axis] = 255;
        Key {
            colour,
            text: text.into(),
        }
    };
    Image {
        rgb: source.normal.chunks_exact(3).flat_map(pixel).collect(),
        keys: vec![key(0, "x, right"), key(1, "y, down"), key(2, "z, forward")],
        ..image
    }
}

/// Colours each label; the key lists the most frequent first.
fn labels(image: Image, source: &Source) -> Image {
    let mut counts = std::collections::BTreeMap::<u16, usize>::new();
    for label in source.label.iter().filter(|l| **l > 0) {
        *counts.entry(*label).or_default() += 1;
    }
    let mut order: Vec<(u16, usize)> = counts.into_iter().collect();
    order.sort_by_key(|(label, count)| (std::cmp::Reverse(*count), *label));
    let colour = |label: u16| {
        let at = order.iter().position(|(l, _)| *l == label);
        at.map_or(NOTHING, |at| CATEGORIES[at % CATEGORIES.len()])
    };
    let key = |label: u16| Key {
        colour: colour(label),
        text: match source.names.get(usize::from(label) - 1) {
            Some(name) => name.clone(),
            None => format!("label {}", label - 1),
        },
    };
    Image {
        rgb: source.label.iter().flat_map(|l| colour(*l)).collect(),
        keys: order.iter().map(|(label, _)| key(*label)).collect(),
        ..image
    }
}

/// Colours the number of spots that light each pixel.
fn masks(image: Image, args: &Figure, source: &Source) -> Image {
    let pixels = source.view.pixels();
    let mut lit = vec![0.0f32; pixels];
    for mask in source.view.visibility.chunks_exact(pixels.max(1)) {
        for (count, m) in lit.iter_mut().zip(mask) {
            *count += f32::from(*m);
        }
    }
    let limit = |pick: fn(f32, f32) -> f32| lit.iter().copied().reduce(pick).unwrap_or(0.0);
    let bar = Bar {
        low: limit(f32::min).into(),
        high: limit(f32::max).into(),
        clipped: false,
        exponent: 1.0,
        name: "spots that light it",
        unit: "",
        map: map(args.colours),
    };
    coloured(image, &lit, |_| true, bar)
}

fn binary(image: Image, values: &[u8], names: [&str; 2]) -> Image {
    let colours = [[68, 68, 68], [253, 231, 37]];
    let keys = names.into_iter().zip(colours).map(|(text, colour)| Key {
        colour,
        text: text.into(),
    });
    Image {
        rgb: values
            .iter()
            .flat_map(|v| colours[usize::from(*v != 0)])
            .collect(),
        keys: keys.collect(),
        ..image
    }
}

/// Returns a panel for each time.
fn in_flight(
    picture: &dyn Fn(&str) -> Image,
    args: &Figure,
    source: &Source,
) -> Result<Vec<Panel>> {
    let view = &source.view;
    let bins = match args.times.is_empty() {
        true => arrivals(&view.energy_by_bin()).to_vec(),
        false => args
            .times
            .iter()
            .map(|ns| bin_of(*ns, source))
            .collect::<Result<_>>()?,
    };
    let panel = |bin: usize| {
        let middle = 0.5 * (view.nanoseconds(bin) + view.nanoseconds(bin + 1));
        let light = view.slice(bin, bin + 1);
        let title = format!("light at {middle:.2} ns");
        Panel::Image(bright(picture(&title), &light, args, "one bin"))
    };
    Ok(bins.into_iter().map(panel).collect())
}

/// Returns the bins in which shares of the light have arrived.
fn arrivals(energy: &[f64]) -> [usize; 3] {
    let total: f64 = energy.iter().sum();
    SHARES.map(|share| {
        let mut sum = 0.0;
        let reached = |e: &f64| {
            sum += e;
            sum >= share * total
        };
        energy.iter().position(reached).unwrap_or(0)
    })
}

fn bin_of(ns: f64, source: &Source) -> Result<usize> {
    let view = &source.view;
    let bin = (ns * METRES_PER_NS - view.gate_start_m) / view.bin_width_m;
    match bin >= 0.0 && bin < view.bins as f64 {
        true => Ok(bin as usize),
        false => Err(CliError::input(format!(
            "--times {ns}ns: the histograms are from {:.2} to {:.2} ns",
            view.nanoseconds(0),
            view.nanoseconds(view.bins)
        ))),
    }
}

/// Returns a pixel's histogram with the times of its one- and two-bounce light.
fn histogram(args: &Figure, source: &Source) -> Result<Panel> {
    let view = &source.view;
    let [column, row] = args.pixel.unwrap_or([view.width / 2, view.height / 2]);
    if column >= view.width || row >= view.height {
        return Err(CliError::input(format!(
            "--pixel {column},{row}: the image has {}x{} pixels, counted from 0",
            view.width, view.height
        )));
    }
    let pixel = row * view.width + column;
    let all = &view.transient[pixel * view.bins..][..view.bins];
    let style = |colour, text: &str| Style {
        colour,
        text: text.into(),
    };
    let mut curve = Curve {
        title: format!("pixel ({column}, {row})"),
        range: [view.nanoseconds(0), view.nanoseconds(view.bins)],
        horizontal: ("time", "ns"),
        vertical: ("light in a bin", RADIANCE),
        values: vec![],
        marks: two_bounces(source, [column, row]),
        styles: vec![
            style([170; 3], "in shadow"),
            style([214, 96, 30], "lit spots"),
        ],
    };
    // Lit spots are drawn over the others.
    curve.marks.sort_by_key(|m| m.style);
    // From the first light or mark until nearly all has arrived, with a margin.
    let total: f64 = all.iter().map(|v| f64::from(*v)).sum();
    let mut arrived = 0.0;
    let before_end = |b: &usize| {
        let early = arrived < ARRIVED * total;
        arrived += f64::from(all[*b]);
        early && all[*b] > 0.0
    };
    let light = (0..view.bins).filter(before_end);
    let start = view.nanoseconds(0);
    let width = view.nanoseconds(1) - start;
    let marks = curve.marks.iter().map(|m| ((m.at - start) / width).floor());
    let marks = marks.filter(|b| *b >= 0.0 && *b < view.bins as f64);
    let shown = light.chain(marks.map(|b| b as usize));
    let (first, last) = shown.fold((view.bins, 0), |(f, l), b| (f.min(b), l.max(b + 1)));
    if first < last {
        let margin = (last - first).div_ceil(30);
        let (lo, hi) = (first.saturating_sub(margin), (last + margin).min(view.bins));
        curve.range = [view.nanoseconds(lo), view.nanoseconds(hi)];
        curve.values = all[lo..hi].iter().map(|v| f64::from(*v)).collect();
    } else {
        curve.values = all.iter().map(|v| f64::from(*v)).collect();
        curve.title += ", no light";
    }
    Ok(Panel::Curve(curve))
}

/// Returns the times of light from the laser via each spot to the surface and to the camera: style
/// 1 for spots that light the surface, 0 for those in whose shadow it is.
fn two_bounces(source: &Source, at: [usize; 2]) -> Vec<Mark> {
    let view = &source.view;
    let Some(point) = source.point(at) else {
        return vec![];
    };
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let pixel = at[1] * view.width + at[0];
    let spots = source.spots.iter().enumerate();
    spots
        .filter_map(|(k, spot)| {
            let spot = spot.as_ref()?;
            let p = spot.position.map(f64::from);
            let apart = length([0, 1, 2].map(|k| p[k] - point[k]));
            let path = f64::from(spot.path_m) + apart + length(point);
            Some(Mark {
                at: path / METRES_PER_NS,
                style: usize::from(view.visibility[k * view.pixels() + pixel]),
            })
        })
        .collect()
}
