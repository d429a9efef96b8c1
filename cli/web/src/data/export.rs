//! Light in flight as files: an animated GIF, and a figure for papers as SVG.

use picofarm_figures::{
    animation, inferno,
    paper::{self, Bar, Curve, Image, Mark, Panel, Style},
    viridis,
};

use super::{Light, Truth, histogram::two_bounce, truth::METRES_PER_NS, volume::Volume};
use crate::{answer::Problem, query::Query};

/// Most frames of an animation. Of more bins, each frame is the mean of several.
const FRAMES: usize = 160;
/// Duration of a frame in hundredths of a second.
const DELAY: u16 = 5;
/// The least side of an animation, pixels.
const SIDE: usize = 256;
/// Width of a figure, millimetres: two columns of most journals.
const WIDTH: f64 = 180.0;
/// Share of a pixel's light before the end of its histogram's panel.
const ARRIVED: f64 = 0.99;
/// The longest shutter of the player, bins.
const SHUTTER: usize = 32;
/// Steps of the logarithmic scale below white: four decades.
const FLOOR: f32 = 1e-4;

/// How light is shown, as in the player.
#[derive(Debug, Clone, Copy)]
pub struct Look {
    bin: usize,
    shutter: usize,
    /// Factor of the exposure.
    gain: f32,
    scale: Scale,
    map: fn(f32) -> [u8; 3],
}

/// The scale of brightness.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scale {
    Linear,
    Root,
    Logarithmic,
}

impl Look {
    /// Reads the parameters `bin`, `shutter`, `exposure`, `scale` and `map`, as the player's
    /// address has them.
    ///
    /// # Errors
    /// Names the wrong parameter.
    pub fn of(query: &Query) -> Result<Self, Problem> {
        let number = |name: &str, default: f64| match query.text(name) {
            "" => Ok(default),
            text => match text.parse::<f64>() {
                Ok(number) if number.is_finite() => Ok(number),
                _ => Err(format!("{name}: expected a number, found {text:?}")),
            },
        };
        let shutter = number("shutter", 2.0)?;
        if !(1.0..=SHUTTER as f64).contains(&shutter) {
            let what = format!("shutter: expected 1 to {SHUTTER} bins, found {shutter}");
            return Err(what.into());
        }
        let scale = match query.text("scale") {
            "linear" => Scale::Linear,
            "" | "root" => Scale::Root,
            "log" => Scale::Logarithmic,
            text => {
                let what = format!("scale: expected linear, root or log, found {text:?}");
                return Err(what.into());
            }
        };
        let map: fn(f32) -> [u8; 3] = match query.text("map") {
            "" | "0" => inferno,
            "1" => viridis,
            "2" => grey,
            text => return Err(format!("map: expected 0, 1 or 2, found {text:?}").into()),
        };
        Ok(Self {
            bin: number("bin", 0.0)?.max(0.0) as usize,
            shutter: shutter as usize,
            gain: number("exposure", 0.0)?.clamp(-20.0, 20.0).exp2() as f32,
            scale,
            map,
        })
    }

    /// Returns the place on the scale of a mean of bins, from 0 to 1.
    fn bright(&self, mean: f32, white: f32) -> f32 {
        let v = mean * self.gain / white;
        let t = match self.scale {
            Scale::Linear => v,
            Scale::Root => v.sqrt(),
            Scale::Logarithmic => (v.max(FLOOR) / FLOOR).ln() / (1.0 / FLOOR).ln(),
        };
        t.clamp(0.0, 1.0)
    }
}

fn grey(t: f32) -> [u8; 3] {
    [(255.0 * t.clamp(0.0, 1.0)).round() as u8; 3]
}

/// Encodes the bins from the first light to most of it as an animated GIF, without the room.
pub fn gif(volume: &Volume, look: &Look) -> Vec<u8> {
    let spec = volume.spec();
    let (width, height) = (spec.width as usize, spec.height as usize);
    let times = SIDE.div_ceil(width.max(height).max(1));
    let lively = volume.lively();
    let step = lively.len().div_ceil(FRAMES).max(1);
    let palette: Vec<u8> = (0..=255u8)
        .flat_map(|i| (look.map)(f32::from(i) / 255.0))
        .collect();
    let frame = |from: usize| -> Vec<u8> {
        let bins = from..(from + look.shutter.max(step)).min(spec.gate.bins as usize);
        let count = bins.len() as f32;
        let index = |sum: f32| (255.0 * look.bright(sum / count, volume.white())).round() as u8;
        let indices: Vec<u8> = volume.light_in(bins).into_iter().map(index).collect();
        let rows = indices.chunks_exact(width.max(1));
        rows.flat_map(|row| {
            let wide: Vec<u8> = row.iter().flat_map(|i| vec![*i; times]).collect();
            wide.repeat(times)
        })
        .collect()
    };
    let mut frames = lively.step_by(step).map(frame);
    animation(
        (width * times, height * times),
        &palette,
        DELAY,
        &mut frames,
    )
}

