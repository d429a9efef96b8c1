//! The kinds of light of a scene that have histograms of their own.

use std::path::Path;

use picofarm_dataset::{DatasetSpec, Quantity as Q, RenderGroup, SingleRender};

use crate::{answer::Problem, query::Query};

/// Which light of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Light {
    /// Of all spots.
    All,
    /// Of 4 of 100 spots.
    Four,
    /// Of 25 of 100 spots.
    TwentyFive,
    /// Of one spot.
    Spot(u32),
    /// Of two bounces, of a render with its parts.
    Two,
    /// Of three bounces and more, likewise.
    More,
}

impl Light {
    /// Reads the parameter `light`.
    ///
    /// # Errors
    /// Names the unknown light.
    pub fn of(query: &Query) -> Result<Self, Problem> {
        match query.text("light") {
            "" | "all" => Ok(Self::All),
            "4" => Ok(Self::Four),
            "25" => Ok(Self::TwentyFive),
            "two" => Ok(Self::Two),
            "more" => Ok(Self::More),
            text => {
                let spot = text.strip_prefix("spot-").and_then(|n| n.parse().ok());
                spot.map(Self::Spot).ok_or_else(|| {
                    Problem::input(format!(
                        "light: expected all, 4, 25, two, more or spot-N, found {text:?}"
                    ))
                })
            }
        }
    }

    /// Returns whether light of the spot is in it, as far as it is the light of one spot.
    pub fn has(self, spot: usize) -> bool {
        match self {
            Self::Spot(chosen) => chosen as usize == spot,
            _ => true,
        }
    }

    /// Returns the name in a sentence.
    pub fn title(self) -> String {
        match self {
            Self::All => "all light".into(),
            Self::Four => "4 of 100 spots".into(),
            Self::TwentyFive => "25 of 100 spots".into(),
            Self::Spot(spot) => format!("spot {spot}, all times"),
            Self::Two => "two bounces, all times".into(),
            Self::More => "three bounces and more, all times".into(),
        }
    }

    /// Returns the name in URLs.
    pub fn name(self) -> String {
        match self {
            Self::All => "all".into(),
            Self::Four => "4".into(),
            Self::TwentyFive => "25".into(),
            Self::Spot(spot) => format!("spot-{spot}"),
            Self::Two => "two".into(),
            Self::More => "more".into(),
        }
    }
}

/// Returns the kinds of light that a data set has, with titles. `folder` is its folder on this
/// machine.
pub fn lights(spec: &DatasetSpec, folder: Option<&Path>) -> Vec<(Light, String)> {
    let mut all = vec![(Light::All, format!("all {} spots", spec.spots))];
    let has = |quantity| spec.quantities().contains(&quantity);
    if has(Q::Transient25) {
        all.push((Light::TwentyFive, "25 of 100 spots".into()));
    }
    if has(Q::Transient4) {
        all.push((Light::Four, "4 of 100 spots".into()));
    }
    if folder.is_some_and(has_parts) {
        all.push((Light::Two, "two bounces".into()));
        all.push((Light::More, "three bounces and more".into()));
    }
    if has(Q::TransientSpots) {
        let spots = (0..spec.spots).map(|s| (Light::Spot(s), format!("spot {s}")));
        all.extend(spots);
    }
    all
}

/// Returns whether a folder has a render with the light of two bounces and of more apart.
pub fn has_parts(folder: &Path) -> bool {
    parts(folder).is_some_and(|group| group.has("two") && group.has("multi"))
}

/// The group with the parts of a single render.
pub fn parts(folder: &Path) -> Option<RenderGroup> {
    let is = SingleRender::is_in(folder);
    is.then(|| RenderGroup::open(&folder.join("render")).ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_light_are_parsed_again() {
        let all = [
            Light::All,
            Light::Four,
            Light::TwentyFive,
            Light::Two,
            Light::More,
            Light::Spot(7),
        ];
        for light in all {
            let query = Query::parse(&format!("light={}", light.name()));
            assert_eq!(Light::of(&query).unwrap(), light);
        }
        assert!(Light::of(&Query::parse("light=spot-x")).is_err());
    }
}
