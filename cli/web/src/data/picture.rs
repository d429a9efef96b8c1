//! Pictures of a scene's images as PNG.

use picofarm_figures::{Canvas, inferno, rgb_png, scene::quantile, viridis};

use super::{Truth, truth::Damage};
use crate::{answer::Problem, query::Query};

/// Where nothing is.
const NOTHING: [u8; 3] = [24, 24, 28];
/// Side of an image on a card of the gallery, pixels.
const CARD: usize = 128;

/// An image of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    /// Colour.
    Rgb,
    /// z-depth.
    Depth,
    /// Normals: x, y and z as red, green and blue.
    Normal,
    /// Sum over time, its square root.
    Intensity,
    /// Objects.
    Instance,
    /// Labels.
    Label,
    /// Mirrors.
    Mirror,
    /// The pixels that a spot lights.
    Lit(usize),
}

/// The values at both ends of a colour bar, and its map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// The values.
    pub ends: [f32; 2],
    /// The unit.
    pub unit: &'static str,
    /// The name of the colour map.
    pub map: &'static str,
}

impl Picture {
    /// The pictures of a page, with their titles.
    pub const ALL: [(Self, &str); 7] = [
        (Self::Rgb, "Colour"),
        (Self::Intensity, "All light"),
        (Self::Depth, "Depth"),
        (Self::Normal, "Normals"),
        (Self::Label, "Labels"),
        (Self::Instance, "Objects"),
        (Self::Mirror, "Mirrors"),
    ];

    /// Returns the name in URLs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb",
            Self::Depth => "depth",
            Self::Normal => "normal",
            Self::Intensity => "intensity",
            Self::Instance => "instance",
            Self::Label => "label",
            Self::Mirror => "mirror",
            Self::Lit(_) => "lit",
        }
    }

    /// Reads the parameters `what` and `spot`.
    ///
    /// # Errors
    /// Names the unknown picture.
    pub fn of(query: &Query) -> Result<Self, Problem> {
        let name = query.text("what");
        if name == "lit" {
            return Ok(Self::Lit(query.required("spot")? as usize));
        }
        let found = Self::ALL
            .into_iter()
            .find(|(picture, _)| picture.name() == name);
        found.map(|(picture, _)| picture).ok_or_else(|| {
            let names = Self::ALL.map(|(picture, _)| picture.name()).join(", ");
            Problem::input(format!(
                "what: expected one of {names}, lit; found {name:?}"
            ))
        })
    }

    /// Draws the picture as PNG, one pixel for each, with the meaning of its colours.
    ///
    /// # Errors
    /// Fails if the scene has no such spot, and if an array that the picture shows is damaged.
    pub fn draw(self, truth: &Truth) -> Result<(Vec<u8>, Option<Span>), Problem> {
        let (colour, span) = self.colours(truth)?;
        let pixels: Vec<[u8; 3]> = (0..truth.spec.pixels()).map(colour).collect();
        let png = rgb_png(truth.spec.width, truth.spec.height, pixels.as_flattened());
        Ok((png, span))
    }

    /// Returns the meaning of the colours, where they have values.
    ///
    /// # Errors
    /// Fails as [`draw`](Self::draw) does.
    pub fn span(self, truth: &Truth) -> Result<Option<Span>, Problem> {
        Ok(self.colours(truth)?.1)
    }

    fn colours(self, truth: &Truth) -> Result<(Colours<'_>, Option<Span>), Problem> {
        let rgb = || -> Result<_, &Damage> {
            let rgb = truth.rgb.as_ref()?;
            Ok(|p: usize| [rgb[3 * p], rgb[3 * p + 1], rgb[3 * p + 2]])
        };
        Ok(match self {
            Self::Rgb => (Box::new(rgb()?), None),
            Self::Depth => {
                let depth = truth.depth.as_ref()?;
                let seen: Vec<f32> = depth.iter().copied().filter(|d| *d > 0.0).collect();
                let (near, far) = (quantile(&seen, 0.001), quantile(&seen, 1.0));
                let colour = move |p: usize| match depth[p] {
                    d if d > 0.0 => viridis(1.0 - (d - near) / (far - near).max(1e-6)),
                    _ => NOTHING,
                };
                let span = Span {
                    ends: [near, far],
                    unit: "m",
                    map: "viridis-down",
                };
                (Box::new(colour), Some(span))
            }
            Self::Normal => {
                let normal = truth.normal.as_ref()?;
                let colour = |p: usize| {
                    let n = &normal[3 * p..][..3];
                    match n.iter().all(|x| *x == 0.0) {
                        true => NOTHING,
                        // y and z point down and away; their colours grow the other way.
                        false => [n[0], -n[1], -n[2]].map(|x| (127.5 + 127.5 * x) as u8),
                    }
                };
                (Box::new(colour), None)
            }
            Self::Intensity => {
                let light = truth.intensity.as_ref()?;
                let white = quantile(light, 0.995).max(f32::MIN_POSITIVE);
                let colour = move |p: usize| inferno((light[p] / white).sqrt());
                let span = Span {
                    ends: [0.0, white],
                    unit: "1/(m² sr), square root",
                    map: "inferno",
                };
                (Box::new(colour), Some(span))
            }
            Self::Instance => {
                let instance = truth.instance.as_ref()?;
                (Box::new(|p| distinct(instance[p])), None)
            }
            Self::Label => {
                let label = truth.label.as_ref()?;
                (Box::new(|p| distinct(u32::from(label[p]))), None)
            }
            Self::Mirror => {
                let (mirrors, rgb) = (truth.specular.as_ref()?, rgb()?);
                let colour = move |p: usize| match mirrors[p] {
                    1 => [255; 3],
                    _ => rgb(p).map(|c| c / 3),
                };
                (Box::new(colour), None)
            }
            Self::Lit(spot) => {
                let count = truth.spec.spots as usize;
                if spot >= count {
                    let what = format!("spot: expected a number below {count}, found {spot}");
                    return Err(Problem::input(what));
                }
                let rgb = rgb()?;
                let mask = &truth.visibility.as_ref()?[spot * truth.spec.pixels()..];
                let colour = move |p: usize| match mask[p] {
                    1 => rgb(p).map(|c| 96 + c / 8 * 5),
                    _ => rgb(p).map(|c| c / 4),
                };
                (Box::new(colour), None)
            }
        })
    }
}

