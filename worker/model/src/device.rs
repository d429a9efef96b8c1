//! Where networks are computed: the CPU, or a graphics processor.
//!
//! A graphics processor has a name: its runtime and its number there, e.g. `cuda:0` or `wgpu:1`. Those that drivers compute on
//! the CPU (Mesa's lavapipe) are *software devices*; they serve tests, and nobody gets one without naming it. Before one is
//! used it computes a small convolution, its gradients and a product: one that is wrong is refused by name. Drivers that
//! multiply wrongly without a word have been seen; they are wrong by as much as the result. NVIDIA's cards are not: burn has their
//! tensor cores multiply, which round what they multiply to 11 significant bits (TF32), and results to
//! some 3·10⁻⁴ of the greatest. How far a device is off is said wherever it is listed.

use std::fmt;

use burn::tensor::{Device, FloatDType, Tensor, TensorData};

pub use picofarm_settings::Gpus;

use crate::{
    ModelError,
    net::{NetSpec, Precision},
    ops::{has_kernels, plain},
};

/// The CPU.
pub fn cpu() -> Device {
    Device::flex()
}

/// Runtimes of graphics processors that this program was built with, best first.
pub const RUNTIMES: &[&str] = &[
    #[cfg(feature = "cuda")]
    "cuda",
    #[cfg(feature = "wgpu")]
    "wgpu",
];

/// How far a probe may lie from the CPU's, over its greatest value: a few times what TF32 makes of it.
const ROUNDED: f32 = 2e-3;

/// Below it, a device multiplies in 32 bits.
const FINE: f32 = 1e-5;

/// What to build a program with that has some.
const BUILD: &str =
    "build picofarm with --features wgpu (any vendor's) or --features cuda (NVIDIA's)";

/// A graphics processor that drivers list. It is not opened yet.
#[derive(Debug, Clone)]
pub struct Gpu {
    id: String,
    software: bool,
    device: Device,
}

impl Gpu {
    /// Its runtime and its number there: `cuda:0`, `wgpu:1`.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Whether a driver computes on the CPU in its name.
    pub fn is_software(&self) -> bool {
        self.software
    }

    /// Opens it and compares what it computes with the CPU.
    ///
    /// # Errors
    /// [`ModelError::Gpu`] where it cannot be opened, or computes wrongly.
    pub fn open(&self) -> Result<OpenGpu, ModelError> {
        let opened = guarded(&self.id, || {
            #[cfg(any(feature = "cuda", feature = "wgpu"))]
            let name = self.device.identity().map(|identity| identity.name);
            #[cfg(not(any(feature = "cuda", feature = "wgpu")))]
            let name = None::<String>;
            (name.unwrap_or_default(), probe(&self.device))
        });
        let (name, found) = opened?;
        match apart(&found, &probe(&cpu())) {
            Ok(apart) => Ok(OpenGpu {
                id: self.id.clone(),
                name,
                apart,
                device: self.device.clone(),
            }),
            Err(what) => Err(ModelError::Gpu {
                id: self.id.clone(),
                what: format!("{name:?} computes wrongly: {what}; install another driver for it"),
            }),
        }
    }
}

/// A graphics processor that computes as the CPU does.
#[derive(Debug, Clone)]
pub struct OpenGpu {
    /// As [`Gpu::id`].
    pub id: String,
    /// As it calls itself.
    pub name: String,
    /// How far a product, a convolution and their gradients lay from the CPU's at most, over the greatest value of each.
    pub apart: f32,
    /// What tensors are made on.
    pub device: Device,
}

impl OpenGpu {
    /// How it computes, for people: to how much of the greatest value, where that is more than rounding in 32 bits gives.
    pub fn accuracy(&self) -> String {
        match self.apart > FINE {
            true => format!(
                "computes as the CPU does to {:.0e} of the greatest value: it rounds what it multiplies",
                self.apart
            ),
            false => "computes as the CPU does".into(),
        }
    }
}

impl fmt::Display for OpenGpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.id, self.name)
    }
}

