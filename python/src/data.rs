//! Data sets: scenes decoded into arrays.

use std::{
    future::Future,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
};

use numpy::{Element, IntoPyArray, PyArrayDyn, PyArrayMethods, PyReadwriteArray3};
use picofarm_dataset::{Dataset as Stored, Element as Type, Quantity};
use picofarm_store::{Cache, StorageError};
use pyo3::{exceptions::PyRuntimeError, prelude::*, types::PyBytes};

use crate::errors::{self, argument};

/// A published data set. Each process opens its own connection, so that objects survive a fork.
#[pyclass(frozen, module = "picofarm._native")]
pub(crate) struct Dataset {
    url: String,
    threads: usize,
    cache: Option<(PathBuf, u64)>,
    opened: Mutex<Arc<Opened>>,
}

/// A data set with the threads that read it, which exist in one process only.
struct Opened {
    process: u32,
    data: Stored,
    cache: Option<Cache>,
    runtime: tokio::runtime::Runtime,
    pool: rayon::ThreadPool,
}

impl Opened {
    fn new(url: &str, threads: usize, cache: Option<&(PathBuf, u64)>) -> PyResult<Self> {
        let failed = |e: &dyn std::fmt::Display| {
            PyRuntimeError::new_err(format!("cannot start {threads} threads: {e}"))
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.map_err(|e| failed(&e))?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|e| failed(&e))?;
        let data = runtime.block_on(async {
            let (store, prefix) = picofarm_store::open_store(url)?;
            Stored::open(store, prefix).await
        });
        let mut data = data.map_err(errors::store)?;
        let cache = cache.map(|(folder, most)| Cache::open(folder, *most));
        let cache = cache.transpose().map_err(errors::store)?;
        if let Some(cache) = &cache {
            data = data.with_cache(cache.clone());
        }
        Ok(Self {
            process: std::process::id(),
            data,
            cache,
            runtime,
            pool,
        })
    }

    fn wait<T: Send>(
        &self,
        work: impl Future<Output = Result<T, StorageError>> + Send,
    ) -> PyResult<T> {
        self.pool
            .install(|| self.runtime.block_on(work))
            .map_err(errors::store)
    }
}

impl Dataset {
    /// Returns the data set of this process.
    fn opened(&self) -> PyResult<Arc<Opened>> {
        let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
        if opened.process != std::process::id() {
            let inherited = std::mem::replace(
                &mut *opened,
                Arc::new(Opened::new(&self.url, self.threads, self.cache.as_ref())?),
            );
            // Its threads do not exist in this process, so ending it would wait forever.
            std::mem::forget(inherited);
        }
        Ok(opened.clone())
    }
}

#[pymethods]
impl Dataset {
    #[new]
    fn new(
        py: Python<'_>,
        url: String,
        threads: Option<usize>,
        cache: Option<(PathBuf, u64)>,
    ) -> PyResult<Self> {
        picofarm_cli::provide_cryptography();
        let threads = threads.unwrap_or_else(picofarm_tasks::cores);
        if !(1..=4096).contains(&threads) {
            return Err(argument(
                "threads",
                format!("expected 1 to 4096, found {threads}"),
            ));
        }
        let opened = py.detach(|| Opened::new(&url, threads, cache.as_ref()))?;
        Ok(Self {
            url,
            threads,
            cache,
            opened: Mutex::new(Arc::new(opened)),
        })
    }

    /// Facts of the data set as JSON.
    fn facts(&self) -> PyResult<String> {
        let opened = self.opened()?;
        let spec = opened.data.spec();
        let arrays: Vec<&str> = opened
            .data
            .arrays()
            .iter()
            .map(|a| a.layout.quantity.name())
            .collect();
        Ok(serde_json::json!({"spec": spec, "arrays": arrays}).to_string())
    }

    /// The first error of writing to the cache since the last call.
    fn cache_trouble(&self) -> PyResult<Option<String>> {
        Ok(self.opened()?.cache.as_ref().and_then(Cache::trouble))
    }

    /// Indices of the published scenes, ascending.
    fn scenes(&self, py: Python<'_>) -> PyResult<Vec<u64>> {
        py.detach(|| {
            let opened = self.opened()?;
            opened.wait(opened.data.scenes_present())
        })
    }