/// Draws the light at the time of the look, all light, and a pixel's histogram, as SVG.
///
/// # Errors
/// Fails outside of the image, and if an array that the figure shows is damaged.
pub fn figure(
    truth: &Truth,
    (light, volume): (Light, &Volume),
    look: &Look,
    pixel: Option<[u64; 2]>,
) -> Result<String, Problem> {
    let bins = volume.spec().gate.bins as usize;
    let first = look.bin.min(bins.saturating_sub(1));
    let shown = first..(first + look.shutter).min(bins);
    let [from, to] = [shown.start, shown.end].map(|bin| nanoseconds(volume, bin as f64));
    let count = shown.len() as f32;
    let white = volume.white() / look.gain;
    let mean: Vec<f32> = volume
        .light_in(shown)
        .into_iter()
        .map(|h| h / count)
        .collect();
    let all = match light {
        Light::All => truth.intensity.as_ref()?.clone(),
        _ => volume.light_in(0..bins),
    };
    let most = picofarm_figures::scene::quantile(&all, 0.995).max(f32::MIN_POSITIVE);
    let marks: Vec<[f64; 2]> = pixel
        .iter()
        .map(|[row, column]| [*column as f64 + 0.5, *row as f64 + 0.5])
        .collect();
    let image = |title: String, values: &[f32], high: f32, name| {
        let exponent = if look.scale == Scale::Linear {
            1.0
        } else {
            0.5
        };
        let colour = |v: &f32| (look.map)((v / high).clamp(0.0, 1.0).powf(exponent));
        Panel::Image(Image {
            title,
            width: truth.spec.width as usize,
            height: truth.spec.height as usize,
            rgb: values.iter().flat_map(colour).collect(),
            bar: Some(Bar {
                low: 0.0,
                high: high.into(),
                clipped: values.iter().any(|v| *v > high),
                exponent: exponent.into(),
                name,
                unit: "1/(m² sr)",
                map: look.map,
            }),
            keys: vec![],
            marks: marks.clone(),
        })
    };
    let mut panels = vec![
        image(
            format!("{from:.2} to {to:.2} ns"),
            &mean,
            white,
            "light in a bin",
        ),
        image(light.title(), &all, most, "light"),
    ];
    if let Some([row, column]) = pixel {
        panels.push(curve(truth, (light, volume), [row, column])?);
    }
    let columns = panels.len();
    let drawn = paper::draw(&panels, WIDTH, columns);
    let narrow = |least| Problem::input(format!("the figure needs {least} mm, more than {WIDTH}"));
    Ok(drawn.map_err(narrow)?.svg)
}

fn nanoseconds(volume: &Volume, bin: f64) -> f64 {
    let gate = &volume.spec().gate;
    (gate.start_m + bin * gate.bin_width_m) / METRES_PER_NS
}

/// The histogram of a pixel from its first light to nearly all, with the times of two bounces.
fn curve(truth: &Truth, (light, volume): (Light, &Volume), at: [u64; 2]) -> Result<Panel, Problem> {
    let pixel = truth.pixel(at)?;
    let h = volume.histogram(pixel);
    let first = h.iter().position(|h| *h > 0.0).unwrap_or(0);
    let all: f64 = h.iter().map(|h| f64::from(*h)).sum();
    let mut sum = 0.0;
    let arrived = h.iter().position(|h| {
        sum += f64::from(*h);
        sum > ARRIVED * all
    });
    let last = arrived.unwrap_or(h.len().saturating_sub(1));
    let shown = first.saturating_sub(4)..(last + 5).min(h.len());
    let (lit, point) = (truth.lit_by(pixel)?, truth.point(pixel)?);
    let spots = truth.spots.as_ref()?.iter().enumerate();
    let mut marks: Vec<Mark> = spots
        .filter(|(index, _)| light.has(*index))
        .filter_map(|(index, spot)| {
            let at = two_bounce(spot.as_ref()?, point?) / METRES_PER_NS;
            let style = usize::from(lit.contains(&index));
            Some(Mark { at, style })
        })
        .collect();
    // Lit spots are drawn over the others.
    marks.sort_by_key(|mark| mark.style);
    let style = |colour, text: &str| Style {
        colour,
        text: text.into(),
    };
    Ok(Panel::Curve(Curve {
        title: format!("pixel ({}, {})", at[1], at[0]),
        range: [shown.start, shown.end].map(|bin| nanoseconds(volume, bin as f64)),
        horizontal: ("time", "ns"),
        vertical: ("light in a bin", "1/(m² sr)"),
        values: h[shown].iter().map(|h| f64::from(*h)).collect(),
        marks,
        styles: vec![
            style([170; 3], "in shadow"),
            style([214, 96, 30], "lit spots"),
        ],
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_look_is_read_from_the_players_address_and_wrong_parts_are_named() {
        let look = |text: &str| Look::of(&Query::parse(text));
        let found = look("bin=12.5&shutter=4&exposure=1&scale=log&map=2").unwrap();
        assert_eq!((found.bin, found.shutter, found.gain), (12, 4, 2.0));
        assert_eq!(found.bright(1.0, 2.0), 1.0);
        assert_eq!(found.bright(0.0, 2.0), 0.0);
        assert_eq!(found.bright(0.01, 2.0), 0.5);
        for (text, name) in [
            ("shutter=0", "shutter:"),
            ("shutter=33", "shutter:"),
            ("scale=sqrt", "scale:"),
            ("map=9", "map:"),
            ("bin=x", "bin:"),
            ("exposure=inf", "exposure:"),
        ] {
            let problem = look(text).unwrap_err();
            assert!(problem.message.starts_with(name), "{}", problem.message);
        }
    }
}
