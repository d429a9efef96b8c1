//! The gradients of a step, computed segment by segment. The processes of a training exchange them
//! in this form.

use std::ops::Range;

use burn::tensor::Tensor;

use super::{
    gradients::{Gradients, Summed},
    group::{Block, Blocks, Part, add_values},
    learner::{Brought, Forward, Learner},
    loss::Loss,
};
use crate::{
    ModelError,
    net::Cut,
    parameters::{Declared, Id, download, upload},
};

/// The backward pass over a graph with cuts between segments, from the last segment to the first.
struct Backward {
    leaves: Vec<Tensor<1>>,
    losses: Loss,
    root: Option<Tensor<1>>,
    /// The values at the cuts between segments, and their gradients so far.
    cuts: Vec<(Cut, Option<Tensor<4>>)>,
}

impl Backward {
    fn of(forward: Forward) -> Self {
        Self {
            leaves: forward.leaves,
            losses: forward.losses,
            root: Some(forward.root),
            cuts: forward.cuts.into_iter().map(|cut| (cut, None)).collect(),
        }
    }

    /// Returns the gradients of the parameters of a segment. Those of all later segments must have
    /// been computed.
    fn segment(&mut self, segment: usize, range: &Range<usize>) -> Vec<Option<Tensor<1>>> {
        let Some(root) = self.root.take() else {
            return vec![None; range.len()];
        };
        let mut gradients = root.backward();
        for (cut, so_far) in &mut self.cuts {
            if let Some(gradient) = cut.seen.grad_remove(&mut gradients) {
                *so_far = Some(match so_far.take() {
                    Some(so_far) => so_far + gradient,
                    None => gradient,
                });
            }
        }
        let of = self.leaves[range.clone()].iter();
        let found = of.map(|leaf| leaf.grad_remove(&mut gradients)).collect();
        // The gradient of the loss with respect to the values from the previous segment, computed
        // as the gradient of a product.
        for (cut, so_far) in &mut self.cuts {
            if cut.segment + 1 == segment
                && let Some(gradient) = so_far.take()
            {
                let product = (cut.made.clone() * gradient.autodiff()).sum();
                self.root = Some(match self.root.take() {
                    Some(root) => root + product,
                    None => product,
                });
            }
        }
        found
    }
}

impl Learner {
    /// Computes a process's gradients of a step from the sum so far and its last batch, if it has
    /// one. The gradients of the last segment are passed on first, while those of the earlier
    /// segments are still to be computed.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; the learner is then unchanged.
    pub fn parts(
        &self,
        mut sum: Gradients,
        last: Option<(usize, Brought)>,
        each: &mut dyn FnMut(Part),
    ) -> Result<(), ModelError> {
        if let Some(latest) = sum.latest.take() {
            self.finite(latest)?;
        }
        let mut last = match last {
            None => None,
            Some((at, batch)) => {
                let mut forward = self.forward(batch, true);
                self.unbroken(&forward.losses)?;
                if at == 0 {
                    sum.moved = std::mem::take(&mut forward.moved);
                }
                Some((at, Backward::of(forward)))
            }
        };
        for (segment, range) in self.net.segments().iter().enumerate().rev() {
            let mut blocks = sum.blocks.each(|summed| Summed {
                gradients: summed.gradients[range.clone()].to_vec(),
                losses: summed.losses.clone(),
            });
            if let Some((at, backward)) = &mut last {
                let block = Block {
                    begin: *at,
                    len: 1,
                    sum: Summed {
                        gradients: backward.segment(segment, range),
                        losses: backward.losses.clone(),
                    },
                };
                blocks.push(block, &mut Summed::add);
            }
            let len = self.gradient_len(range);
            let moved: &[(Id, Tensor<1>)] = if segment == 0 { &sum.moved } else { &[] };
            each(Part {
                len,
                blocks: blocks.map(|summed| summed.numbers(len)),
                moved: moved
                    .iter()
                    .map(|(id, value)| (id.0, download(value)))
                    .collect(),
            });
        }
        Ok(())
    }

    /// Returns the sum of a step's gradients over all processes, from the [`Self::parts`] of each.
    /// `batches` is the number of batches in the step.
    ///
    /// # Errors
    /// [`ModelError::Weights`] if there are more or fewer numbers than a step has.
    pub fn gradients_of(&self, parts: Vec<Part>, batches: usize) -> Result<Gradients, ModelError> {
        let wrong = |what: &str, there: usize, needed: usize| {
            ModelError::weights(format!("a step's {what} have {there} values, not {needed}"))
        };
        let (segments, declared) = (self.net.segments(), self.net.declared());
        if parts.len() != segments.len() {
            return Err(wrong("segments", parts.len(), segments.len()));
        }
        let mut moved = Vec::new();
        let mut gradients = Vec::with_capacity(declared.len());
        let mut losses = Loss::Known(0.0);
        // The first segment came last.
        for (range, part) in segments.iter().zip(parts.into_iter().rev()) {
            let needed = self.gradient_len(range);
            let values = part.blocks.total(&mut |a, b| add_values(a, &b));
            let values = values.unwrap_or_default();
            if values.len() != needed {
                return Err(wrong("gradients", values.len(), needed));
            }
            let mut rest = &values[..];
            for d in &declared[range.clone()] {
                gradients.push(d.learned.then(|| {
                    let (taken, left) = rest.split_at(d.len());
                    rest = left;
                    upload(taken.to_vec(), &self.device)
                }));
            }
            losses = Loss::Known(rest[0]);
            for (which, values) in part.moved {
                let needed = declared.get(which).filter(|d| !d.learned);
                let needed = needed.map_or(0, Declared::len);
                if values.len() != needed {
                    return Err(wrong("running statistics", values.len(), needed));
                }
                moved.push((Id(which), upload(values, &self.device)));
            }
        }
        Ok(Gradients {
            blocks: Blocks::whole(batches, Summed { gradients, losses }),
            moved,
            latest: None,
        })
    }

    /// Returns the number of gradients of a segment's learned parameters, plus one for the loss.
    fn gradient_len(&self, segment: &Range<usize>) -> usize {
        let learned = self.net.declared()[segment.clone()]
            .iter()
            .filter(|d| d.learned);
        learned.map(Declared::len).sum::<usize>() + 1
    }
}
