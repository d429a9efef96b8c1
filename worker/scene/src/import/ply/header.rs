//! The header of a PLY file: its format, and the properties of each element.

/// The greatest length of a header, bytes.
const MAX_HEADER: usize = 1 << 16;

/// The encoding of numbers after the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    Little,
    Big,
}

/// The type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Returns the least and largest value of a whole-number type, or `None` for the others.
    pub(super) fn range(self) -> Option<(f64, f64)> {
        Some(match self {
            Self::I8 => (f64::from(i8::MIN), f64::from(i8::MAX)),
            Self::U8 => (0.0, f64::from(u8::MAX)),
            Self::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            Self::U16 => (0.0, f64::from(u16::MAX)),
            Self::I32 => (f64::from(i32::MIN), f64::from(i32::MAX)),
            Self::U32 => (0.0, f64::from(u32::MAX)),
            Self::F32 | Self::F64 => return None,
        })
    }

    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }
}

/// One property: a number, or with `length` a list of them.
#[derive(Debug)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) number: Number,
    pub(super) length: Option<Number>,
}

#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: usize,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// Returns the index of the property with one of these names.
    pub(super) fn find(&self, names: &[&str]) -> Option<usize> {
        self.properties
            .iter()
            .position(|p| names.contains(&p.name.as_str()))
    }
}

/// Parses format, elements, and the offset at which the body starts.
pub(super) fn parse(bytes: &[u8]) -> Result<(Encoding, Vec<Element>, usize), String> {
    let (mut at, mut encoding, mut elements) = (0, None, Vec::<Element>::new());
    // The first line shows the line ending: files of old Macs have a carriage return alone.
    let cr = bytes.starts_with(b"ply\r") && bytes.get(4) != Some(&b'\n');
    let ending = if cr { b'\r' } else { b'\n' };
    for number in 1.. {
        let rest = &bytes[at..bytes.len().min(MAX_HEADER)];
        let Some(end) = rest.iter().position(|&b| b == ending) else {
            return Err("header: has no line end_header; the file is cut short".into());
        };
        let line = std::str::from_utf8(&rest[..end])
            .map_err(|_| format!("header line {number}: is not text"))?
            .trim();
        at += end + 1;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let fail = |what: &str| Err(format!("header line {number}: {what}"));
        match words.as_slice() {
            [] | ["ply" | "comment" | "obj_info", ..] => {}
            ["format", format, ..] => {
                encoding = Some(match *format {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return fail("expected ascii, binary_little_endian or binary_big_endian"),
                });
            }
            ["element", name, count] => {
                let Ok(count) = count.parse() else {
                    return fail("expected a count");
                };
                if elements.iter().any(|e| e.name == *name) {
                    return fail("this element is stated twice");
                }
                elements.push(Element {
                    name: (*name).to_owned(),
                    count,
                    properties: Vec::new(),
                });
            }
            ["property", kind @ .., name] => {
                let (length, number) = match kind {
                    ["list", length, item] => (Some(*length), *item),
                    [number] => (None, *number),
                    _ => return fail("expected a type and a name"),
                };
                let length = length.map(|l| Number::named(l).ok_or(l)).transpose();
                let (Ok(length), Some(number)) = (length, Number::named(number)) else {
                    return fail("this type is not known; use char … double");
                };
                if length.is_some_and(|l| l.range().is_none()) {
                    return fail("the length of a list needs a whole-number type, such as uchar");
                }
                let Some(element) = elements.last_mut() else {
                    return fail("comes before any element");
                };
                if element.properties.iter().any(|p| p.name == *name) {
                    return fail("this property is stated twice");
                }
                element.properties.push(Property {
                    name: (*name).to_owned(),
                    number,
                    length,
                });
            }
            ["end_header"] => break,
            _ => return fail("expected format, comment, element, property or end_header"),
        }
    }
    let encoding = encoding.ok_or("header: has no format line")?;
    Ok((encoding, elements, at))
}
