//! Gradients of a step one segment of the network after the other, as processes of a training exchange them.

use std::ops::Range;

use burn::tensor::Tensor;

use super::{
    group::{Block, Blocks, Part, add_values},
    learner::{Brought, Forward, Gradients, Learner, Summed},
    loss::Loss,
};
use crate::{
    ModelError,
    net::Cut,
    parameters::{Declared, Id, download, upload},
};

/// The way back through a pass whose graph is cut between segments, from the last to the first.
struct Backward {
    leaves: Vec<Tensor<1>>,
    losses: Loss,
    root: Option<Tensor<1>>,
    /// What segments handed on, and the gradients of it so far.
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

    /// Gradients of the parameters of a segment, after those of all later segments.
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
        // The slope of the loss along what the segment before handed on, as the gradient of a product.
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
    /// What a process has of a step: what is summed already, and its last batch, where it has any. Gradients are handed over as numbers
    /// one segment of the network after the other, the last segment's first, while those of the others are still to be
    /// computed.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`]; nothing has changed.
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

    /// The sums of all processes of a step of so many batches, from [`Self::parts`] of each.
    ///
    /// # Errors
    /// [`ModelError::Weights`] where there are more or fewer numbers than a step has.
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

    /// Gradients of all learned parameters of a segment, and the loss.
    fn gradient_len(&self, segment: &Range<usize>) -> usize {
        let learned = self.net.declared()[segment.clone()]
            .iter()
            .filter(|d| d.learned);
        learned.map(Declared::len).sum::<usize>() + 1
    }
}
