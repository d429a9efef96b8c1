//! One-line assessments of results, compared with trivial answers or with a guess.

use serde::Serialize;
use serde_json::Value;

/// Loss of a held-out ray for a guess: a reconstruction that absorbs half of the light everywhere.
pub const GUESS: f64 = std::f64::consts::LN_2;
/// Distance of peaks from their predicted times, as a share of that from wrong times, above which
/// nothing speaks for the depth of a flash: with few spots, and with many. Right calibrations of 16
/// spots have had up to 0.21, lasers 10 cm off from 0.37 on; right ones of 4 spots up to 0.65.
const MISSED: [f64; 2] = [0.7, 0.33];
/// Number of spots that are many.
const MANY: u64 = 9;

/// One line about a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// Whether a person should check the result before use.
    pub doubtful: bool,
    /// The text of the line.
    pub text: String,
}

impl Verdict {
    fn good(text: String) -> Self {
        Self {
            doubtful: false,
            text,
        }
    }

    fn doubtful(text: String) -> Self {
        Self {
            doubtful: true,
            text,
        }
    }

    /// Assesses the metrics of an evaluation (`mae_m` or `iou`, and `baselines`), for a model that
    /// predicts `kind` (`tof`, `shadow`, `specular`).
    pub fn of_evaluation(kind: &str, metrics: &Value) -> Self {
        let (name, figure) = match kind {
            "tof" => ("mae_m", "depth MAE"),
            _ => ("iou", "IoU"),
        };
        let less_is_better = kind == "tof";
        let Some(own) = metrics[name].as_f64() else {
            return Self::doubtful(format!("no figure: {name} is not a number"));
        };
        let shown = |x: f64| match less_is_better {
            true => format!("{x:.4} m"),
            false => format!("{x:.4}"),
        };
        let trivial = metrics["baselines"].as_object().into_iter().flatten();
        let trivial = trivial.filter_map(|(answer, m)| Some((answer, m[name].as_f64()?)));
        // `min_by` with a reversed comparison returns the first by name among equals, unlike
        // `max_by`.
        let best = trivial.min_by(|a, b| match less_is_better {
            true => a.1.total_cmp(&b.1),
            false => b.1.total_cmp(&a.1),
        });
        let Some((answer, best)) = best else {
            return Self::doubtful(format!(
                "{figure} {}, compared with nothing: no trivial answer was evaluated",
                shown(own)
            ));
        };
        let better = match less_is_better {
            true => own < best,
            false => own > best,
        };
        let answer = answer_name(kind, answer);
        let comparison = format!(
            "{figure} {} against {} of {answer}",
            shown(own),
            shown(best)
        );
        match better {
            true => Self::good(format!("better than every trivial answer: {comparison}")),
            false => Self::doubtful(format!("no better than a trivial answer: {comparison}")),
        }
    }

    /// Assesses the `metrics.json` of a reconstruction.
    pub fn of_reconstruction(metrics: &Value) -> Self {
        let agreement = &metrics["agreement"];
        let reasons = agreement["reasons"].as_array().into_iter().flatten();
        let mut against: Vec<&str> = reasons.filter_map(Value::as_str).collect();
        let peaks = Peaks::of(&metrics["flash"]["residual"], &metrics["spots"]);
        let apart = peaks.and_then(|peaks| peaks.against());
        against.extend(apart.as_deref());
        let loss = metrics["held_out_loss"].as_f64();
        let worse = loss.filter(|loss| *loss > GUESS).map(|loss| {
            format!("held-out loss {loss:.3}, worse than a guess ({GUESS:.3}): its shadows are not explained")
        });
        against.extend(worse.as_deref());
        if !against.is_empty() {
            return Self::doubtful(format!("do not trust it: {}", against.join("; ")));
        }
        let residual = agreement["time_residual_m"].as_f64();
        let mut said = Vec::new();
        said.extend(peaks.map(|peaks| peaks.agreement()));
        said.extend(residual.map(|m| format!("times agree to {m:.4} m")));
        said.extend(loss.map(|loss| format!("held-out loss {loss:.3} (a guess has {GUESS:.3})")));
        match (said.is_empty(), agreement.is_null()) {
            (false, _) => Self::good(said.join(", ")),
            (true, false) => Self::good("its measurements agree".into()),
            (true, true) => Self::doubtful("unknown: an older version made it".into()),
        }
    }

