//! Gradient boosting of oblivious trees for log odds, by histograms (Friedman 2001; Chen and
//! Guestrin, KDD 2016).

use picofarm_demultiplex::learning::{Forest, LEVELS, Tree, UNIT};
use rayon::prelude::*;

/// Borders of each feature.
const BORDERS: usize = 96;
/// Share of a tree's step that is taken.
const RATE: f64 = 0.12;
/// Pull of leaves towards 0, in units of curvature.
const PULL: f64 = 8.0;

/// Learns a forest from features, `[feature][item]`, and answers.
pub fn learn(features: &[Vec<f32>], lit: &[bool], trees: usize) -> Forest {
    let items = lit.len();
    let borders: Vec<Vec<f32>> = features.par_iter().map(|f| borders(f)).collect();
    let cut: Vec<Vec<u8>> = features
        .par_iter()
        .zip(&borders)
        .map(|(f, b)| f.iter().map(|v| Forest::cut(b, *v)).collect())
        .collect();
    let share = lit.iter().filter(|l| **l).count() as f64 / items as f64;
    let base = (share / (1.0 - share)).ln();
    let mut odds = vec![base; items];
    let mut forest = Forest {
        borders,
        base: base as f32,
        trees: Vec::new(),
    };
    for _ in 0..trees {
        let slopes: Vec<[f32; 2]> = odds
            .par_iter()
            .zip(lit)
            .map(|(o, l)| {
                let p = 1.0 / (1.0 + (-o).exp());
                [(f64::from(u8::from(*l)) - p) as f32, (p * (1.0 - p)) as f32]
            })
            .collect();
        let mut leaf = vec![0u8; items];
        let mut questions = [(0u8, 0u8); LEVELS];
        for (level, question) in questions.iter_mut().enumerate() {
            let best = |f: usize| best_border(&cut[f], &leaf, &slopes, 1 << level, f);
            let all: Vec<(f64, u8, u8)> = (0..cut.len()).into_par_iter().map(best).collect();
            let most = all
                .iter()
                .copied()
                .fold(all[0], |a, b| if b.0 > a.0 { b } else { a });
            *question = (most.1, most.2);
            for (leaf, v) in leaf.iter_mut().zip(&cut[usize::from(most.1)]) {
                *leaf = (*leaf << 1) | u8::from(*v > most.2);
            }
        }
        let mut sums = vec![[0.0f64; 2]; 1 << LEVELS];
        for (leaf, s) in leaf.iter().zip(&slopes) {
            let sum = &mut sums[usize::from(*leaf)];
            sum[0] += f64::from(s[0]);
            sum[1] += f64::from(s[1]);
        }
        let leaves: Vec<i16> = sums
            .iter()
            .map(|[g, h]| (RATE * g / (h + PULL) / f64::from(UNIT)).clamp(-3e4, 3e4) as i16)
            .collect();
        for (odds, leaf) in odds.iter_mut().zip(&leaf) {
            *odds += f64::from(leaves[usize::from(*leaf)]) * f64::from(UNIT);
        }
        forest.trees.push(Tree { questions, leaves });
    }
    forest
}

/// Borders at equal numbers of items.
fn borders(values: &[f32]) -> Vec<f32> {
    let step = (values.len() / 20_000).max(1);
    let mut sorted: Vec<f32> = values.iter().copied().step_by(step).collect();
    sorted.sort_by(f32::total_cmp);
    let mut all: Vec<f32> = (1..=BORDERS)
        .map(|k| sorted[k * (sorted.len() - 1) / (BORDERS + 1)])
        .collect();
    all.dedup();
    all
}

/// Gain, feature and border of the best question.
fn best_border(
    cut: &[u8],
    leaf: &[u8],
    slopes: &[[f32; 2]],
    leaves: usize,
    feature: usize,
) -> (f64, u8, u8) {
    const CUTS: usize = BORDERS + 1;
    let mut sums = vec![[0.0f64; 2]; leaves * CUTS];
    for ((v, leaf), s) in cut.iter().zip(leaf).zip(slopes) {
        let sum = &mut sums[usize::from(*leaf) * CUTS + usize::from(*v)];
        sum[0] += f64::from(s[0]);
        sum[1] += f64::from(s[1]);
    }
    let mut gains = [0.0f64; BORDERS];
    let gain = |g: f64, h: f64| g * g / (h + PULL);
    for sums in sums.chunks(CUTS) {
        let total = sums
            .iter()
            .fold([0.0; 2], |t, s| [t[0] + s[0], t[1] + s[1]]);
        let mut below = [0.0; 2];
        for (k, s) in sums[..BORDERS].iter().enumerate() {
            below = [below[0] + s[0], below[1] + s[1]];
            gains[k] += gain(below[0], below[1]) + gain(total[0] - below[0], total[1] - below[1])
                - gain(total[0], total[1]);
        }
    }
    let mut best = (f64::NEG_INFINITY, feature as u8, 0);
    for (k, gain) in gains.into_iter().enumerate() {
        if gain > best.0 {
            best = (gain, feature as u8, k as u8);
        }
    }
    best
}
