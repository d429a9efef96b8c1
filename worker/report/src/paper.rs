//! The metrics that Shoot-Bounce-3D published, by experiment.

use serde::Serialize;

use super::Entry;
use picofarm_model::{
    input::{DEPTH_SCALE_M, ShadowVariant, Target},
    net::Architecture,
};

/// Published metrics of an experiment; `None` if a metric was not published.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Published {
    /// The name of the experiment.
    pub experiment: &'static str,
    /// The mean absolute error: of depth in metres, of masks as a share.
    pub mae: Option<f64>,
    /// The intersection over union of masks.
    pub iou: Option<f64>,
}

impl Published {
    /// Returns a loss (less is better): MAE of depth, or 1 − IoU.
    pub(super) fn loss(&self) -> Option<f64> {
        self.iou.map_or(self.mae, |iou| Some(1.0 - iou))
    }
}

/// The note shown with published metrics.
pub(super) const NOTE: &str = "Published figures are from Shoot-Bounce-3D. They are shown next to experiments of the same size: 25 spots, \
    rooms of 256 × 256 pixels and 637 bins, 87,688 training scenes, networks of width 128 and 6 levels. Other experiments are \
    compared only by order. A data set records the number of spots, not their directions, so random spots count as the paper's \
    grid.";

/// The settings of the paper.
const SPOTS: u32 = 25;
const IMAGES: [u32; 2] = [256, 256];
const BINS: usize = 637;
const SCENES: u64 = 87_688;
const NET: [usize; 2] = [128, 6];

/// Returns the settings in which a model differs from the published experiments; empty if no
/// difference is known.
pub fn unlike(entry: &Entry) -> Vec<String> {
    let (data, question, net) = (&entry.data, &entry.plan.question, &entry.plan.net);
    let mut differs = Vec::new();
    let mut compare = |same: bool, what: String| {
        if !same {
            differs.push(what);
        }
    };
    let unknown = |what: &str| format!("{what} not known");
    let spots = data
        .spots
        .map_or_else(|| unknown("spots"), |n| format!("{n} spots"));
    compare(data.spots == Some(SPOTS), spots);
    let pixels = |[rows, columns]: [u32; 2]| format!("{columns} × {rows} pixels");
    let images = data.images.map_or_else(|| unknown("images"), pixels);
    compare(data.images == Some(IMAGES), images);
    let bins = question.intensity_only || question.bins == BINS;
    compare(bins, format!("{} bins", question.bins));
    let scenes = data
        .scenes
        .map_or_else(|| unknown("scenes"), |n| format!("{n} scenes"));
    compare(data.scenes == Some(SCENES), scenes);
    let of_rooms = question.target != Target::Tof || question.depth_scale_m == DEPTH_SCALE_M;
    compare(
        of_rooms,
        format!("depths over {} m", question.depth_scale_m),
    );
    let size = format!("width {}, {} levels", net.width, net.levels);
    compare([net.width, net.levels] == NET, size);
    differs
}

/// Returns the published metrics of the experiment that a model repeats, if it is one of the
/// paper's. [`unlike`] compares its size with the paper's.
pub fn published(entry: &Entry) -> Option<Published> {
    let question = &entry.plan.question;
    if entry.plan.net.architecture != Architecture::Unet2d || entry.data.noise {
        return None;
    }
    let two = match entry.data.max_bounces {
        0 => false,
        2 => true,
        _ => return None,
    };
    let concat = question.variant == ShadowVariant::Concat;
    let (experiment, mae, iou) = match (question.target, question.intensity_only, two) {
        (_, true, true) => return None,
        (Target::Tof, true, _) => ("A.3 intensity only", Some(0.174), None),
        (Target::Specular, true, _) => ("A.3 intensity only", None, Some(0.703)),
        (Target::Shadow, true, _) => ("A.3 intensity only", None, Some(0.700)),
        (Target::Tof, _, true) => ("A.4 two bounces only", Some(0.0255), None),
        (Target::Tof, ..) => ("all bounces", Some(0.0228), None),
        (Target::Specular, _, true) => ("A.4 two bounces only", None, Some(0.767)),
        (Target::Specular, ..) => ("all bounces", None, Some(0.865)),
        (Target::Shadow, _, true) if concat => ("A.4 two bounces only", None, Some(0.964)),
        (Target::Shadow, _, true) => return None,
        (Target::Shadow, ..) => match question.variant {
            ShadowVariant::Concat => ("A.1 concat (A.4: IoU 0.954)", Some(0.0186), Some(0.959)),
            ShadowVariant::Difference => ("A.1 difference", Some(0.0231), Some(0.950)),
            ShadowVariant::Index => ("A.1 index", Some(0.0896), Some(0.799)),
            ShadowVariant::All => ("A.1 all at once", Some(0.0984), Some(0.788)),
            ShadowVariant::Evidence => return None,
        },
    };
    Some(Published {
        experiment,
        mae,
        iou,
    })
}
