//! What the physics knows of each pair of pixel and spot, as images: the input of a network that
//! judges shadows with more context than the forests have.

use picofarm_settings::EvidenceForm;
use rayon::prelude::*;

use crate::{
    VERSION,
    demultiplex::Judgement,
    geometry::Source,
    learned::{AROUND, FEATURES, forests},
};

/// Planes of evidence, `[spot][plane][row][column]`, a byte each.
///
/// All planes but the last are the features of the second forest. Their codes are ranks: the number
/// of the forest's borders that a value exceeds, as a share of 255. Borders are quantiles of the
/// rooms from which the forest was learnt, so that codes spread evenly whatever the unit. The last
/// plane has the forest's log odds ([`EvidenceForm::log_odds`]).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Evidence {
    pub(crate) pixels: usize,
    /// The codes. Spots without a place light nothing: all their codes are 0.
    pub codes: Vec<u8>,
}

impl Evidence {
    /// The number of planes of a spot.
    pub const PLANES: usize = FEATURES.len() + AROUND.len() + 1;

    /// Returns the names of the planes, and the version of the method.
    pub fn form() -> EvidenceForm {
        let names = FEATURES.iter().chain(&AROUND).chain(&["log odds"]);
        EvidenceForm {
            version: VERSION.to_owned(),
            planes: names.map(|name| (*name).to_owned()).collect(),
        }
    }

    pub(crate) fn new(spots: usize, pixels: usize) -> Self {
        Self {
            pixels,
            codes: vec![0; spots * Self::PLANES * pixels],
        }
    }

    pub(crate) fn fill(&mut self, sources: &[Source], judgement: &Judgement) {
        let borders = &forests().last().expect("there are two forests").borders;
        let pixels = self.pixels;
        let mut each: Vec<Option<usize>> = vec![None; self.codes.len() / (Self::PLANES * pixels)];
        for (i, source) in sources.iter().enumerate() {
            each[source.beam] = Some(i);
        }
        let parts = self.codes.par_chunks_mut(Self::PLANES * pixels).zip(each);
        parts.for_each(|(part, i)| {
            let Some(i) = i else { return };
            let (features, odds) = part.split_at_mut((Self::PLANES - 1) * pixels);
            let planes = features.chunks_mut(pixels).zip(&judgement.seen[i]);
            for ((plane, seen), borders) in planes.zip(borders) {
                let most = borders.len().max(1);
                for (code, seen) in plane.iter_mut().zip(seen) {
                    *code = (usize::from(*seen) * 255 / most) as u8;
                }
            }
            for (code, odds) in odds.iter_mut().zip(&judgement.odds[i]) {
                *code = EvidenceForm::code(*odds);
            }
        });
    }
}