    /// Assesses an imported scene from the check of its files: one entry for all captures, or a
    /// list with one entry per capture.
    pub fn of_import(check: &Value) -> Self {
        let entries = match check {
            Value::Array(entries) => &entries[..],
            one => std::slice::from_ref(one),
        };
        let numbers = |way: &'static str| {
            let all = entries.iter().filter_map(move |e| e.pointer(way));
            all.filter_map(Value::as_f64)
        };
        let light = numbers("/energy_at_prediction").zip(numbers("/energy_around"));
        let light = light.map(|(there, around)| there / around.max(f64::MIN_POSITIVE));
        let light = light.reduce(f64::min).map(|times| {
            format!("light where depth and spots predict it is {times:.1} times that around")
        });
        let paths = numbers("/two_bounce_paths/residual_m").chain(numbers("/spread_m"));
        let paths = paths
            .reduce(f64::max)
            .map(|m| format!("two-bounce paths agree to {m:.4} m"));
        let said: Vec<String> = light.into_iter().chain(paths).collect();
        match said.is_empty() {
            false => Self::good(said.join(", ")),
            true => Self::doubtful("whether its files agree was not checked".into()),
        }
    }

    /// Assesses a calibration from its report.
    pub fn of_calibration(report: &Value) -> Self {
        let word = report["verdict"]
            .as_str()
            .unwrap_or("unknown")
            .replace('_', " ");
        let all = || report["causes"].as_array().into_iter().flatten();
        let said = |corrected: bool| -> Vec<&str> {
            all()
                .filter(|c| c["corrected"] == corrected)
                .filter_map(|c| c["finding"].as_str())
                .collect()
        };
        let mut text = format!("as measured: {word}");
        for (title, found) in [("corrected", said(true)), ("not corrected", said(false))] {
            if !found.is_empty() {
                text += &format!("; {title}: {}", found.join("; "));
            }
        }
        match said(false).is_empty() {
            true => Self::good(text),
            false => Self::doubtful(text),
        }
    }

    /// Assesses the predictions of a scene from the agreement in their manifest. Returns `None` if
    /// nothing could be compared.
    pub fn of_agreement(agreement: &Value) -> Option<Self> {
        let reasons = agreement["reasons"].as_array()?;
        let mut reasons: Vec<&str> = reasons.iter().filter_map(Value::as_str).collect();
        let off = agreement["spots_off_surface_m"].as_f64();
        // Present where depth was computed from the spots, which then agree by construction.
        let computed = agreement.get("peaks");
        let peaks = computed.and_then(|peaks| Peaks::of(peaks, &agreement["spots"]));
        let apart = peaks.and_then(|peaks| peaks.against());
        reasons.extend(apart.as_deref());
        Some(match (&reasons[..], off) {
            ([], _) if let Some(peaks) = peaks => Self::good(peaks.agreement()),
            ([], _) if computed.is_some() => Self::doubtful(
                "unknown: no peak of the histogram stands alone, so that nothing speaks for the depth"
                    .into(),
            ),
            ([], Some(off)) => Self::good(format!("depth and spots agree to {off:.3} m")),
            ([], None) => Self::good("nothing contradicts".into()),
            (reasons, _) => Self::doubtful(format!("do not trust it: {}", reasons.join("; "))),
        })
    }
}

/// The distance of a histogram's peaks from the times that depth predicts, and from wrong times.
#[derive(Debug, Clone, Copy)]
struct Peaks {
    own_m: f64,
    control_m: f64,
    /// The greatest share of the control.
    most: f64,
}

impl Peaks {
    fn of(residual: &Value, spots: &Value) -> Option<Self> {
        let many = spots.as_u64().is_some_and(|spots| spots >= MANY);
        Some(Self {
            own_m: residual["median_m"].as_f64()?,
            control_m: residual["control_m"].as_f64()?,
            most: MISSED[usize::from(many)],
        })
    }

    /// Returns what speaks against the depth, if anything does.
    fn against(self) -> Option<String> {
        let Self {
            own_m,
            control_m,
            most,
        } = self;
        (own_m > most * control_m).then(|| {
            format!(
                "peaks are {own_m:.4} m off the times that the depth predicts, and wrong times {control_m:.4} m: the calibration or \
                 the depth is wrong"
            )
        })
    }

    fn agreement(self) -> String {
        let Self {
            own_m, control_m, ..
        } = self;
        format!("peaks agree to {own_m:.4} m (wrong times have {control_m:.4})")
    }
}