/// Has CubeCL keep what it finds out about a card: which kernels are fastest, and compiled ones. Both take minutes for a network that a
/// card has not met yet. They are kept in the user's cache folder, unless a `cubecl.toml` says elsewhere; what such a file or
/// CubeCL's environment variables say counts.
#[cfg(feature = "cuda")]
fn keep_kernels() {
    use burn::cubecl::config::{CubeClRuntimeConfig, RuntimeConfig, cache::CacheConfig};
    let mut config = CubeClRuntimeConfig::from_current_dir().override_from_env();
    config.compilation.cache = true;
    if matches!(config.environment.path, CacheConfig::Target) {
        config.environment.path = CacheConfig::Global;
    }
    // Refused where it has been asked for already: then it is as it was said before.
    CubeClRuntimeConfig::try_set(config);
}

/// Every graphics processor that drivers list, those of the best runtime first.
pub fn gpus() -> Vec<Gpu> {
    #[cfg(feature = "cuda")]
    keep_kernels();
    #[cfg_attr(
        not(any(feature = "cuda", feature = "wgpu")),
        allow(unused_mut, reason = "nothing is listed then")
    )]
    let mut found = Vec::new();
    #[cfg(feature = "cuda")]
    list(&mut found, "cuda", burn::tensor::DeviceType::Cuda);
    #[cfg(feature = "wgpu")]
    list(&mut found, "wgpu", burn::tensor::DeviceType::Wgpu);
    found
}

#[cfg(any(feature = "cuda", feature = "wgpu"))]
fn list(to: &mut Vec<Gpu>, runtime: &str, kind: burn::tensor::DeviceType) {
    #[cfg(feature = "wgpu")]
    let software = |device: &Device| *device == Device::wgpu(burn::tensor::DeviceKind::Cpu);
    #[cfg(not(feature = "wgpu"))]
    let software = |_: &Device| false;
    // Drivers that fail while they are listed have nothing to offer.
    let listed = guarded(runtime, || Device::enumerate(kind).into_vec());
    let listed = listed.unwrap_or_default().into_iter().enumerate();
    to.extend(listed.map(|(number, device)| Gpu {
        id: format!("{runtime}:{number}"),
        software: software(&device),
        device,
    }));
}

/// Opens the graphics processors that are wanted, in order.
///
/// # Errors
/// [`ModelError::Invalid`] where there are fewer, or none of that name, or the program was built without any runtime;
/// [`ModelError::Gpu`] as [`Gpu::open`].
pub fn open(wanted: &Gpus) -> Result<Vec<OpenGpu>, ModelError> {
    chosen(wanted)?.iter().map(Gpu::open).collect()
}

/// The names of those that are wanted, in order; none is opened.
///
/// # Errors
/// [`ModelError::Invalid`] as [`open`].
pub fn names(wanted: &Gpus) -> Result<Vec<String>, ModelError> {
    Ok(chosen(wanted)?.into_iter().map(|gpu| gpu.id).collect())
}

fn chosen(wanted: &Gpus) -> Result<Vec<Gpu>, ModelError> {
    if *wanted == Gpus::default() {
        return Ok(Vec::new());
    }
    if RUNTIMES.is_empty() {
        let what = format!("this program was built without graphics processors; {BUILD}");
        return Err(ModelError::invalid("gpus", what));
    }
    let listed = gpus();
    let chosen = choose(wanted, &listed).map_err(|what| ModelError::invalid("gpus", what))?;
    Ok(chosen.into_iter().cloned().collect())
}

/// Those that are wanted.
fn choose<'a>(wanted: &Gpus, listed: &'a [Gpu]) -> Result<Vec<&'a Gpu>, String> {
    let there = || match listed.is_empty() {
        true => "none is there (is its driver installed, and may this process use it?)".to_owned(),
        false => {
            let ids: Vec<String> = listed
                .iter()
                .map(|gpu| match gpu.software {
                    true => format!("{} (a software device)", gpu.id),
                    false => gpu.id.clone(),
                })
                .collect();
            format!("there are {}", ids.join(", "))
        }
    };
    match wanted {
        Gpus::Count(count) => {
            let runtime = |gpu: &Gpu| gpu.id.split(':').next().map(str::to_owned);
            let mut cards = listed.iter().filter(|gpu| !gpu.software).peekable();
            // A card is listed by each runtime that reaches it.
            let first = cards.peek().and_then(|gpu| runtime(gpu));
            let cards = cards.filter(|gpu| runtime(gpu) == first);
            let chosen: Vec<&Gpu> = cards.take(*count as usize).collect();
            match chosen.len() == *count as usize {
                true => Ok(chosen),
                false => Err(format!(
                    "{count} graphics processors are asked for, {} can be used; {}",
                    chosen.len(),
                    there()
                )),
            }
        }
        Gpus::Named(ids) => ids
            .iter()
            .map(|id| {
                let found = listed.iter().find(|gpu| gpu.id == *id);
                found.ok_or_else(|| format!("no graphics processor is called {id:?}; {}", there()))
            })
            .collect(),
    }
}

