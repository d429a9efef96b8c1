//! PicoQuant's unified TTTR files (`.ptu`) in T3 mode: a header of tags, and records of 32 bits.
//!
//! Sources: PicoQuant, "Unified TTTR File Format" and the record layouts of its public
//! demonstration code (PicoQuant-Time-Tagged-File-Format-Demos). Lines and frames are found by the
//! markers that the tags `ImgHdr_…` name; without them, each channel of the detector is a pixel.

use std::collections::BTreeMap;
use std::path::Path;

use super::super::ImportError;
use super::super::files::Files;
use super::arrays::Part;
use super::describe::{Described, Description};
use super::events::{Binner, Event, Lines};

/// The first bytes of a file.
pub(super) const MAGIC: &[u8] = b"PQTTTR\0\0";
const HINT: &str =
    "record in T3 mode and save with PicoQuant's software, or export the events as a table (.csv)";

/// The value of a tag.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Tag {
    Whole(i64),
    Real(f64),
    Other,
}

/// The layouts of T3 records.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Layout {
    PicoHarp,
    HydraHarp1,
    /// HydraHarp 2, TimeHarp 260, MultiHarp.
    HydraHarp2,
}

/// One record.
enum Record {
    /// The clock goes on by this many sync periods.
    Overflow(u64),
    Photon {
        sync: u64,
        channel: u32,
        time: u32,
    },
    Marker {
        sync: u64,
        bits: u32,
    },
}

impl Layout {
    fn of_type(code: i64) -> Option<Self> {
        match code {
            0x0001_0303 => Some(Self::PicoHarp),
            0x0001_0304 => Some(Self::HydraHarp1),
            0x0101_0304 | 0x0001_0305 | 0x0001_0306 | 0x0001_0307 => Some(Self::HydraHarp2),
            _ => None,
        }
    }

    fn record(self, raw: u32) -> Record {
        if self == Self::PicoHarp {
            let (sync, time, channel) = (u64::from(raw & 0xffff), raw >> 16 & 0xfff, raw >> 28);
            return match (channel, time) {
                (15, 0) => Record::Overflow(1 << 16),
                (15, bits) => Record::Marker {
                    sync,
                    bits: bits & 15,
                },
                (channel, time) => Record::Photon {
                    sync,
                    channel,
                    time,
                },
            };
        }
        let (sync, time) = (u64::from(raw & 0x3ff), raw >> 10 & 0x7fff);
        let (channel, special) = (raw >> 25 & 0x3f, raw >> 31 == 1);
        match (special, channel, self) {
            (true, 63, Self::HydraHarp2) => Record::Overflow(1024 * sync.max(1)),
            (true, 63, _) => Record::Overflow(1024),
            (true, bits, _) => Record::Marker { sync, bits },
            (false, channel, _) => Record::Photon {
                sync,
                channel,
                time,
            },
        }
    }
}

