//! Example maps: the measurement, the truth, the prediction, and their difference.

use std::fmt::Write;

use super::{
    Entry, Picture, Plane, Report,
    colour::{GREY, INFERNO, OVERLAP, Rgb, UNKNOWN, VIRIDIS, colour, css, gradient},
    image::data_url,
    number::{metres, share, short},
    table::target_name,
    text::Safe,
};
use picofarm_model::{input::Target, metric::Metrics};

/// Returns the examples of all models that have some.
pub(super) fn maps(report: &Report) -> String {
    let with: Vec<&Entry> = report
        .models
        .iter()
        .filter(|m| !m.pictures.is_empty())
        .collect();
    if with.is_empty() {
        return "<p class=\"none\">There are no example pictures in this report.</p>".to_owned();
    }
    let of_depth = with
        .iter()
        .filter(|m| m.plan.question.target == Target::Tof);
    let depths = depths(of_depth.flat_map(|m| &m.pictures));
    with.into_iter().map(|m| of_model(m, &depths)).collect()
}

/// The ends of the colour scales of all depth pictures, metres. They are shared, so colours can be
/// compared between models.
struct Depths {
    low: f64,
    high: f64,
    error: f64,
}

fn of_model(entry: &Entry, depths: &Depths) -> String {
    let target = entry.plan.question.target;
    let mut out = format!(
        "<section class=\"maps\"><h3>{} <small>{}</small></h3><div class=\"rows\">",
        Safe(&entry.name),
        target_name(target)
    );
    for picture in &entry.pictures {
        let [truth, said, error] = match target {
            Target::Tof => {
                let range = |z: f64| (z - depths.low) / (depths.high - depths.low);
                [
                    painted(&picture.truth, |z| colour(&VIRIDIS, range(z))),
                    painted(&picture.said, |z| colour(&VIRIDIS, range(z))),
                    differing(picture, |z, t| {
                        colour(&INFERNO, (z - t).abs() / depths.error)
                    }),
                ]
            }
            Target::Shadow | Target::Specular => [
                painted(&picture.truth, |v| colour(&GREY, v)),
                painted(&picture.said, |v| colour(&GREY, v)),
                differing(picture, overlap),
            ],
        };
        let seen = painted(&picture.intensity, |v| colour(&GREY, v.max(0.0).sqrt()));
        let said_name = if target == Target::Tof {
            "predicted"
        } else {
            "predicted probability"
        };
        let _ = write!(
            out,
            "<figure><div class=\"quad\">{}{}{}{}</div><figcaption>{} — {}</figcaption></figure>",
            cell("measured", &seen),
            cell("true", &truth),
            cell(said_name, &said),
            cell("error", &error),
            Safe(&picture.label),
            figures(&picture.metrics)
        );
    }
    out.push_str("</div>");
    out.push_str(&match target {
        Target::Tof => {
            bar("depth (m)", &VIRIDIS, depths.low, depths.high)
                + &bar("error of depth (m)", &INFERNO, 0.0, depths.error)
        }
        Target::Shadow => key(["shadow", "lit"], "lit"),
        Target::Specular => key(["no mirror", "mirror"], "mirror"),
    });
    if unknown(&entry.pictures) {
        let _ = write!(
            out,
            "<p class=\"key\"><i style=\"background:{}\"></i> no number</p>",
            css(UNKNOWN)
        );
    }
    out.push_str("<p class=\"note\">Measured: the histogram’s sum over time, square root, least to greatest.</p></section>");
    out
}

fn depths<'a>(pictures: impl Iterator<Item = &'a Picture>) -> Depths {
    let finite = |plane: &Plane| -> Vec<f64> {
        let values = plane.values().iter().map(|v| f64::from(*v));
        values.filter(|v| v.is_finite()).collect()
    };
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    let mut errors = Vec::new();
    for picture in pictures {
        for z in finite(&picture.truth) {
            (low, high) = (low.min(z), high.max(z));
        }
        let pairs = picture.truth.values().iter().zip(picture.said.values());
        errors.extend(
            pairs
                .map(|(t, s)| f64::from(s - t).abs())
                .filter(|e| e.is_finite()),
        );
    }
    if low > high {
        (low, high) = (0.0, 1.0);
    }
    // A few pixels at edges must not darken all others.
    errors.sort_unstable_by(f64::total_cmp);
    let error = errors.get(errors.len().saturating_sub(1) * 99 / 100);
    Depths {
        low,
        high: high.max(low + 1e-3),
        error: error.map_or(1.0, |e| e.max(1e-3)),
    }
}