/// Runs what a driver may end by a panic, and says in its error what the panic said.
///
/// # Errors
/// [`ModelError::Gpu`].
pub fn guarded<T>(id: &str, work: impl FnOnce() -> T) -> Result<T, ModelError> {
    // What is half made is not looked at again.
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).map_err(|panic| {
        let said = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied());
        ModelError::Gpu {
            id: id.to_owned(),
            what: said
                .unwrap_or("its driver failed without a word")
                .to_owned(),
        }
    })
}

/// Whether a device has the numbers in which a network is computed.
///
/// # Errors
/// [`ModelError::Invalid`] where it has not.
pub(crate) fn computes(net: &NetSpec, device: &Device) -> Result<(), ModelError> {
    let there = match net.precision {
        Precision::F32 => true,
        Precision::Bf16 => has_kernels(device) || device.supports_dtype(FloatDType::BF16),
    };
    match there {
        true => Ok(()),
        false => Err(ModelError::invalid(
            "net.precision",
            "this graphics processor, as its runtime reaches it, has no bfloat16: write \"f32\" instead of \"bf16\", or use \
             another (NVIDIA's through a build with --features cuda)",
        )),
    }
}

/// A step small enough to take a moment on anything: a product and a convolution, each with the gradients of its inputs.
fn probe(device: &Device) -> Vec<(&'static str, Vec<f32>)> {
    let device = device.clone().autodiff();
    let mut state = 1_u32;
    let mut number = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / 8_388_608.0 - 1.0
    };
    let mut values = |count: usize| (0..count).map(|_| number()).collect::<Vec<f32>>();
    let mut tensor4 = |dims: [usize; 4]| {
        let data = TensorData::new(values(dims.iter().product()), dims.to_vec());
        Tensor::<4>::from_data(data, &device).require_grad()
    };
    let (x, w) = (tensor4([2, 9, 16, 24]), tensor4([12, 9, 3, 3]));
    let (a, b) = (tensor4([1, 1, 65, 96]), tensor4([1, 1, 96, 40]));
    let convolved = plain::conv3x3(x.clone(), w.clone());
    let product = a.clone().matmul(b.clone());
    let squares = convolved.clone().square().sum() + product.clone().square().sum();
    let grads = squares.backward();
    let of = |tensor: &Tensor<4>| tensor.grad(&grads).expect("it has a gradient");
    [
        ("a product of matrices", product.clone().inner()),
        ("its gradient", of(&a)),
        ("its other gradient", of(&b)),
        ("a convolution", convolved.clone().inner()),
        ("a convolution's gradient by its input", of(&x)),
        ("a convolution's gradient by its weights", of(&w)),
    ]
    .map(|(what, tensor)| {
        let values = tensor.into_data().try_into_vec();
        (what, values.expect("networks compute in f32"))
    })
    .into()
}

