//! The devices that compute networks: the CPU and graphics processors.
//!
//! The name of a graphics processor consists of its runtime and its number within that runtime,
//! e.g. `cuda:0` or `wgpu:1`. Graphics processors that a driver emulates on the CPU (Mesa's
//! lavapipe) are *software devices*. They serve tests and are used only if named explicitly. Before
//! a device is used, it computes a small convolution, its gradients and a matrix product. If the
//! result is wrong, the device is refused with an error that names it. Some drivers have been
//! observed to multiply wrongly without reporting an error; their error is as large as the result.
//! NVIDIA cards deviate far less: burn uses their tensor cores, which round the factors of a
//! product to 11 significant bits (TF32), so results deviate by about 3·10⁻⁴ of the greatest value.
//! Every list of devices shows the deviation of each.

use std::fmt;

use burn::tensor::{Device, FloatDType, Tensor, TensorData};

pub use picofarm_settings::Gpus;

use crate::{
    ModelError,
    net::{NetSpec, Precision},
    ops::{has_kernels, plain},
};

/// Returns the CPU.
pub fn cpu() -> Device {
    Device::flex()
}

/// The GPU runtimes that this program was built with, best first.
pub const RUNTIMES: &[&str] = &[
    #[cfg(feature = "cuda")]
    "cuda",
    #[cfg(feature = "wgpu")]
    "wgpu",
];

/// The greatest accepted deviation of a probe from the CPU's, relative to its greatest value: a few
/// times the error of TF32.
const ROUNDED: f32 = 2e-3;

/// A device with a smaller deviation multiplies in 32 bits.
const FINE: f32 = 1e-5;

/// The hint for programs that were built without a GPU runtime.
const BUILD: &str =
    "build picofarm with --features wgpu (any vendor's) or --features cuda (NVIDIA's)";

/// A graphics processor that a driver lists. It has not been opened yet.
#[derive(Debug, Clone)]
pub struct Gpu {
    id: String,
    software: bool,
    device: Device,
}

impl Gpu {
    /// Returns the name: the runtime and the number within it, e.g. `cuda:0` or `wgpu:1`.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns whether a driver emulates this device on the CPU.
    pub fn is_software(&self) -> bool {
        self.software
    }

    /// Opens the device and compares its results with the CPU's.
    ///
    /// # Errors
    /// [`ModelError::Gpu`] if the device cannot be opened or computes wrongly.
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

/// An opened graphics processor. Its results agree with the CPU's.
#[derive(Debug, Clone)]
pub struct OpenGpu {
    /// The device's name, as in [`Gpu::id`].
    pub id: String,
    /// The name that the device reports.
    pub name: String,
    /// The greatest deviation of a product, a convolution and their gradients from the CPU's
    /// results, relative to the greatest value of each.
    pub apart: f32,
    /// The device on which tensors are created.
    pub device: Device,
}

impl OpenGpu {
    /// Describes the device's accuracy for people. Gives the relative deviation if it exceeds the
    /// rounding error of 32 bits.
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

/// Makes CubeCL store the fastest kernels it found for a card, and its compiled kernels. Finding
/// and compiling them takes minutes the first time a network runs on a card. They are stored in the
/// user's cache folder, unless a `cubecl.toml` or CubeCL's environment variables choose another
/// place.
#[cfg(feature = "cuda")]
fn keep_kernels() {
    use burn::cubecl::config::{CubeClRuntimeConfig, RuntimeConfig, cache::CacheConfig};
    let mut config = CubeClRuntimeConfig::from_current_dir().override_from_env();
    config.compilation.cache = true;
    if matches!(config.environment.path, CacheConfig::Target) {
        config.environment.path = CacheConfig::Global;
    }
    // If a configuration is already in use, this call fails and the earlier one stays in force.
    CubeClRuntimeConfig::try_set(config);
}

/// Returns every graphics processor that a driver lists, those of the best runtime first.
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
    // A driver that fails while listing its devices offers none.
    let listed = guarded(runtime, || Device::enumerate(kind).into_vec());
    let listed = listed.unwrap_or_default().into_iter().enumerate();
    to.extend(listed.map(|(number, device)| Gpu {
        id: format!("{runtime}:{number}"),
        software: software(&device),
        device,
    }));
}

/// Opens the requested graphics processors, in order.
///
/// # Errors
/// [`ModelError::Invalid`] if there are too few, if none has the requested name, or if the program
/// was built without a runtime; [`ModelError::Gpu`] as for [`Gpu::open`].
pub fn open(wanted: &Gpus) -> Result<Vec<OpenGpu>, ModelError> {
    chosen(wanted)?.iter().map(Gpu::open).collect()
}

/// Returns the names of the requested graphics processors, in order, without opening them.
///
/// # Errors
/// [`ModelError::Invalid`] as for [`open`].
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

/// Selects the requested graphics processors from those listed.
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
            // Each runtime that reaches a card lists it, so only cards of one runtime are counted.
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

/// Runs work in which a driver may panic, and turns a panic's message into an error.
///
/// # Errors
/// [`ModelError::Gpu`] if the work panics.
pub fn guarded<T>(id: &str, work: impl FnOnce() -> T) -> Result<T, ModelError> {
    // The values that a panic leaves half finished are not used again.
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

/// Checks that a device supports the number format in which a network computes.
///
/// # Errors
/// [`ModelError::Invalid`] if the device does not support it.
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

/// Computes a step small enough to take a moment on any device: a product and a convolution, each
/// with the gradients of its inputs.
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

/// Returns the greatest deviation of a probe from another, relative to the greatest value of each
/// part. If it exceeds [`ROUNDED`], returns a description of the deviation instead.
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

    /// Cards that round factors to TF32 must be accepted.
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
