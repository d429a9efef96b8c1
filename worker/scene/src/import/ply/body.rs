//! The rows after the header of a PLY file.

use super::header::{Element, Encoding, Number};

/// The numbers of one row, and the start of each property.
#[derive(Default)]
pub(super) struct Row {
    numbers: Vec<f64>,
    starts: Vec<usize>,
}

impl Row {
    pub(super) fn first(&self, property: usize) -> f64 {
        self.all(property).first().copied().unwrap_or(f64::NAN)
    }

    pub(super) fn all(&self, property: usize) -> &[f64] {
        &self.numbers[self.starts[property]..self.starts[property + 1]]
    }
}

/// The rest of the file after the header, or after the elements read so far.
pub(super) struct Body<'a> {
    encoding: Encoding,
    rest: &'a [u8],
}

impl<'a> Body<'a> {
    pub(super) fn new(encoding: Encoding, rest: &'a [u8]) -> Self {
        Self { encoding, rest }
    }

    /// Calls `each` with every row of an element.
    pub(super) fn rows(
        &mut self,
        element: &Element,
        mut each: impl FnMut(&Row) -> Result<(), String>,
    ) -> Result<(), String> {
        self.fits(element)?;
        if element.properties.is_empty() {
            return Ok(());
        }
        let mut row = Row::default();
        for k in 0..element.count {
            row.numbers.clear();
            row.starts.clear();
            match self.encoding {
                Encoding::Ascii => self.line(element, &mut row),
                _ => self.binary(element, &mut row),
            }
            .and_then(|()| each(&row))
            .map_err(|what| format!("element {} row {k}: {what}", element.name))?;
        }
        Ok(())
    }

    /// Returns the number of bytes after the last row, excluding white space.
    pub(super) fn left_over(&self) -> Result<usize, String> {
        let left = self.rest.trim_ascii().len();
        if left > 0 && self.encoding == Encoding::Ascii {
            return Err(
                "the file has more rows than its header states; correct the counts of its elements"
                    .into(),
            );
        }
        Ok(left)
    }

    /// Reads a row in text: a line with exactly the numbers that the header declares.
    fn line(&mut self, element: &Element, row: &mut Row) -> Result<(), String> {
        let line = loop {
            if self.rest.is_empty() {
                return Err(SHORT.into());
            }
            let end = self.rest.iter().position(|b| matches!(b, b'\n' | b'\r'));
            let (line, rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
            self.rest = rest.get(1..).unwrap_or_default();
            if !line.trim_ascii().is_empty() {
                break line;
            }
        };
        let mut words = line
            .split(u8::is_ascii_whitespace)
            .filter(|w| !w.is_empty());
        for property in &element.properties {
            row.starts.push(row.numbers.len());
            let name = &property.name;
            let mut next = |number: Number| {
                let word = words.next().ok_or_else(|| {
                    format!("the line ends before property {name}; expected one line a row")
                })?;
                let value = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
                let value: f64 = value.ok_or("expected a number")?;
                in_range(value, number).map_err(|what| format!("property {name}: {what}"))
            };
            let count = match property.length {
                None => 1.0,
                Some(length) => next(length)?,
            };
            // Each number of a list takes at least a byte and a space.
            if !(0.0..=line.len() as f64).contains(&count) {
                return Err(format!("list {name} of {count} does not fit its line"));
            }
            for _ in 0..count as usize {
                let value = next(property.number)?;
                row.numbers.push(value);
            }
        }
        row.starts.push(row.numbers.len());
        match words.count() {
            0 => Ok(()),
            more => Err(format!(
                "the line has {more} numbers more than the header's properties; correct the header or the row"
            )),
        }
    }

    fn binary(&mut self, element: &Element, row: &mut Row) -> Result<(), String> {
        for property in &element.properties {
            row.starts.push(row.numbers.len());
            let count = match property.length {
                None => 1,
                Some(length) => {
                    let count = self.number(length)?;
                    let most = self.rest.len() / property.number.size();
                    if !(0.0..=most as f64).contains(&count) {
                        let what = format!("list {} of {count} does not fit", property.name);
                        return Err(what);
                    }
                    count as usize
                }
            };
            for _ in 0..count {
                row.numbers.push(self.number(property.number)?);
            }
        }
        row.starts.push(row.numbers.len());
        Ok(())
    }

    /// Returns the least number of bytes that a number takes.
    fn least(&self, number: Number) -> usize {
        match self.encoding {
            Encoding::Ascii => 1,
            _ => number.size(),
        }
    }

    /// Refuses counts that exceed the rest of the file, before memory is allocated for them.
    fn fits(&self, element: &Element) -> Result<(), String> {
        let one: usize = element
            .properties
            .iter()
            .map(|p| self.least(p.length.unwrap_or(p.number)))
            .sum();
        let need = element.count.checked_mul(one);
        if need.is_some_and(|need| need <= self.rest.len()) {
            return Ok(());
        }
        Err(format!(
            "element {}: {} rows do not fit the {} bytes left; the file is cut short or damaged",
            element.name,
            element.count,
            self.rest.len()
        ))
    }

    fn number(&mut self, number: Number) -> Result<f64, String> {
        let (word, rest) = self.rest.split_at_checked(number.size()).ok_or(SHORT)?;
        self.rest = rest;
        let mut bytes = [0; 8];
        bytes[..word.len()].copy_from_slice(word);
        if self.encoding == Encoding::Big {
            bytes[..word.len()].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match number {
            Number::I8 => f64::from(a as i8),
            Number::U8 => f64::from(a),
            Number::I16 => f64::from(i16::from_le_bytes([a, b])),
            Number::U16 => f64::from(u16::from_le_bytes([a, b])),
            Number::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Number::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Number::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Number::F64 => f64::from_le_bytes(bytes),
        })
    }
}

const SHORT: &str = "the file is cut short";

/// Checks that a value has a number's type: whole numbers have no fraction and are in the type's
/// range.
fn in_range(value: f64, number: Number) -> Result<f64, String> {
    match number.range() {
        Some((lo, hi)) if value.fract() != 0.0 || !(lo..=hi).contains(&value) => Err(format!(
            "{value} is no whole number from {lo} to {hi}, which its type asks for"
        )),
        _ => Ok(value),
    }
}