    /// The newest or the given version of a split, and its JSON.
    fn split<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        version: Option<u64>,
    ) -> PyResult<(u64, Bound<'py, PyBytes>)> {
        let (version, bytes) = py.detach(|| {
            let opened = self.opened()?;
            let version = match version {
                Some(version) => version,
                None => {
                    let versions = opened.wait(opened.data.split_versions(name))?;
                    versions.last().copied().ok_or_else(|| {
                        let what = format!(
                            "{}: there is no split {name:?}; picofarm dataset split makes one",
                            self.url
                        );
                        argument("split_name", what)
                    })?
                }
            };
            let bytes = opened.wait(opened.data.read_split(name, version))?;
            Ok::<_, PyErr>((version, bytes))
        })?;
        Ok((version, PyBytes::new(py, &bytes)))
    }

    /// A scene's manifest as JSON.
    fn manifest(&self, py: Python<'_>, scene: u64) -> PyResult<String> {
        let manifest = py.detach(|| {
            let opened = self.opened()?;
            opened.wait(opened.data.manifest(scene))
        })?;
        serde_json::to_string(&manifest)
            .map_err(|e| PyRuntimeError::new_err(format!("a manifest cannot be written: {e}")))
    }

    /// Reads a part of a histogram of a scene into `target`, float32 `[bin, row, column]`. The
    /// ranges are (first, end) of rows, columns and bins.
    fn read_bins(
        &self,
        py: Python<'_>,
        scene: u64,
        array: &str,
        ranges: [(u32, u32); 3],
        mut target: PyReadwriteArray3<'_, f32>,
    ) -> PyResult<()> {
        let opened = self.opened()?;
        let quantity = quantity(&opened.data, array)?;
        let ranges = ranges.map(|(first, end)| first..end);
        let target = target
            .as_slice_mut()
            .map_err(|_| argument("target", "expected contiguous memory"))?;
        let read = opened
            .data
            .read_planes_part(scene, quantity, ranges, target);
        py.detach(|| opened.wait(read))
    }

    /// Reads an array of a scene.
    fn read<'py>(&self, py: Python<'py>, scene: u64, array: &str) -> PyResult<Bound<'py, PyAny>> {
        let opened = self.opened()?;
        let data = &opened.data;
        let quantity = quantity(data, array)?;
        let spec = data.spec();
        let (h, w, bins) = (
            spec.height as usize,
            spec.width as usize,
            spec.gate.bins as usize,
        );
        if quantity == Quantity::Visibility {
            let lit = py.detach(|| opened.wait(data.read_visibility(scene)))?;
            return shaped(py, lit, &[spec.spots as usize, h, w]);
        }
        if quantity.is_transient() {
            let values = py.detach(|| opened.wait(data.read_histogram(scene, quantity)))?;
            let planes = values.len() / (h * w * bins);
            return match planes {
                1 => shaped(py, values, &[h, w, bins]),
                n => shaped(py, values, &[n, h, w, bins]),
            };
        }
        match data.array(quantity).layout.element {
            Type::F32 => plain::<f32>(py, &opened, scene, quantity),
            Type::U8 => plain::<u8>(py, &opened, scene, quantity),
            Type::U16 => plain::<u16>(py, &opened, scene, quantity),
            Type::I16 => plain::<i16>(py, &opened, scene, quantity),
            Type::U32 => plain::<u32>(py, &opened, scene, quantity),
        }
    }
}

/// Returns the quantity of an array by its name.
fn quantity(data: &Stored, array: &str) -> PyResult<Quantity> {
    let quantities = data.arrays().iter().map(|a| a.layout.quantity);
    let found = quantities.clone().find(|q| q.name() == array);
    found.ok_or_else(|| {
        let known: Vec<&str> = quantities.map(|q| q.name()).collect();
        let what = format!("the data set has no {array:?}, but {}", known.join(", "));
        argument("arrays", what)
    })
}

/// Reads stored values in the shape that the quantity has.
fn plain<'py, T: picofarm_dataset::Stored + Element>(
    py: Python<'py>,
    opened: &Opened,
    scene: u64,
    quantity: Quantity,
) -> PyResult<Bound<'py, PyAny>> {
    let values = py.detach(|| opened.wait(opened.data.read::<T>(scene, quantity)))?;
    let layout = &opened.data.array(quantity).layout;
    let shape: Vec<usize> = layout.shape.iter().map(|n| *n as usize).collect();
    shaped(py, values, &shape)
}

fn shaped<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    let array: Bound<'py, PyArrayDyn<T>> = values.into_pyarray(py).reshape(shape.to_vec())?;
    Ok(array.into_any())
}
