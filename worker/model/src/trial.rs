//! A network with random weights and data, for measurements and for comparison with the same
//! network in PyTorch (`tests/lab/peers/model_torch.py`).

use std::collections::BTreeMap;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use crate::{
    ModelError, Random, cpu,
    input::{Batch, Target},
    net::{Net, NetSpec, Precision},
    parameters::{Named, Parameters, download},
    train::{Learner, Pace, predict},
    weights,
};

/// The network, data and optimiser settings of a trial.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// The quantity that the network learns. It determines the loss.
    pub target: Target,
    /// The network.
    pub net: NetSpec,
    /// The number of examples in a batch.
    pub batch: usize,
    /// The number of rows and of columns.
    pub side: usize,
    /// The learning rate.
    pub learning_rate: f64,
    /// The weight decay.
    pub decay: f64,
    /// The seed of weights and data.
    pub seed: u64,
}

impl Trial {
    /// Returns the learner in its initial state, and the batch that every step uses.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the field that cannot be used.
    pub fn begin(&self, device: &Device) -> Result<(Learner, Batch), ModelError> {
        let net = Net::new(self.net.clone())?;
        let multiple = self.net.multiple();
        if self.side == 0 || !self.side.is_multiple_of(multiple) || self.batch == 0 {
            let what = format!("must be a multiple of {multiple}, and batch at least 1");
            return Err(ModelError::invalid("side", what));
        }
        let parameters = Parameters::begin(net.declared().to_vec(), self.seed, device);
        let learner = Learner::new(net, parameters, self.target, self.decay);
        Ok((learner, self.data()))
    }

    /// Like [`Self::begin`], but with the one-hot channels as dense ones of the same values. The
    /// gather is compared with this form.
    ///
    /// # Errors
    /// Those of [`Self::begin`].
    pub fn dense(&self, device: &Device) -> Result<(Learner, Batch), ModelError> {
        let (gather, mut batch) = self.begin(device)?;
        let spec = NetSpec {
            dense: self.net.dense + self.net.one_hot,
            one_hot: 0,
            ..self.net.clone()
        };
        let net = Net::new(spec)?;
        let named = weights::to_torch(gather.parameters().to_named());
        let parameters = Parameters::from_named(net.declared().to_vec(), named, device)?;
        let pixels = self.side * self.side;
        let mut wide = Vec::new();
        let images = batch.dense.chunks_exact(self.net.dense * pixels);
        for (image, bins) in images.zip(batch.one_hot.chunks_exact(pixels)) {
            wide.extend_from_slice(image);
            let at = wide.len();
            wide.resize(at + self.net.one_hot * pixels, 0.0);
            for (p, bin) in bins.iter().enumerate() {
                if let Ok(bin) = usize::try_from(*bin) {
                    wide[at + bin * pixels + p] = 1.0;
                }
            }
        }
        (batch.dense, batch.one_hot) = (wide, Vec::new());
        let learner = Learner::new(net, parameters, self.target, self.decay);
        Ok((learner, batch))
    }

    fn data(&self) -> Batch {
        let pixels = self.batch * self.side * self.side;
        let mut random = Random::new(self.seed, &[4]);
        // The values resemble histograms: mostly small, with peaks.
        let dense = (0..pixels * self.net.dense).map(|_| random.unit().powi(8));
        let dense = dense.collect();
        let one_hot = match self.net.one_hot {
            0 => Vec::new(),
            bins => (0..pixels)
                .map(|_| random.below(bins as u64 + 1) as i32 - 1)
                .collect(),
        };
        let target = (0..pixels * self.net.outputs).map(|_| match self.target {
            Target::Tof => random.unit(),
            Target::Shadow | Target::Specular => (random.bits() >> 63) as f32,
        });
        Batch {
            images: self.batch,
            height: self.side,
            width: self.side,
            dense,
            one_hot,
            target: target.collect(),
        }
    }

    /// Returns the optimiser settings of the steps.
    pub fn pace(&self) -> Pace {
        Pace {
            learning_rate: self.learning_rate,
            beta1: 0.9,
        }
    }

