//! Scores of the result against the ground truth.

use serde::Serialize;

use crate::{Demultiplexed, Ground};

/// The truth of a rendered scene, as the renderer gives it.
#[derive(Debug, Clone, Copy)]
pub struct Truth<'a> {
    /// z-depth, metres; 0 where nothing is seen: `[row][column]`.
    pub depth_m: &'a [f32],
    /// 1 where the first surface is a mirror: `[row][column]`; empty where that is not known.
    pub specular: &'a [u8],
    /// 1 = lit: `[spot][row][column]`; empty where that is not known.
    pub visibility: &'a [u8],
}

/// Errors of depths, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DepthScore {
    /// Mean over pixels that see something and no mirror.
    pub mae_m: f64,
    /// Their median.
    pub median_m: f64,
    /// Share of them that is off by more than 5 cm.
    pub over_5cm: f64,
    /// Mean over pixels that see mirrors; `None` without any.
    pub mirrors_mae_m: Option<f64>,
}

/// Masks, at a probability of a half: intersection over union of the lit pairs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MaskScore {
    /// Over all pairs of pixel and spot.
    pub iou: f64,
    /// Over pairs whose cosines can carry light, as the method sees them.
    pub iou_carrying: f64,
    /// Share of wrong answers among all pairs.
    pub mae: f64,
    /// IoU over all pairs of the answer that everything is lit.
    pub all_lit_iou: f64,
}

/// Compares depth with the truth. If no pixel sees a surface, all errors are 0.
pub fn depth(found: &[f32], truth: &Truth) -> DepthScore {
    let (mut plain, mut mirrors) = (Vec::new(), Vec::new());
    for (p, z) in truth.depth_m.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let off = f64::from((found[p] - z).abs());
        match truth.specular.get(p) {
            Some(1..) => mirrors.push(off),
            _ => plain.push(off),
        }
    }
    plain.sort_by(f64::total_cmp);
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len().max(1) as f64;
    let over = plain.iter().filter(|off| **off > 0.05).count();
    DepthScore {
        mae_m: mean(&plain),
        median_m: plain.get(plain.len() / 2).copied().unwrap_or(0.0),
        over_5cm: over as f64 / plain.len().max(1) as f64,
        mirrors_mae_m: (!mirrors.is_empty()).then(|| mean(&mirrors)),
    }
}

/// Compares masks with the truth. Returns `None` if the truth has no masks.
pub fn masks(found: &Demultiplexed, truth: &Truth) -> Option<MaskScore> {
    if truth.visibility.len() != found.lit.len() {
        return None;
    }
    let pairs = || {
        let all = found.lit.iter().zip(truth.visibility).zip(&found.ground);
        all.map(|((p, v), ground)| (*p >= 0.5, *v != 0, *ground))
    };
    let iou = |carrying: bool| {
        let part = || pairs().filter(move |(_, _, g)| !carrying || *g != Ground::Geometry);
        let both = part().filter(|(a, b, _)| *a && *b).count();
        let either = part().filter(|(a, b, _)| *a || *b).count();
        match either {
            0 => 1.0,
            _ => both as f64 / either as f64,
        }
    };
    let all = found.lit.len().max(1) as f64;
    Some(MaskScore {
        iou: iou(false),
        iou_carrying: iou(true),
        mae: pairs().filter(|(a, b, _)| a != b).count() as f64 / all,
        all_lit_iou: pairs().filter(|(_, b, _)| *b).count() as f64 / all,
    })
}

/// Intersection over union of pixels that see mirrors. Returns `None` if the truth has none or is
/// unknown.
pub fn mirrors(found: &Demultiplexed, truth: &Truth) -> Option<f64> {
    let known = truth.specular.iter().any(|s| *s != 0);
    let said = |p: usize| found.mirror.as_ref().is_some_and(|m| m[p] != 0);
    let pairs = || (0..truth.specular.len()).map(|p| (said(p), truth.specular[p] != 0));
    let both = pairs().filter(|(a, b)| *a && *b).count();
    let either = pairs().filter(|(a, b)| *a || *b).count();
    known.then(|| both as f64 / either as f64)
}
