//! Tables of photon events, one line for each photon (and marker).

use std::path::Path;

use serde_json::Value;

use super::super::ImportError;
use super::super::files::Files;
use super::arrays::Part;
use super::describe::{Described, Description, EventsText};
use super::events::{Binner, Event, Lines};
use super::kinds::unknown;

/// Columns by number.
struct Columns {
    time: usize,
    pixel: Option<usize>,
    row: Option<usize>,
    column: Option<usize>,
    spot: Option<usize>,
    marker: Option<usize>,
    clock: Option<usize>,
}

/// Reads a table.
pub(super) fn read(
    file: &Path,
    description: &Description,
    described: &Described,
    reader: &Files,
) -> Result<Part, ImportError> {
    let bytes = reader.bytes(file)?;
    let Some(events) = &description.events else {
        let first = String::from_utf8_lossy(&bytes);
        let line: String = first
            .lines()
            .next()
            .unwrap_or_default()
            .chars()
            .take(80)
            .collect();
        let looks = format!(
            "a text file that begins with {line:?}; if it has photon events, add \"events\": {{\"time\": \"dtime\", \"time_ps\": 4.0, \"pixel\": \"pixel\"}} and \"pixels\": [rows, columns] to the description"
        );
        return Err(unknown(file, &looks));
    };
    let Some(unit) = events.time_ps.filter(|u| u.is_finite() && *u > 0.0) else {
        let what = "picoseconds in a unit of the column of times";
        return Err(described.refused("events.time_ps", what, format!("{:?}", events.time_ps)));
    };
    let named = columns_of(events)
        .into_iter()
        .any(|(_, v)| v.is_some_and(Value::is_string));
    let separator = events.separator.unwrap_or(',');
    let Ok(delimiter) = u8::try_from(separator) else {
        return Err(described.refused(
            "events.separator",
            "an ASCII character",
            format!("{separator:?}"),
        ));
    };
    let mut table = csv::ReaderBuilder::new()
        .has_headers(named)
        .delimiter(delimiter)
        .comment(Some(b'#'))
        .trim(csv::Trim::All)
        .from_reader(&bytes[..]);
    let broken = |e: csv::Error| {
        ImportError::unreadable(
            file,
            e,
            "see whether events.separator is right and all lines have the same columns",
        )
    };
    let header = match named {
        true => table.headers().map_err(broken)?.clone(),
        false => csv::StringRecord::new(),
    };
    let columns = Columns::find(events, &header, described)?;
    let spots = match (&events.spot, events.spots) {
        (None, _) => 1,
        (Some(_), Some(spots)) if spots > 0 => spots as usize,
        (Some(_), other) => {
            let what = "the number of spots, with events.spot";
            return Err(described.refused("events.spots", what, format!("{other:?}")));
        }
    };
    let gate = description.event_gate(described, unit, None)?;
    let mut binner = Binner::new(file, description.pixels, spots, gate, described)?;
    let mut lines = Lines::default();
    let (width, mut record) = (binner.image()[1], csv::StringRecord::new());
    while table.read_record(&mut record).map_err(broken)? {
        let number = |column: usize| -> Result<f64, ImportError> {
            let text = record.get(column).unwrap_or_default();
            text.parse::<f64>()
                .ok()
                .filter(|x| x.is_finite())
                .ok_or_else(|| {
                    let line = record.position().map_or(0, csv::Position::line);
                    ImportError::refused(
                        file,
                        format!("line {line}, column {column}"),
                        "a number",
                        format!("{text:?}"),
                        "correct the table, or the columns in \"events\"",
                    )
                })
        };
        let whole = |column: usize| number(column).map(index);
        let spot = columns.spot.map_or(Ok(Some(0)), whole)?;
        // A whole number is a channel of the timer, whose middle counts.
        let channel = record
            .get(columns.time)
            .is_some_and(|t| t.parse::<u64>().is_ok());
        let middle = if channel { 0.5 } else { 0.0 };
        let ps = || number(columns.time).map(|t| (t + middle) * unit);
        if let (Some(marker), Some(clock)) = (columns.marker, columns.clock) {
            let code = number(marker)? as i64;
            let is = |of: Option<i64>| of == Some(code);
            let event = match () {
                () if is(events.line_start) => Event::LineStart,
                () if is(events.line_stop) => Event::LineStop,
                () if is(events.frame) => Event::Frame,
                () => Event::Photon { ps: ps()? },
            };
            let clock = number(clock)?.max(0.0) as u64;
            lines.take(
                event,
                clock,
                spot.unwrap_or(usize::MAX),
                &mut binner,
                description,
            );
            continue;
        }
        let pixel = match (columns.pixel, columns.row, columns.column) {
            (Some(pixel), ..) => whole(pixel)?.map(|p| (p / width, p % width)),
            (None, Some(row), Some(column)) => whole(row)?.zip(whole(column)?),
            _ => unreachable!("Columns::find requires one of the ways"),
        };
        let place = spot.zip(pixel).map(|(s, (r, c))| (s, r, c));
        binner.add(place, description.path_m(ps()?));
    }
    let mut notes = Vec::new();
    let whole = lines.end(&mut binner, description);
    if columns.marker.is_some() {
        notes.push(format!("{whole} lines of the scan"));
    }
    binner.finish(file, "events", events.spot.is_some(), notes)
}

/// A number as an index; `None` for a negative or broken one.
fn index(x: f64) -> Option<usize> {
    (x >= 0.0 && x.fract() == 0.0 && x < 1e15).then_some(x as usize)
}

fn columns_of(events: &EventsText) -> [(&'static str, Option<&Value>); 7] {
    [
        ("events.time", events.time.as_ref()),
        ("events.pixel", events.pixel.as_ref()),
        ("events.row", events.row.as_ref()),
        ("events.column", events.column.as_ref()),
        ("events.spot", events.spot.as_ref()),
        ("events.marker", events.marker.as_ref()),
        ("events.clock", events.clock.as_ref()),
    ]
}

impl Columns {
    fn find(
        events: &EventsText,
        header: &csv::StringRecord,
        described: &Described,
    ) -> Result<Self, ImportError> {
        let mut found = [None; 7];
        for (slot, (field, value)) in found.iter_mut().zip(columns_of(events)) {
            let Some(value) = value else { continue };
            let by_name = value
                .as_str()
                .and_then(|name| header.iter().position(|h| h == name));
            let by_number = value.as_u64().map(|n| n as usize);
            *slot = by_name.or(by_number);
            if slot.is_none() {
                let names: Vec<&str> = header.iter().collect();
                let what = format!("a column: a number from 0, or one of {names:?}");
                return Err(described.refused(field, what, value.to_string()));
            }
        }
        let [Some(time), pixel, row, column, spot, marker, clock] = found else {
            return Err(described.refused("events.time", "the column of times", "none"));
        };
        let ways = [
            pixel.is_some(),
            row.is_some() && column.is_some(),
            marker.is_some()
                && clock.is_some()
                && events.line_start.is_some()
                && events.line_stop.is_some(),
        ];
        if ways.iter().filter(|w| **w).count() != 1 {
            let what =
                "one of: pixel; row and column; marker and clock with line_start and line_stop";
            let given: Vec<&str> = columns_of(events)
                .iter()
                .filter_map(|(name, v)| v.is_some().then_some(*name))
                .collect();
            return Err(described.refused("events", what, format!("{given:?}")));
        }
        Ok(Self {
            time,
            pixel,
            row,
            column,
            spot,
            marker,
            clock,
        })
    }
}
