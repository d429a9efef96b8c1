//! The parameters of a network, by PyTorch's names and in the order of declaration. Each is a flat
//! tensor.
//!
//! Names and shapes are those of the released PyTorch code (a U-Net after wolny/pytorch-3dunet), so
//! weights are imported and exported without a name map. Values that are not learned (running
//! statistics) are stored with those that are.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};

use crate::{ModelError, Random};

/// The index of a parameter in its network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Id(pub(crate) usize);

/// The initial values of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Begin {
    /// Uniform in ±1/√fan-in: PyTorch's default for convolutions, linear layers and their biases.
    FanIn(usize),
    /// The same value everywhere.
    Constant(f32),
    /// Normal around 0 with this deviation: the initialisation of transformers. Their code
    /// truncates the distribution at ±2, which is a hundred times the usual deviation of 0.02, so
    /// no value is ever truncated.
    Normal(f32),
    /// The first factor's values times the second, repeated to the parameter's length.
    Repeated(&'static [f32], f32),
}

/// A parameter as a network declares it.
#[derive(Debug, Clone, PartialEq)]
pub struct Declared {
    /// The name that PyTorch gives the parameter.
    pub name: String,
    /// The shape.
    pub shape: Vec<usize>,
    /// The initial values.
    pub begin: Begin,
    /// Whether the optimiser learns the parameter. If not, it is a statistic that training updates.
    pub learned: bool,
}

impl Declared {
    /// Returns the number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The list of a network's parameters while they are being declared.
#[derive(Debug, Default)]
pub struct Declarations {
    pub(crate) list: Vec<Declared>,
    /// Whether parameters declared from now on are excluded from learning.
    pub(crate) frozen: bool,
    /// The index of the first parameter of each segment after the first.
    pub(crate) cuts: Vec<usize>,
}

impl Declarations {
    /// Starts the next segment of a network. The gradients of a segment are computed before those
    /// of the segments in front of it.
    pub(crate) fn cut(&mut self) {
        self.cuts.push(self.list.len());
    }

    /// Declares a parameter.
    pub fn add(&mut self, name: String, shape: &[usize], begin: Begin, learned: bool) -> Id {
        self.list.push(Declared {
            name,
            shape: shape.to_vec(),
            begin,
            learned: learned && !self.frozen,
        });
        Id(self.list.len() - 1)
    }
}

/// The values of tensors by name, on the host: the form for storage and exchange.
pub type Named = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// The values of a network's parameters on a device, without gradients.
#[derive(Debug, Clone)]
pub struct Parameters {
    declared: Vec<Declared>,
    values: Vec<Tensor<1>>,
}

impl Parameters {
    /// Returns the values with which training from scratch begins. They depend on the seed and the
    /// declarations only.
    pub fn begin(declared: Vec<Declared>, seed: u64, device: &Device) -> Self {
        let values = declared.iter().enumerate().map(|(i, d)| {
            let mut random = Random::new(seed, &[1, i as u64]);
            let host = match d.begin {
                Begin::Constant(value) => vec![value; d.len()],
                Begin::FanIn(fan_in) => {
                    let bound = 1.0 / (fan_in as f32).sqrt();
                    let mut draw = || (2.0 * random.unit() - 1.0) * bound;
                    (0..d.len()).map(|_| draw()).collect()
                }
                Begin::Repeated(values, by) => {
                    let values = values.iter().map(|value| value * by);
                    values.cycle().take(d.len()).collect()
                }
                Begin::Normal(deviation) => {
                    let mut draw = || random.normal() * deviation;
                    (0..d.len()).map(|_| draw()).collect()
                }
            };
            upload(host, device)
        });
        let values = values.collect();
        Self { declared, values }
    }