    /// Records everything that another implementation must reproduce, as safetensors by PyTorch's
    /// names: `weights/`, the batch (`input/`, `target`), `output` of a training pass, its
    /// `gradient/` and running statistics (`after/`), `evaluated` of an evaluation pass, and the
    /// `losses` of `steps` steps of AdamW.
    ///
    /// # Errors
    /// Those of [`Self::begin`]; [`ModelError::NotFinite`].
    pub fn record(&self, steps: usize, device: &Device) -> Result<Vec<u8>, ModelError> {
        let (mut learner, batch) = self.begin(device)?;
        let mut named = Named::new();
        let put = |named: &mut Named, at: &str, tensors: Named| {
            for (name, value) in weights::to_torch(tensors) {
                named.insert(format!("{at}/{name}"), value);
            }
        };
        put(&mut named, "weights", learner.parameters().to_named());
        let (n, s) = (self.batch, self.side);
        let shape = |channels| vec![n, channels, s, s];
        named.insert(
            "input/dense".into(),
            (shape(self.net.dense), batch.dense.clone()),
        );
        if !batch.one_hot.is_empty() {
            let bins = batch.one_hot.iter().map(|bin| *bin as f32).collect();
            named.insert("input/one_hot".into(), (vec![n, s, s], bins));
        }
        named.insert(
            "target".into(),
            (shape(self.net.outputs), batch.target.clone()),
        );
        let evaluated = predict(learner.net(), learner.parameters(), &batch);
        named.insert("evaluated".into(), (shape(self.net.outputs), evaluated));
        let (output, _, gradients) = learner.gradients(batch.clone());
        named.insert("output".into(), (shape(self.net.outputs), output));
        let each = learner.net().declared().iter().zip(&gradients);
        let gradients = each.filter_map(|(d, g)| {
            let values = download(g.as_ref()?);
            Some((d.name.clone(), (d.shape.clone(), values)))
        });
        put(&mut named, "gradient", gradients.collect());
        let after = learner.parameters().to_named().into_iter();
        put(
            &mut named,
            "after",
            after
                .filter(|(name, _)| name.contains("running_"))
                .collect(),
        );
        // Starts from the initial state again because the pass has updated the statistics.
        let (mut learner, _) = self.begin(device)?;
        let mut losses = Vec::with_capacity(steps);
        for _ in 0..steps {
            losses.push(learner.step(vec![batch.clone()], self.pace())?);
        }
        named.insert("losses".into(), (vec![steps], losses));
        let text = serde_json::to_string(self).expect("plain data");
        Ok(weights::write(
            &named,
            &BTreeMap::from([("trial".into(), text)]),
        ))
    }

    /// Returns the initial deviation of a device from the CPU in 32 bits: of the network's output
    /// in training, and of the gradient.
    ///
    /// # Errors
    /// Those of [`Self::begin`].
    pub fn from_cpu(&self, device: &Device) -> Result<Apart, ModelError> {
        let of = |trial: &Self, device| {
            let (mut learner, batch) = trial.begin(device)?;
            let (said, _, gradients) = learner.gradients(batch);
            let gradient: Vec<f32> = gradients.iter().flatten().flat_map(download).collect();
            Ok::<_, ModelError>((said, gradient))
        };
        let mut precise = self.clone();
        precise.net.precision = Precision::F32;
        let (said, gradient) = of(self, device)?;
        let (cpu_said, cpu_gradient) = of(&precise, &cpu())?;
        let far = |a: &[f32], b: &[f32]| {
            let pairs = || a.iter().zip(b).map(|(a, b)| [f64::from(*a), f64::from(*b)]);
            let apart: f64 = pairs().map(|[a, b]| (a - b).powi(2)).sum();
            let length: f64 = pairs().map(|[_, b]| b * b).sum();
            (apart / length).sqrt()
        };
        Ok(Apart {
            output: far(&said, &cpu_said),
            gradient: far(&gradient, &cpu_gradient),
        })
    }

    /// Returns the initial slope of the loss along its own gradient g: the value measured over
    /// ±`reach` · g/|g|, and the expected value |g|. In training, the loss is that of a batch, so
    /// the statistics depend on the parameters.
    ///
    /// # Errors
    /// Those of [`Self::begin`].
    pub fn slope(&self, reach: f32, device: &Device) -> Result<Slope, ModelError> {
        let (mut learner, batch) = self.begin(device)?;
        let (_, _, gradients) = learner.gradients(batch.clone());
        let host: Vec<Option<Vec<f32>>> =
            gradients.iter().map(|g| g.as_ref().map(download)).collect();
        let squares = host
            .iter()
            .flatten()
            .flatten()
            .map(|g| f64::from(*g).powi(2));
        let norm = squares.sum::<f64>().sqrt();
        let mut losses = [0.0; 2];
        for (loss, sign) in losses.iter_mut().zip([1.0, -1.0]) {
            let (mut learner, _) = self.begin(device)?;
            let mut moved = learner.parameters().to_named();
            for (d, g) in learner.net().declared().iter().zip(&host) {
                let Some(g) = g else { continue };
                let (_, values) = moved.get_mut(&d.name).expect("declared");
                for (value, g) in values.iter_mut().zip(g) {
                    *value += (sign * f64::from(reach) * f64::from(*g) / norm) as f32;
                }
            }
            let declared = learner.net().declared().to_vec();
            let parameters = Parameters::from_named(declared, moved, device)?;
            learner = Learner::new(learner.net().clone(), parameters, self.target, self.decay);
            *loss = f64::from(learner.gradients(batch.clone()).1);
        }
        Ok(Slope {
            measured: (losses[0] - losses[1]) / (2.0 * f64::from(reach)),
            expected: norm,
        })
    }
}

/// The result of [`Trial::from_cpu`]: the length of the difference over the length of the
/// reference, all numbers taken as one vector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Apart {
    /// The deviation of the network's output.
    pub output: f64,
    /// The deviation of the gradient.
    pub gradient: f64,
}

/// The result of [`Trial::slope`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slope {
    /// The slope by finite differences.
    pub measured: f64,
    /// The length of the gradient.
    pub expected: f64,
}