/// Reads a file.
pub(super) fn read(
    file: &Path,
    description: &Description,
    described: &Described,
    reader: &Files,
) -> Result<Part, ImportError> {
    let bytes = reader.bytes(file)?;
    let (tags, end) = header(&bytes).map_err(|e| ImportError::unreadable(file, e, HINT))?;
    let whole = |name: &str| match tags.get(name) {
        Some(Tag::Whole(n)) => Some(*n),
        _ => None,
    };
    let real = |name: &str| match tags.get(name) {
        Some(Tag::Real(x)) if x.is_finite() && *x > 0.0 => Some(*x),
        _ => None,
    };
    let absent = |tag: &str| ImportError::unreadable(file, format!("has no tag {tag}"), HINT);
    let code =
        whole("TTResultFormat_TTTRRecType").ok_or_else(|| absent("TTResultFormat_TTTRRecType"))?;
    let Some(layout) = Layout::of_type(code) else {
        let what =
            format!("has records of type {code:#010x}, which is no T3 type this program knows");
        return Err(ImportError::unreadable(file, what, HINT));
    };
    let resolution = real("MeasDesc_Resolution").ok_or_else(|| absent("MeasDesc_Resolution"))?;
    let unit_ps = resolution * 1e12;
    let period = real("MeasDesc_GlobalResolution");
    let most = period
        .map(|p| libm::ceil(p / resolution - 1e-6) as u64)
        .filter(|n| *n > 1);
    let gate = description.event_gate(described, unit_ps, most)?;
    let bit = |name: &str| {
        whole(name)
            .filter(|n| (1..=4).contains(n))
            .map(|n| 1u32 << (n - 1))
    };
    let [start, stop, frame] = ["ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame"].map(bit);
    let scanned = start.zip(stop);
    if whole("ImgHdr_BiDirect").is_some_and(|b| b != 0) {
        let what = "was scanned in both directions, so every other line would have to be turned and shifted";
        return Err(ImportError::unreadable(file, what, "scan in one direction"));
    }
    let side = |name: &str| {
        whole(name)
            .and_then(|n| u32::try_from(n).ok())
            .filter(|n| *n > 0)
    };
    let stated = side("ImgHdr_PixY").zip(side("ImgHdr_PixX"));
    let pixels = description
        .pixels
        .or(stated.filter(|_| scanned.is_some()).map(|(r, c)| [r, c]));
    let mut binner = Binner::new(file, pixels, 1, gate, described)?;
    let (mut lines, mut clock) = (Lines::default(), 0u64);
    let width = binner.image()[1];
    for raw in bytes[end..].chunks_exact(4) {
        let raw = u32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]]);
        match layout.record(raw) {
            Record::Overflow(periods) => clock += periods,
            Record::Marker { sync, bits } => {
                let is = |of: Option<u32>| of.is_some_and(|of| bits & of != 0);
                // A line that ends with a frame is whole.
                for (event, happens) in [
                    (Event::LineStop, is(stop) && start != stop),
                    (Event::Frame, is(frame)),
                    (Event::LineStart, is(start)),
                ] {
                    if happens {
                        lines.take(event, clock + sync, 0, &mut binner, description);
                    }
                }
            }
            Record::Photon {
                sync,
                channel,
                time,
            } => {
                // A photon is counted at the middle of its channel.
                let ps = (f64::from(time) + 0.5) * unit_ps;
                match scanned {
                    Some(_) => lines.take(
                        Event::Photon { ps },
                        clock + sync,
                        0,
                        &mut binner,
                        description,
                    ),
                    None => {
                        let pixel = channel as usize;
                        binner.add(
                            Some((0, pixel / width, pixel % width)),
                            description.path_m(ps),
                        );
                    }
                }
            }
        }
    }
    let whole_lines = lines.end(&mut binner, description);
    let note = match scanned {
        Some(_) => format!("{whole_lines} lines of the scan; bins of the file have {unit_ps} ps"),
        None => format!("each channel is a pixel; bins of the file have {unit_ps} ps"),
    };
    binner.finish(file, "ptu", false, vec![note])
}

/// Returns the tags, and where the records begin.
fn header(bytes: &[u8]) -> Result<(BTreeMap<String, Tag>, usize), String> {
    const CUT: &str = "its header is cut off";
    let mut at = MAGIC.len() + 8;
    let mut tags = BTreeMap::new();
    loop {
        let tag = bytes.get(at..at + 48).ok_or(CUT)?;
        let name: Vec<u8> = tag[..32].iter().copied().take_while(|b| *b != 0).collect();
        let name = String::from_utf8_lossy(&name).into_owned();
        let kind = u32::from_le_bytes([tag[36], tag[37], tag[38], tag[39]]);
        let raw: [u8; 8] = tag[40..48].try_into().expect("eight bytes");
        at += 48;
        if name == "Header_End" {
            return Ok((tags, at));
        }
        let value = match kind {
            0x0000_0008 | 0x1000_0008 | 0x1100_0008 | 0x1200_0008 => {
                Tag::Whole(i64::from_le_bytes(raw))
            }
            0x2000_0008 => Tag::Real(f64::from_le_bytes(raw)),
            // Texts, arrays and blobs: the value is their size.
            0x2001_ffff | 0x4001_ffff | 0x4002_ffff | 0xffff_ffff => {
                let size = usize::try_from(u64::from_le_bytes(raw)).map_err(|_| CUT)?;
                at = at
                    .checked_add(size)
                    .filter(|at| *at <= bytes.len())
                    .ok_or(CUT)?;
                Tag::Other
            }
            _ => Tag::Other,
        };
        tags.insert(name, value);
    }
}

#[cfg(test)]
mod tests {
    use picofarm_files::Opener;

    use super::*;

    fn tag(name: &str, kind: u32, value: [u8; 8]) -> Vec<u8> {
        let mut tag = name.as_bytes().to_vec();
        tag.resize(32, 0);
        tag.extend((-1i32).to_le_bytes());
        tag.extend(kind.to_le_bytes());
        tag.extend(value);
        tag
    }

