//! When the bins are: gates in metres and picoseconds, and the gate of photon events.

use std::ops::{Range, RangeInclusive};
use std::path::Path;

use picofarm_dataset::Gate;

use super::super::super::ImportError;
use super::{Described, Description, GateText, LIGHT_M_PS};

/// Widths of bins that a capture can have, metres of path, as taking a flash apart has them.
const WIDTH_M: RangeInclusive<f64> = 1e-5..=10.0;

impl Description {
    /// Returns start and width of the bins in metres of path, if the description has them.
    pub(super) fn gate_m(&self, described: &Described) -> Result<Option<[f64; 2]>, ImportError> {
        let g = &self.gate;
        let width = match (g.bin_width_m, g.bin_width_ps) {
            (None, None) => None,
            (Some(m), None) => {
                self.possible("gate.bin_width_m", m, m, described)?;
                Some(m)
            }
            (None, Some(ps)) => {
                self.possible("gate.bin_width_ps", ps, ps * LIGHT_M_PS, described)?;
                Some(ps * LIGHT_M_PS)
            }
            (Some(_), Some(_)) => {
                let what = "bin_width_m or bin_width_ps";
                return Err(described.refused("gate", what, "both"));
            }
        };
        let start = match (g.start_m, g.start_ps, g.t0_ps) {
            (None, None, None) => None,
            (Some(m), None, None) => Some(m),
            (None, start, Some(t0)) => Some((start.unwrap_or(0.0) - t0) * LIGHT_M_PS),
            (None, Some(_), None) => {
                let what =
                    "t0_ps with start_ps: the time at which light without a path would arrive";
                return Err(described.refused("gate.t0_ps", what, "none"));
            }
            (Some(_), ..) => {
                let what = "start_m, or start_ps and t0_ps";
                return Err(described.refused("gate", what, "both"));
            }
        };
        match (start, width) {
            (Some(start), Some(width)) if start.is_finite() && width.is_finite() && width > 0.0 => {
                Ok(Some([start, width]))
            }
            (Some(start), Some(width)) => {
                let found = format!("start {start} m, width {width} m");
                Err(described.refused("gate", "a finite start and a positive width", found))
            }
            (None, None) => Ok(None),
            (Some(_), None) => Err(described.refused(
                "gate.bin_width_m",
                "the width of a bin: bin_width_m, or bin_width_ps",
                "none",
            )),
            (None, Some(_)) => Err(described.refused(
                "gate.start_m",
                "the path at which bin 0 starts: start_m, or t0_ps and, if it is not 0, start_ps",
                "none",
            )),
        }
    }

    /// Refuses a width of bins that no capture has: a value of another unit.
    fn possible(
        &self,
        field: &str,
        given: f64,
        metres: f64,
        described: &Described,
    ) -> Result<(), ImportError> {
        if WIDTH_M.contains(&metres) {
            return Ok(());
        }
        let expected = format!(
            "a width of {} to {} m of path",
            WIDTH_M.start(),
            WIDTH_M.end()
        );
        let picoseconds = field.ends_with("_ps");
        let guess = match () {
            () if !(metres.is_finite() && metres > 0.0) => "",
            () if picoseconds && metres < *WIDTH_M.start() => "; are these nanoseconds?",
            () if picoseconds => "; are these femtoseconds?",
            () if metres > *WIDTH_M.end() => "; are these picoseconds?",
            () => "; are these seconds?",
        };
        let path = match picoseconds {
            true => format!("{given}, which is {metres:.7} m"),
            false => given.to_string(),
        };
        Err(described.refused(field, expected, format!("{path}{guess}")))
    }

    /// Returns the gate into which photon events are binned: start and width in metres, bins.
    pub fn event_gate(
        &self,
        described: &Described,
        unit_ps: f64,
        most: Option<u64>,
    ) -> Result<Gate, ImportError> {
        let with_unit = Self {
            gate: GateText {
                bin_width_ps: match (self.gate.bin_width_m, self.gate.bin_width_ps) {
                    (None, None) => Some(unit_ps),
                    (_, given) => given,
                },
                ..self.gate.clone()
            },
            ..Self::default()
        };
        let Some([start, width]) = with_unit.gate_m(described)? else {
            return Err(described.refused(
                "gate.t0_ps",
                "the time at which light without a path would arrive",
                "none",
            ));
        };
        let (start, bins) = match (self.gate.keep_m, self.gate.bins, most) {
            (Some([from, to]), None, _) if to > from => {
                (from, libm::ceil((to - from) / width - 1e-6))
            }
            (Some(_), ..) => {
                let what = "two increasing paths, without gate.bins";
                let [from, to] = self.gate.keep_m.unwrap_or_default();
                let bins = self
                    .gate
                    .bins
                    .map_or(String::new(), |b| format!(" and {b} bins"));
                let found = format!("{from} to {to}{bins}");
                return Err(described.refused("gate.keep_m", what, found));
            }
            (None, Some(bins), _) => (start, f64::from(bins)),
            (None, None, Some(units)) => (
                start,
                libm::ceil(units as f64 * unit_ps * LIGHT_M_PS / width),
            ),
            (None, None, None) => {
                let what = "the number of bins, or keep_m: the first and the last path";
                return Err(described.refused("gate.bins", what, "none"));
            }
        };
        if !(1.0..=f64::from(1 << 18)).contains(&bins) {
            let what = format!("1 to {} bins", 1 << 18);
            return Err(described.refused("gate", what, bins.to_string()));
        }
        Ok(Gate {
            start_m: start,
            bin_width_m: width,
            bins: bins as u32,
        })
    }

    /// Returns the path in metres of a photon that arrives this many picoseconds after time 0 of
    /// the files.
    pub fn path_m(&self, ps: f64) -> f64 {
        match (self.gate.start_m, self.gate.t0_ps) {
            (Some(start), _) => start + ps * LIGHT_M_PS,
            (None, t0) => (ps - t0.unwrap_or(0.0)) * LIGHT_M_PS,
        }
    }

    /// Returns the bins to keep.
    pub fn kept(&self, gate: &Gate, file: &Path) -> Result<Range<usize>, ImportError> {
        let all = 0..gate.bins as usize;
        let Some([from, to]) = self.gate.keep_m else {
            return Ok(all);
        };
        let bin = |path: f64| {
            let bin = libm::round((path - gate.start_m) / gate.bin_width_m);
            bin.clamp(0.0, f64::from(gate.bins)) as usize
        };
        let kept = bin(from)..bin(to);
        if kept.is_empty() {
            return Err(ImportError::refused(
                file,
                "gate.keep_m",
                format!(
                    "two increasing paths within {:.4} to {:.4} m, the files' gate",
                    gate.start_m,
                    gate.end_m()
                ),
                format!("{from} to {to}"),
                "correct the description: paths count from laser to camera",
            ));
        }
        Ok(kept)
    }
}