/// Returns a trivial answer's name for display.
fn answer_name<'a>(kind: &str, answer: &'a str) -> &'a str {
    match (kind, answer) {
        ("shadow", "all") => "\"all lit\"",
        ("shadow", "none") => "\"none lit\"",
        ("specular", "all") => "\"mirrors everywhere\"",
        ("specular", "none") => "\"no mirror\"",
        (_, "mean mask") => "the mean mask",
        (_, "constant") => "the best constant depth",
        (_, "peak") => "each histogram's peak",
        (_, "median image") => "the median image",
        (_, other) => other,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_shadow_network_that_loses_to_all_lit_is_doubtful() {
        let metrics = |iou: f64| {
            json!({"iou": iou, "mae": 0.2, "baselines": {
                "all": {"iou": 0.71}, "mean mask": {"iou": 0.69}, "none": {"iou": 0.0},
            }})
        };
        let lost = Verdict::of_evaluation("shadow", &metrics(0.62));
        assert!(lost.doubtful);
        assert_eq!(
            lost.text,
            "no better than a trivial answer: IoU 0.6200 against 0.7100 of \"all lit\""
        );
        let won = Verdict::of_evaluation("shadow", &metrics(0.8));
        assert!(!won.doubtful);
        assert!(
            Verdict::of_evaluation("shadow", &metrics(0.71)).doubtful,
            "a tie is no gain"
        );
    }

    #[test]
    fn depths_are_compared_by_their_error_and_null_is_no_figure() {
        let metrics = json!({"mae_m": 0.3, "baselines": {"constant": {"mae_m": 0.9}, "peak": {"mae_m": 0.25}}});
        let lost = Verdict::of_evaluation("tof", &metrics);
        assert!(
            lost.doubtful && lost.text.contains("0.2500 m of each histogram's peak"),
            "{}",
            lost.text
        );
        let null = Verdict::of_evaluation("tof", &json!({"mae_m": null}));
        assert!(null.doubtful && null.text.contains("mae_m is not a number"));
        assert!(Verdict::of_evaluation("tof", &json!({"mae_m": 0.1})).doubtful);
    }

    #[test]
    fn an_import_states_its_weakest_capture_or_that_nothing_was_checked() {
        let check = json!([
            {"energy_at_prediction": 0.3, "energy_around": 0.1},
            {"energy_at_prediction": 0.2, "energy_around": 0.1, "two_bounce_paths": {"residual_m": 0.01}},
        ]);
        assert_eq!(
            Verdict::of_import(&check).text,
            "light where depth and spots predict it is 2.0 times that around, two-bounce paths agree to 0.0100 m"
        );
        assert!(Verdict::of_import(&Value::Null).doubtful);
    }

    #[test]
    fn a_calibration_is_doubtful_with_a_fault_that_is_not_corrected() {
        let fault = |corrected: bool| json!({"finding": "t0 is off", "corrected": corrected});
        let report = |all: Vec<Value>| json!({"verdict": "cannot_tell", "causes": all});
        let repaired = Verdict::of_calibration(&report(vec![fault(true)]));
        assert_eq!(
            repaired.text,
            "as measured: cannot tell; corrected: t0 is off"
        );
        assert!(!repaired.doubtful);
        let left = Verdict::of_calibration(&report(vec![fault(false)]));
        assert!(left.doubtful && left.text.contains("not corrected: t0 is off"));
    }

    #[test]
    fn depth_that_follows_from_spots_is_compared_with_the_histogram() {
        let verdict = |peaks: Value| {
            let agreement = json!({"reasons": [], "spots_off_surface_m": 0.001, "peaks": peaks});
            Verdict::of_agreement(&agreement).unwrap()
        };
        let good = verdict(json!({"median_m": 0.004, "control_m": 0.05}));
        assert_eq!(
            good.text,
            "peaks agree to 0.0040 m (wrong times have 0.0500)"
        );
        assert!(!good.doubtful);
        let noise = verdict(json!({"median_m": 0.048, "control_m": 0.05}));
        assert!(
            noise.doubtful && noise.text.contains("0.0480 m off"),
            "{}",
            noise.text
        );
        assert!(verdict(Value::Null).doubtful);
        // Networks compute depth from the histogram, not from the spots.
        let network = json!({"reasons": [], "spots_off_surface_m": 0.02});
        assert!(!Verdict::of_agreement(&network).unwrap().doubtful);
    }

    #[test]
    fn a_reconstruction_is_held_against_a_guess_and_its_own_measurements() {
        let good =
            json!({"held_out_loss": 0.11, "agreement": {"time_residual_m": 0.009, "reasons": []}});
        let good = Verdict::of_reconstruction(&good);
        assert_eq!(
            good.text,
            "times agree to 0.0090 m, held-out loss 0.110 (a guess has 0.693)"
        );
        let blobs = json!({"held_out_loss": 1.68, "agreement": {"reasons": ["times are late"]}});
        let blobs = Verdict::of_reconstruction(&blobs);
        assert!(
            blobs.doubtful
                && blobs
                    .text
                    .contains("times are late; held-out loss 1.680, worse than a guess")
        );
        let flash = |off: f64, spots: u32| {
            let metrics = json!({"held_out_loss": 0.2, "agreement": {}, "spots": spots, "flash": {"residual": {"median_m": off, "control_m": 0.09}}});
            Verdict::of_reconstruction(&metrics)
        };
        assert!(!flash(0.01, 16).doubtful);
        // A laser 10 cm off, in an image of 32x32 pixels.
        assert!(flash(0.034, 16).doubtful);
        assert!(
            !flash(0.034, 4).doubtful,
            "few spots have as much by themselves"
        );
        let lost = flash(0.08, 4);
        assert!(
            lost.doubtful && lost.text.contains("0.0800 m off"),
            "{}",
            lost.text
        );
        assert!(Verdict::of_reconstruction(&json!({})).doubtful);
    }
}