fn painted(plane: &Plane, paint: impl Fn(f64) -> Rgb) -> String {
    let pixels: Vec<Rgb> = plane
        .values()
        .iter()
        .map(|v| paint(f64::from(*v)))
        .collect();
    data_url(plane.width(), plane.height(), &pixels)
}

/// Returns a picture of prediction and truth, pixel by pixel; empty if their sizes differ.
fn differing(picture: &Picture, paint: impl Fn(f64, f64) -> Rgb) -> String {
    let (said, truth) = (&picture.said, &picture.truth);
    if (said.width(), said.height()) != (truth.width(), truth.height()) {
        return String::new();
    }
    let pairs = said.values().iter().zip(truth.values());
    let pixels: Vec<Rgb> = pairs
        .map(|(s, t)| paint(f64::from(*s), f64::from(*t)))
        .collect();
    data_url(truth.width(), truth.height(), &pixels)
}

fn overlap(said: f64, truth: f64) -> Rgb {
    if !(said.is_finite() && truth.is_finite()) {
        return UNKNOWN;
    }
    match (said > 0.5, truth > 0.5) {
        (false, false) => OVERLAP[0],
        (true, true) => OVERLAP[1],
        (true, false) => OVERLAP[2],
        (false, true) => OVERLAP[3],
    }
}

fn unknown(pictures: &[Picture]) -> bool {
    let planes = pictures
        .iter()
        .flat_map(|p| [&p.truth, &p.said, &p.intensity]);
    planes.flat_map(|p| p.values()).any(|v| !v.is_finite())
}

fn cell(name: &str, url: &str) -> String {
    if url.is_empty() {
        return format!("<div><span class=\"none\">sizes differ</span><span>{name}</span></div>");
    }
    format!("<div><img src=\"{url}\" alt=\"{name}\"><span>{name}</span></div>")
}

fn figures(metrics: &Metrics) -> String {
    match metrics {
        Metrics::Depth { mae_m, rmse_m } => {
            format!("MAE {} m, RMSE {} m", metres(*mae_m), metres(*rmse_m))
        }
        Metrics::Mask { mae, iou, f1 } => {
            format!(
                "IoU {}, MAE {}, F1 {}",
                share(*iou),
                share(*mae),
                share(*f1)
            )
        }
    }
}

/// Returns a colour map with its values.
fn bar(label: &str, map: &[Rgb], low: f64, high: f64) -> String {
    let places = [0.0, 0.25, 0.5, 0.75, 1.0];
    let step = (high - low).max(1e-12) / 4.0;
    let places = places.map(|at: f64| {
        let value = low + at * (high - low);
        let fine = libm::pow(10.0, 1.0 - libm::floor(libm::log10(step)));
        format!("<span>{}</span>", short((value * fine).round() / fine))
    });
    format!(
        "<div class=\"scale\"><div class=\"ramp\" style=\"background:{}\"></div><div class=\"values\">{}</div>\
         <div>{label}</div></div>",
        gradient(map),
        places.concat()
    )
}

/// Returns the legend of the colours of masks.
fn key([no, yes]: [&str; 2], what: &str) -> String {
    let texts = [
        format!("{no}, as said"),
        format!("{yes}, as said"),
        format!("said {what}, is not"),
        format!("is {what}, not said"),
    ];
    let each = OVERLAP.iter().zip(texts);
    let spans = each.map(|(c, text)| {
        format!(
            "<span><i style=\"background:{}\"></i> {text}</span>",
            css(*c)
        )
    });
    format!("<p class=\"key\">{}</p>", spans.collect::<String>())
}
