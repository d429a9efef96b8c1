//! The numbers of a network: by PyTorch's names, in the order of declaration, one flat tensor each.
//!
//! Names and shapes are those of the released PyTorch code (a U-Net after wolny/pytorch-3dunet), so that weights go in and
//! out without a map. What is not learned (running statistics) lies beside what is.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};

use crate::{ModelError, Random};

/// Which parameter of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Id(pub(crate) usize);

/// How a parameter begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Begin {
    /// Uniform in ±1/√fan-in: PyTorch's default for convolutions, linear layers and their biases.
    FanIn(usize),
    /// All the same.
    Constant(f32),
    /// Normal around 0 with this deviation: what transformers begin with. Their code cuts it off at ±2, a hundred deviations of
    /// 0.02 away, where no value ever lies.
    Normal(f32),
    /// These times that, again and again.
    Repeated(&'static [f32], f32),
}

/// A parameter as a network declares it.
#[derive(Debug, Clone, PartialEq)]
pub struct Declared {
    /// PyTorch's name of it.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// How it begins.
    pub begin: Begin,
    /// Learned by the optimiser, or a statistic that training moves.
    pub learned: bool,
}

impl Declared {
    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The list of a network's parameters, in the making.
#[derive(Debug, Default)]
pub struct Declarations {
    pub(crate) list: Vec<Declared>,
    /// What is declared now is not learned.
    pub(crate) frozen: bool,
    /// Where the second and further segments begin.
    pub(crate) cuts: Vec<usize>,
}

impl Declarations {
    /// What is declared from now on is of the next segment of a network: gradients of a segment come before those of the segments
    /// before it.
    pub(crate) fn cut(&mut self) {
        self.cuts.push(self.list.len());
    }

    /// Declares one.
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

/// Values of a tensor by name, on the host: what is stored and exchanged.
pub type Named = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// The values of a network's parameters on a device, without gradients.
#[derive(Debug, Clone)]
pub struct Parameters {
    declared: Vec<Declared>,
    values: Vec<Tensor<1>>,
}

impl Parameters {
    /// Values as training from scratch begins: a function of the seed and the declarations alone.
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

    /// Values from elsewhere.
    ///
    /// # Errors
    /// [`ModelError::Weights`] naming the first tensor that is missing, too many, or has another shape.
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

    /// The same with the parts that are not learned taken from another network's values; its running statistics too.
    ///
    /// # Errors
    /// [`ModelError::Weights`] where one is missing or has another shape.
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

    /// All values on the host.
    pub fn to_named(&self) -> Named {
        let each = self.declared.iter().zip(&self.values);
        each.map(|(d, value)| (d.name.clone(), (d.shape.clone(), download(value))))
            .collect()
    }

    /// Each value beside its declaration.
    pub(crate) fn named_values(&self) -> impl Iterator<Item = (&Declared, &Tensor<1>)> {
        self.declared.iter().zip(&self.values)
    }

    /// The declarations, in order.
    pub fn declared(&self) -> &[Declared] {
        &self.declared
    }

    /// Number of learned values.
    pub fn learned(&self) -> usize {
        let learned = self.declared.iter().filter(|d| d.learned);
        learned.map(Declared::len).sum()
    }

    /// The value of one, in its shape.
    pub fn get<const D: usize>(&self, id: Id) -> Tensor<D> {
        shaped(&self.declared[id.0], self.values[id.0].clone())
    }

    pub(crate) fn values(&self) -> &[Tensor<1>] {
        &self.values
    }

    pub(crate) fn set(&mut self, id: Id, value: Tensor<1>) {
        self.values[id.0] = value;
    }

    /// Takes a value out, so that nobody else holds it while it is changed in place.
    pub(crate) fn take(&mut self, id: Id) -> Tensor<1> {
        let device = self.values[id.0].device();
        std::mem::replace(&mut self.values[id.0], Tensor::empty([0], &device))
    }
}

/// A flat value in its declared shape.
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