    /// A file of this type with these records; markers 1, 2 and 3 are line start, line stop and
    /// frame.
    fn file(code: i64, records: &[u32]) -> Vec<u8> {
        let whole = |name: &str, n: i64| tag(name, 0x1000_0008, n.to_le_bytes());
        let mut bytes = [MAGIC, b"1.0.00\0\0"].concat();
        let mut text = tag("File_Comment", 0x4001_ffff, 8u64.to_le_bytes());
        text.extend(b"a room\0\0");
        for part in [
            text,
            whole("TTResultFormat_TTTRRecType", code),
            tag("MeasDesc_Resolution", 0x2000_0008, 1e-10f64.to_le_bytes()),
            tag(
                "MeasDesc_GlobalResolution",
                0x2000_0008,
                1e-9f64.to_le_bytes(),
            ),
            whole("ImgHdr_LineStart", 1),
            whole("ImgHdr_LineStop", 2),
            whole("ImgHdr_Frame", 3),
            whole("ImgHdr_PixX", 2),
            whole("ImgHdr_PixY", 2),
            tag("Header_End", 0xffff_0008, [0; 8]),
        ] {
            bytes.extend(part);
        }
        bytes.extend(records.iter().flat_map(|r| r.to_le_bytes()));
        bytes
    }

    fn counts(code: i64, records: &[u32]) -> Vec<f32> {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"{"gate": {"t0_ps": 0}}"#;
        let (ptu, json) = (
            folder.path().join("a.ptu"),
            folder.path().join("capture.json"),
        );
        std::fs::write(&ptu, file(code, records)).unwrap();
        std::fs::write(json, text).unwrap();
        let opener = Opener::anywhere();
        let (described, _) = Described::find(std::slice::from_ref(&ptu), None, &opener).unwrap();
        let reader = Files::new(folder.path(), &opener);
        let description = described.read(&reader).unwrap();
        let part = read(&ptu, &description, &described, &reader).unwrap();
        assert_eq!(part.dims, [1, 2, 2, 10]);
        part.values
    }

    #[test]
    fn photons_of_all_layouts_come_to_their_pixels_across_overflows() {
        // Line 0 from clock 100 to 100 + 2000: a photon in channel 3 early, one in channel 7 late.
        // A frame; line 0 again with a photon in channel 3 early.
        let pico = |channel: u32, time: u32, sync: u32| channel << 28 | time << 16 | sync;
        let hydra = |special: u32, channel: u32, time: u32, sync: u32| {
            special << 31 | channel << 25 | time << 10 | sync
        };
        let mut expected = vec![0.0; 40];
        (expected[3], expected[10 + 7]) = (2.0, 1.0);
        let of_pico = [
            pico(15, 1, 65_000),
            pico(1, 3, 65_100),
            pico(15, 0, 0),
            pico(1, 7, 1_400),
            pico(15, 2, 1_464),
            pico(15, 4, 1_500),
            pico(15, 1, 2_000),
            pico(1, 3, 2_100),
            pico(15, 2, 4_000),
        ];
        assert_eq!(counts(0x0001_0303, &of_pico), expected, "PicoHarp");
        let hydra_events = |overflows: &[u32]| {
            let mut all = vec![hydra(1, 1, 0, 100), hydra(0, 0, 3, 200)];
            all.extend(overflows);
            all.extend([hydra(0, 0, 7, 20), hydra(1, 2, 0, 52), hydra(1, 4, 0, 60)]);
            all.extend([
                hydra(1, 1, 0, 100),
                hydra(0, 0, 3, 200),
                hydra(1, 2, 0, 1000),
            ]);
            all
        };
        // One record for two overflows, or two records.
        let one = hydra_events(&[hydra(1, 63, 0, 2)]);
        for code in [0x0101_0304, 0x0001_0305, 0x0001_0306, 0x0001_0307] {
            assert_eq!(counts(code, &one), expected, "{code:#x}");
        }
        let two = hydra_events(&[hydra(1, 63, 0, 0), hydra(1, 63, 0, 0)]);
        assert_eq!(counts(0x0001_0304, &two), expected, "HydraHarp 1");
    }

    #[test]
    fn a_header_that_is_cut_off_is_refused_at_any_length() {
        let whole = file(0x0001_0303, &[]);
        for length in MAGIC.len()..whole.len() {
            assert!(header(&whole[..length]).is_err(), "{length}");
        }
        assert_eq!(header(&whole).unwrap().1, whole.len());
    }
}