    /// Creates parameters from given values.
    ///
    /// # Errors
    /// [`ModelError::Weights`] naming the first tensor that is missing, superfluous, or of another
    /// shape.
    pub fn from_named(
        declared: Vec<Declared>,
        mut named: Named,
        device: &Device,
    ) -> Result<Self, ModelError> {
        let mut values = Vec::with_capacity(declared.len());
        for d in &declared {
            let Some((shape, host)) = named.remove(&d.name) else {
                let what = format!(
                    "{:?} is missing; the weights belong to another network or are not whole",
                    d.name
                );
                return Err(ModelError::weights(what));
            };
            if shape != d.shape {
                let what = format!(
                    "{:?} has shape {shape:?}, the network wants {:?}; check net.width, net.levels and input.bins",
                    d.name, d.shape
                );
                return Err(ModelError::weights(what));
            }
            values.push(upload(host, device));
        }
        match named.keys().next() {
            Some(name) => Err(ModelError::weights(format!(
                "{name:?} is no parameter of this network; check net.architecture and net.levels"
            ))),
            None => Ok(Self { declared, values }),
        }
    }

    /// Replaces the encoder's parameters, running statistics included, by another network's values.
    ///
    /// # Errors
    /// [`ModelError::Weights`] if one is missing or has another shape.
    pub fn with_encoder_of(
        mut self,
        mut named: Named,
        device: &Device,
    ) -> Result<Self, ModelError> {
        for (i, d) in self.declared.iter().enumerate() {
            let encoder = ["stem.", "encoders.", "time_projection"];
            if !encoder.iter().any(|part| d.name.starts_with(part)) {
                continue;
            }
            let found = named.remove(&d.name).filter(|(shape, _)| *shape == d.shape);
            let Some((_, host)) = found else {
                let what = format!(
                    "the frozen network has no {:?} of shape {:?}; give both the same net and input.bins",
                    d.name, d.shape
                );
                return Err(ModelError::weights(what));
            };
            self.values[i] = upload(host, device);
        }
        Ok(self)
    }

    /// Copies all values to the host.
    pub fn to_named(&self) -> Named {
        let each = self.declared.iter().zip(&self.values);
        each.map(|(d, value)| (d.name.clone(), (d.shape.clone(), download(value))))
            .collect()
    }

    /// Returns each declaration with its value.
    pub(crate) fn named_values(&self) -> impl Iterator<Item = (&Declared, &Tensor<1>)> {
        self.declared.iter().zip(&self.values)
    }

    /// Returns the declarations, in order.
    pub fn declared(&self) -> &[Declared] {
        &self.declared
    }

    /// Returns the number of learned values.
    pub fn learned(&self) -> usize {
        let learned = self.declared.iter().filter(|d| d.learned);
        learned.map(Declared::len).sum()
    }

    /// Returns a parameter's value in its declared shape.
    pub fn get<const D: usize>(&self, id: Id) -> Tensor<D> {
        shaped(&self.declared[id.0], self.values[id.0].clone())
    }

    pub(crate) fn values(&self) -> &[Tensor<1>] {
        &self.values
    }

    pub(crate) fn set(&mut self, id: Id, value: Tensor<1>) {
        self.values[id.0] = value;
    }

    /// Takes a value out, so that no other reference exists while it is changed in place.
    pub(crate) fn take(&mut self, id: Id) -> Tensor<1> {
        let device = self.values[id.0].device();
        std::mem::replace(&mut self.values[id.0], Tensor::empty([0], &device))
    }
}

/// Returns a flat value in its declared shape.
pub(crate) fn shaped<const D: usize>(declared: &Declared, value: Tensor<1>) -> Tensor<D> {
    let shape: [usize; D] = declared
        .shape
        .as_slice()
        .try_into()
        .expect("networks ask for parameters in the rank they declared");
    value.reshape(shape)
}

pub(crate) fn upload(host: Vec<f32>, device: &Device) -> Tensor<1> {
    let len = host.len();
    Tensor::from_data(TensorData::new(host, [len]), device)
}

pub(crate) fn download(value: &Tensor<1>) -> Vec<f32> {
    value
        .to_data_as::<f32>()
        .try_into_vec()
        .expect("asked for f32")
}