/// The colour of each pixel.
type Colours<'a> = Box<dyn Fn(usize) -> [u8; 3] + 'a>;

/// Colours of neighbouring numbers that differ clearly: hues by the golden angle.
fn distinct(number: u32) -> [u8; 3] {
    if number == 0 {
        return NOTHING;
    }
    let hue = (f64::from(number) * 0.618_033_988_75).fract() * 6.0;
    let value = [0.92, 0.72, 0.82][number as usize % 3];
    let part = |n: f64| {
        let k = (n + hue) % 6.0;
        let x = k.min(4.0 - k).clamp(0.0, 1.0);
        (255.0 * value * (1.0 - 0.55 * x)) as u8
    };
    [part(5.0), part(3.0), part(1.0)]
}

/// Draws a card of the gallery: colour, depth and light in a row, each in the middle of a square.
pub fn card(truth: &Truth) -> Vec<u8> {
    let (width, height) = (truth.spec.width as usize, truth.spec.height as usize);
    let side = width.max(height);
    let margin = ((side - width) / 2, (side - height) / 2);
    let mut canvas = Canvas::new(3 * CARD, CARD, NOTHING);
    for (i, picture) in [Picture::Rgb, Picture::Depth, Picture::Intensity]
        .into_iter()
        .enumerate()
    {
        if let Ok((colour, _)) = picture.colours(truth) {
            let padded = |p: usize| {
                let column = (p % side).checked_sub(margin.0).filter(|c| *c < width);
                let row = (p / side).checked_sub(margin.1).filter(|r| *r < height);
                let inside = row.zip(column);
                inside.map_or(NOTHING, |(row, column)| colour(row * width + column))
            };
            canvas.image((i * CARD, 0), CARD, (side, side), padded);
        }
    }
    canvas.png()
}