/// How far a probe lies from another at most, over the greatest value of each part; what is wrong with it where that is more
/// than [`ROUNDED`].
fn apart(
    found: &[(&'static str, Vec<f32>)],
    expected: &[(&'static str, Vec<f32>)],
) -> Result<f32, String> {
    let mut most = 0.0_f32;
    for ((what, a), (_, b)) in found.iter().zip(expected) {
        if a.len() != b.len() {
            return Err(format!("{what} has {} values, not {}", a.len(), b.len()));
        }
        let scale = b.iter().fold(0.0, |most, x| f32::max(most, x.abs()));
        for off in a.iter().zip(b).map(|(a, b)| (a - b).abs()) {
            if off.is_nan() || off > ROUNDED * scale {
                return Err(format!(
                    "{what} is {off:.1e} off where the greatest value is {scale:.1e}"
                ));
            }
            most = most.max(off / scale);
        }
    }
    Ok(most)
}

#[cfg(test)]
mod tests {
    use super::{Gpu, Gpus, ROUNDED, apart, choose, cpu, guarded, probe};

    fn listed(of: &[(&str, bool)]) -> Vec<Gpu> {
        let gpu = |(id, software): &(&str, bool)| Gpu {
            id: (*id).to_owned(),
            software: *software,
            device: cpu(),
        };
        of.iter().map(gpu).collect()
    }

    fn chosen(wanted: &Gpus, of: &[(&str, bool)]) -> Result<Vec<String>, String> {
        let listed = listed(of);
        let chosen = choose(wanted, &listed)?;
        Ok(chosen.into_iter().map(|gpu| gpu.id.clone()).collect())
    }

    #[test]
    fn a_count_means_cards_of_one_runtime_and_never_software_devices() {
        let there = [
            ("cuda:0", false),
            ("cuda:1", false),
            ("wgpu:0", false),
            ("wgpu:1", true),
        ];
        assert_eq!(
            chosen(&Gpus::Count(2), &there).unwrap(),
            ["cuda:0", "cuda:1"]
        );
        let error = chosen(&Gpus::Count(3), &there).unwrap_err();
        assert!(
            error.contains("3 graphics processors are asked for, 2 can be used")
                && error.contains("wgpu:1 (a software device)"),
            "{error}"
        );
        let error = chosen(&Gpus::Count(1), &[("wgpu:0", true)]).unwrap_err();
        assert!(error.contains("0 can be used"), "{error}");
        let error = chosen(&Gpus::Count(1), &[]).unwrap_err();
        assert!(error.contains("driver"), "{error}");
    }

    #[test]
    fn names_choose_any_in_their_order() {
        let there = [("cuda:0", false), ("wgpu:0", false), ("wgpu:1", true)];
        let named = |ids: &[&str]| Gpus::Named(ids.iter().map(|id| (*id).into()).collect());
        let ids = ["wgpu:1", "cuda:0"];
        assert_eq!(chosen(&named(&ids), &there).unwrap(), ids);
        let error = chosen(&named(&["cuda:7"]), &there).unwrap_err();
        assert!(
            error.contains("\"cuda:7\"") && error.contains("cuda:0, wgpu:0"),
            "{error}"
        );
    }

    #[test]
    fn a_probe_that_is_wrong_is_named() {
        let good = probe(&cpu());
        assert_eq!(apart(&good, &probe(&cpu())), Ok(0.0));
        for which in 0..good.len() {
            for wrong in [good[which].1[3] * 1.5 + 0.1, f32::NAN] {
                let mut bad = good.clone();
                bad[which].1[3] = wrong;
                let what = apart(&bad, &good).unwrap_err();
                assert!(what.starts_with(good[which].0), "{what}");
            }
            let mut short = good.clone();
            short[which].1.pop();
            assert!(apart(&short, &good).is_err());
        }
    }

    /// Cards that round what they multiply to TF32 must not be refused.
    #[test]
    fn a_probe_whose_factors_were_rounded_is_none_that_is_wrong() {
        let tf32 = |x: f32| f32::from_bits((x.to_bits() + 0x1000) & !0x1fff);
        let good = probe(&cpu());
        let rounded: Vec<_> = good
            .iter()
            .map(|(what, values)| (*what, values.iter().map(|x| tf32(*x)).collect()))
            .collect();
        let found = apart(&rounded, &good).unwrap();
        assert!((1e-4..ROUNDED / 2.0).contains(&found), "{found}");
    }

    #[test]
    fn what_a_driver_panics_with_is_said() {
        let error = guarded("wgpu:0", || panic!("no memory: {}", 3)).unwrap_err();
        assert!(error.to_string().contains("no memory: 3"), "{error}");
        assert!(error.to_string().contains("wgpu:0"), "{error}");
    }
}
