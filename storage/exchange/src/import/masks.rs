//! Checks that the visibility masks fit the histograms: two-bounce light of a spot arrives at
//! pixels marked as lit, and not at those in shadow. With a wrong polarity, order of spots, or
//! order of rows and columns, both are mixed.

use super::ImportError;
use super::mask_order::Masks;
use super::profile::{
    BETTER, Blame, CONTRAST, Geometry, MIN_PAIRS, Profile, Reading, Which, profile,
};

/// Share of the lit pixels' light by which another order must separate lit from shadow to be
/// believed.
const CLEAR: f64 = 0.25;

/// Checks the polarity: masks with the wrong one mark pixels as lit where no light arrives.
pub(super) fn polarity(
    g: &Geometry<'_>,
    blame: &Blame<'_>,
    lit: &Profile,
) -> Result<(), ImportError> {
    if g.visibility.is_none() {
        return Ok(());
    }
    let dark = profile(g, Reading::default(), Which::Dark);
    let clear = dark.hit() > dark.background() * CONTRAST;
    if dark.pairs < MIN_PAIRS || !clear || dark.excess() <= lit.excess().max(0.0) * BETTER {
        return Ok(());
    }
    Err(ImportError::refused(
        blame.visibility,
        "polarity of the visibility masks",
        "more two-bounce light where a mask says lit",
        format!(
            "{:.5} of a pixel's energy there, {:.5} where it says shadow",
            lit.excess().max(0.0),
            dark.excess()
        ),
        format!(
            "the masks may be the other way round: {}; or import as they are with --unchecked",
            blame.polarity
        ),
    ))
}

/// Checks whether another order of the masks separates lit from shadow better. Returns the
/// separation in the file's order: the excess light at lit pixels, minus that at pixels in shadow;
/// `None` if there are no masks or no shadows.
///
/// # Errors
/// [`ImportError::Refused`] with the order that fits better.
pub(super) fn order(
    g: &Geometry<'_>,
    blame: &Blame<'_>,
    lit: &Profile,
) -> Result<Option<f64>, ImportError> {
    let separation = |masks| {
        let reading = Reading {
            masks,
            ..Reading::default()
        };
        let (lit, dark) = (
            profile(g, reading, Which::Lit),
            profile(g, reading, Which::Dark),
        );
        let enough = lit.pairs >= MIN_PAIRS && dark.pairs >= MIN_PAIRS;
        enough.then(|| lit.excess() - dark.excess().max(0.0))
    };
    if g.visibility.is_none() {
        return Ok(None);
    }
    let Some(own) = separation(Masks::AsTheyStand) else {
        return Ok(None);
    };
    let (h, w) = (g.shape.height as usize, g.shape.width as usize);
    let mut best: Option<(f64, &str)> = None;
    for (masks, words) in Masks::others(g.spots.len(), h, w) {
        let Some(other) = separation(masks) else {
            continue;
        };
        let better = other > own.max(0.0) * BETTER && other > lit.excess().max(0.0) * CLEAR;
        if better && best.is_none_or(|(most, _)| other > most) {
            best = Some((other, words));
        }
    }
    match best {
        None => Ok(Some(own)),
        Some((other, words)) => Err(ImportError::refused(
            blame.visibility,
            "order of the visibility masks",
            "more two-bounce light at the pixels that each spot's mask calls lit than at those in shadow, spots, rows and \
             columns in the histogram's order",
            format!(
                "a difference of {own:.5} of a pixel's energy so, and of {other:.5} with {words}"
            ),
            "put the masks in order, or import them as they are with --unchecked",
        )),
    }
}
