//! The result of a check: causes with figures, a verdict, residuals.

use serde::{Deserialize, Serialize};

use crate::Pulse;

/// How far a capture can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing was found.
    Good,
    /// Results lose accuracy.
    Usable,
    /// The capture does not show whether its calibration is right.
    CannotTell,
    /// Results are wrong.
    Wrong,
}

impl Verdict {
    /// Returns its word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Usable => "usable",
            Self::CannotTell => "cannot tell",
            Self::Wrong => "wrong",
        }
    }
}

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// The image is mirrored, turned or transposed.
    Image,
    /// Histograms belong to other spots than stated.
    SpotOrder,
    /// Bin widths are a factor off.
    TimeScale,
    /// Bin widths are off by a few per cent.
    BinWidth,
    /// Time zero is off.
    TimeZero,
    /// The laser is elsewhere.
    Laser,
    /// The field of view is another.
    FieldOfView,
    /// A spot is elsewhere.
    Spot,
    /// Masks belong to other spots than stated.
    MaskOrder,
    /// Pixels without counts.
    DeadPixels,
    /// Pixels with many counts and no light.
    HotPixels,
    /// Counts at a ceiling.
    Clipped,
    /// Early photons hide late ones.
    PileUp,
    /// Ambient light and dark counts.
    Background,
    /// No return of one bounce is in the histograms.
    NoReturns,
    /// Times agree with no calibration that was tried.
    Unexplained,
    /// Too little light from too few places to judge the calibration.
    Evidence,
    /// Two spots have the same histograms.
    EqualHistograms,
    /// The stated view or principal point is unusual.
    Camera,
    /// Stated spots cannot be seen, or their light cannot be in the gate.
    Spots,
}

/// A fault that was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cause {
    /// The kind of fault.
    pub fault: Fault,
    /// What the fault alone makes of the capture.
    pub severity: Verdict,
    /// What was found, in one sentence with its figure.
    pub finding: String,
    /// Its size.
    pub value: f64,
    /// Standard error of the size; 0 where it is exact or unknown.
    pub error: f64,
    /// Unit of the size, e.g. `m`, `bins`, `pixels`.
    pub unit: String,
    /// What to do, in one sentence.
    pub advice: String,
    /// Whether the corrected calibration repairs it.
    pub corrected: bool,
}

/// What a capture can show, whatever its calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Pixels with two-bounce times of two spots and more.
    pub pixels: usize,
    /// Times beyond the first of each pixel: those that can contradict a calibration.
    pub times: usize,
    /// Median standard error of a time, bins; `None` without times.
    pub error_bins: Option<f64>,
    /// Median difference of times of neighbouring pixels, over that of pixels far apart: 1 for
    /// noise. `None` with few times.
    pub neighbours: Option<f64>,
}

/// Agreement of times with a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Agreement {
    /// Share of the two-bounce times within one bin of the prediction. Shadows and mirrors keep it
    /// below 1.
    pub share: f64,
    /// Root mean square of their distances from the prediction, metres of path.
    pub rms_m: f64,
}

/// One spot after the correction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SpotResidual {
    /// Median of prediction minus observation of two-bounce times, metres of path; `None` without
    /// times.
    pub median_m: Option<f64>,
    /// Root mean square of the times within one bin, metres of path.
    pub rms_m: f64,
    /// Two-bounce times within one bin.
    pub times: usize,
    /// Prediction minus observation of the one-bounce return, metres of path.
    pub return_m: Option<f64>,
}

/// The estimated pulse.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PulseFound {
    /// Its shape. Times refer to its peak.
    pub shape: Pulse,
    /// Full width at half maximum, picoseconds.
    pub fwhm_ps: f64,
}

/// The result of a check.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The worst of the causes' severities.
    pub verdict: Verdict,
    /// The faults that were found, the worst first.
    pub causes: Vec<Cause>,
    /// Corrections that came nearest, if none explains the times. Nothing confirms them.
    pub guesses: Vec<Cause>,
    /// What cannot be seen in this capture.
    pub notes: Vec<String>,
    /// What the capture can show.
    pub evidence: Evidence,
    /// Agreement with the stated calibration.
    pub stated: Option<Agreement>,
    /// Agreement with the corrected calibration.
    pub corrected: Option<Agreement>,
    /// Of a capture of all spots at once: distance of peaks from the times that the stated
    /// calibration predicts, over that from shifted times.
    pub unclear: Option<f64>,
    /// Standard errors of t0 (metres of path) and of the laser's x, y, z (camera's frame, metres).
    pub errors: Option<[f64; 4]>,
    /// The pulse, if returns show it.
    pub pulse: Option<PulseFound>,
    /// Background of the median pixel in the histogram of all spots, counts per bin; `None` if the
    /// gate begins with light.
    pub background: Option<f64>,
    /// Residuals of each spot with the corrected calibration.
    pub spots: Vec<SpotResidual>,
}

impl Report {
    /// Returns whether no correction can be trusted: the stated geometry is impossible, no
    /// calibration that was tried explains the times, or the capture cannot show which does.
    pub fn unexplained(&self) -> bool {
        self.causes.iter().any(|c| match c.fault {
            Fault::Unexplained | Fault::Evidence | Fault::EqualHistograms => true,
            Fault::Spots | Fault::Camera => c.severity >= Verdict::CannotTell,
            _ => false,
        })
    }
}
