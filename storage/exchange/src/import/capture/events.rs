//! Photon events, binned into histograms as they are read.

use std::path::Path;

use picofarm_dataset::Gate;

use super::super::ImportError;
use super::arrays::{Part, Stated};
use super::describe::{Described, Description};

/// Most bins of all pixels and spots.
const MOST: usize = 1 << 32;

/// Histograms that photons are added to.
pub(super) struct Binner {
    gate: Gate,
    spots: usize,
    rows: usize,
    columns: usize,
    counts: Vec<u32>,
    photons: u64,
    /// Photons outside the gate.
    outside: u64,
    /// Photons of no pixel or spot: between lines, or beyond the image.
    stray: u64,
}

impl Binner {
    /// Returns empty histograms.
    ///
    /// # Errors
    /// The description lacks `pixels`, or asks for more bins than fit.
    pub fn new(
        file: &Path,
        pixels: Option<[u32; 2]>,
        spots: usize,
        gate: Gate,
        described: &Described,
    ) -> Result<Self, ImportError> {
        let Some([rows, columns]) = pixels.filter(|p| !p.contains(&0)) else {
            let what = "[rows, columns]: photon events do not say the size of the image";
            return Err(described.refused("pixels", what, format!("{pixels:?}")));
        };
        let (rows, columns) = (rows as usize, columns as usize);
        let count = [spots, rows, columns, gate.bins as usize]
            .iter()
            .try_fold(1usize, |n, side| n.checked_mul(*side))
            .filter(|n| *n <= MOST);
        let Some(count) = count else {
            return Err(ImportError::refused(
                file,
                "pixels, gate",
                format!("at most {MOST} bins of all pixels and spots"),
                format!("{spots} x {rows} x {columns} x {}", gate.bins),
                "choose fewer, wider bins, or keep a part of the gate (gate.keep_m)",
            ));
        };
        Ok(Self {
            gate,
            spots,
            rows,
            columns,
            counts: vec![0; count],
            photons: 0,
            outside: 0,
            stray: 0,
        })
    }

    /// Rows and columns.
    pub fn image(&self) -> [usize; 2] {
        [self.rows, self.columns]
    }

    /// Adds a photon; without a place it is counted as stray.
    pub fn add(&mut self, place: Option<(usize, usize, usize)>, path_m: f64) {
        self.photons += 1;
        let inside = |&(s, r, c): &(usize, usize, usize)| {
            s < self.spots && r < self.rows && c < self.columns
        };
        let Some((spot, row, column)) = place.filter(inside) else {
            self.stray += 1;
            return;
        };
        let Some(bin) = self.gate.bin(path_m) else {
            self.outside += 1;
            return;
        };
        let pixel = (spot * self.rows + row) * self.columns + column;
        self.counts[pixel * self.gate.bins as usize + bin as usize] += 1;
    }

    /// Returns the histograms.
    ///
    /// # Errors
    /// No photon fell into them.
    pub fn finish(
        self,
        file: &Path,
        format: &str,
        apart: bool,
        mut notes: Vec<String>,
    ) -> Result<Part, ImportError> {
        let inside = self.photons - self.outside - self.stray;
        if inside == 0 {
            return Err(ImportError::refused(
                file,
                "events",
                format!(
                    "photons in the gate from {:.4} to {:.4} m of path",
                    self.gate.start_m,
                    self.gate.end_m()
                ),
                format!(
                    "{} photons: {} outside the gate, {} of no pixel or spot",
                    self.photons, self.outside, self.stray
                ),
                "check gate (t0_ps), pixels and the columns or markers in the description",
            ));
        }
        notes.push(format!(
            "{} photons: {inside} binned, {} outside the gate, {} of no pixel or spot",
            self.photons, self.outside, self.stray
        ));
        Ok(Part {
            file: file.to_owned(),
            format: format.into(),
            dims: [self.spots, self.rows, self.columns, self.gate.bins as usize],
            apart,
            values: self.counts.into_iter().map(|n| n as f32).collect(),
            stated: Stated {
                gate: Some([self.gate.start_m, self.gate.bin_width_m]),
                ..Stated::default()
            },
            notes,
            outside: (self.outside + self.stray) as f64,
            binned: true,
        })
    }
}

/// An event of a scan.
#[derive(Debug, Clone, Copy)]
pub(super) enum Event {
    /// A photon after `ps` picoseconds.
    Photon {
        ps: f64,
    },
    LineStart,
    LineStop,
    /// A new frame begins: the next line is the first.
    Frame,
}

/// Places photons by the markers of lines and frames. A line's photons are spread over its columns
/// in proportion to the time between its start and its end.
#[derive(Default)]
pub(super) struct Lines {
    line: usize,
    /// Clock at the start of the line, and the photons since.
    open: Option<(u64, Vec<(u64, f64)>)>,
    lines: usize,
}

impl Lines {
    /// Takes the next event, at this clock.
    pub fn take(
        &mut self,
        event: Event,
        clock: u64,
        spot: usize,
        binner: &mut Binner,
        description: &Description,
    ) {
        match (event, &mut self.open) {
            (Event::Photon { ps }, Some((_, photons))) => photons.push((clock, ps)),
            (Event::Photon { ps }, None) => binner.add(None, description.path_m(ps)),
            (Event::LineStart, _) => {
                self.abandon(binner, description);
                self.open = Some((clock, Vec::new()));
            }
            (Event::LineStop, _) => {
                let Some((start, photons)) = self.open.take() else {
                    return;
                };
                let [rows, columns] = binner.image();
                let span = clock.saturating_sub(start).max(1);
                for (at, ps) in photons {
                    let column =
                        (u128::from(at - start) * columns as u128 / u128::from(span)) as usize;
                    let place = Some((spot, self.line % rows, column.min(columns - 1)));
                    binner.add(place, description.path_m(ps));
                }
                self.line += 1;
                self.lines += 1;
            }
            (Event::Frame, _) => {
                self.abandon(binner, description);
                self.line = 0;
            }
        }
    }

    /// Counts the photons of a line without an end, and returns the number of whole lines.
    pub fn end(mut self, binner: &mut Binner, description: &Description) -> usize {
        self.abandon(binner, description);
        self.lines
    }

    fn abandon(&mut self, binner: &mut Binner, description: &Description) {
        for (_, ps) in self.open.take().into_iter().flat_map(|o| o.1) {
            binner.add(None, description.path_m(ps));
        }
    }
}
