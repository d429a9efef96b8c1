//! Statistics of a data set.

use futures::future::BoxFuture;
use futures::{FutureExt, StreamExt, TryStreamExt, stream};

use crate::layout::manifest::Manifest;
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::Dataset;
use picofarm_store::StorageError;

/// Number of concurrent requests.
const CONCURRENCY: usize = 16;

/// Statistics of a data set.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Its properties; `spec.scenes` is its capacity.
    pub spec: DatasetSpec,
    /// Number of published scenes.
    pub scenes: u64,
    /// Total size of their objects in bytes.
    pub bytes: u64,
    /// Largest coding error of any bin of any scene, in σ.
    pub max_sigma: f64,
    /// Smallest and largest root-mean-square coding error of a scene, in σ; `None` if nothing is
    /// published.
    pub rms_sigma: Option<(f64, f64)>,
    /// Number of saturated bins in overflow lists.
    pub overflow: u64,
    /// Median over the scenes of the Monte Carlo error stated by the renderer
    /// (`error.median_relative` in the provenance's plan: median over pixels of standard error /
    /// h); `None` if no scene states one.
    pub noise: Option<f64>,
    /// Mean over the scenes of the number of rays traced by the renderer (`rays` in the
    /// provenance's plan), which determines the rendering time; `None` if no scene states it.
    pub rays: Option<f64>,
}

impl Dataset {
    /// Computes the statistics of the data set from its manifests.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] names an unusable manifest; [`StorageError::Store`].
    pub async fn info(&self) -> Result<Summary, StorageError> {
        let scenes = self.scenes_present().await?;
        let mut summary = Summary {
            spec: self.spec,
            scenes: scenes.len() as u64,
            bytes: 0,
            max_sigma: 0.0,
            rms_sigma: None,
            overflow: 0,
            noise: None,
            rays: None,
        };
        let (mut noise, mut rays) = (Vec::new(), Vec::new());
        let read = |scene: u64| -> BoxFuture<'_, Result<Manifest, StorageError>> {
            self.manifest(scene).boxed()
        };
        let mut manifests =
            stream::iter(scenes.into_iter().map(read)).buffer_unordered(CONCURRENCY);
        while let Some(manifest) = manifests.try_next().await? {
            summary.bytes += manifest.total_bytes();
            summary.overflow += manifest.overflow.len() as u64;
            summary.max_sigma = summary.max_sigma.max(manifest.error.max_sigma);
            for subset in manifest.subsets.values() {
                summary.overflow += subset.overflow.len() as u64;
                summary.max_sigma = summary.max_sigma.max(subset.error.max_sigma);
            }
            noise.extend(manifest.provenance.plan["error"]["median_relative"].as_f64());
            rays.extend(manifest.provenance.plan["rays"].as_u64());
            let rms = manifest.error.rms_sigma;
            let (low, high) = summary.rms_sigma.unwrap_or((rms, rms));
            summary.rms_sigma = Some((low.min(rms), high.max(rms)));
        }
        noise.sort_by(f64::total_cmp);
        summary.noise = noise.get(noise.len() / 2).copied();
        let mean = |rays: &[u64]| rays.iter().sum::<u64>() as f64 / rays.len() as f64;
        summary.rays = Some(mean(&rays)).filter(|rays| rays.is_finite());
        Ok(summary)
    }
}
