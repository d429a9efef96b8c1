//! A pixel's histogram, with the times at which light of one and two bounces must arrive.

use picofarm_dataset::Spot;
use serde_json::{Value, json};

use super::{Light, Truth, truth::METRES_PER_NS, volume::Volume};
use crate::answer::Problem;

/// Returns h of each bin, h of two bounces and of three and more where the render has these
/// `parts`, the time of the pixel's own spot, and for each spot the time of its
/// two-bounce light: laser to spot, spot to the pixel's surface point, and from there to the camera
/// (the two-bounce time of flight of PlatoNeRF, Klinghoffer et al., CVPR 2024). With the light of
/// one spot, the times are those of this spot. `whole` is true for all light: shares of
/// bounces have no meaning for a part of it.
///
/// # Errors
/// Fails outside of the image, and if an array that the times follow from is damaged.
pub fn of_pixel(
    truth: &Truth,
    (light, volume): (Light, &Volume),
    parts: Option<[&Volume; 2]>,
    at: [u64; 2],
) -> Result<Value, Problem> {
    let pixel = truth.pixel(at)?;
    let lit = truth.lit_by(pixel)?;
    let point = truth.point(pixel)?;
    let spots = truth.spots.as_ref()?;
    let chosen = |spot: usize| light.has(spot);
    let two: Vec<Value> = spots
        .iter()
        .enumerate()
        .filter(|(i, _)| chosen(*i))
        .filter_map(|(i, spot)| {
            let (spot, point) = (spot.as_ref()?, point?);
            let path = two_bounce(spot, point);
            Some(json!({
                "spot": i, "path_m": path, "ns": path / METRES_PER_NS, "lit": lit.contains(&i),
            }))
        })
        .collect();
    let [row, column] = at.map(|x| x as f32);
    let own = spots.iter().enumerate().find_map(|(i, spot)| {
        let spot = spot.as_ref()?;
        let [x, y] = truth.film(spot).ok()??;
        let inside = (column..column + 1.0).contains(&x) && (row..row + 1.0).contains(&y);
        let path = f64::from(spot.path_m) + length(spot.position.map(f64::from));
        (inside && chosen(i))
            .then(|| json!({"spot": i, "path_m": path, "ns": path / METRES_PER_NS}))
    });
    Ok(json!({
        "h": volume.histogram(pixel), "parts": parts.map(|parts| parts.map(|p| p.histogram(pixel))),
        "whole": light == Light::All, "one": own, "two": two, "values": truth.values(at)?,
    }))
}

/// Returns the length in metres of the path from the laser by a spot and a surface point to the
/// camera.
pub fn two_bounce(spot: &Spot, point: [f64; 3]) -> f64 {
    f64::from(spot.path_m) + distance(spot.position.map(f64::from), point) + length(point)
}

/// Returns the length of a vector.
pub fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    length([a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}
