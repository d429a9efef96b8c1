//! How much memory a spec takes.

use std::io;

use picofarm_proto::spec::JobSpec;

/// A message takes its length twice: once as received and once as decoded.
pub(crate) const TWICE: u64 = 2;
/// Bytes of memory for each byte of a spec while it is read, checked, hashed and recorded. They
/// cover its strings, its text, and copies of the text as it is hashed and bound to a statement.
const SPEC_BYTE: u64 = 4;
/// Bytes of memory for each byte of a spec read from the catalog: the strings, and the text of one
/// spec at a time.
const STORED_BYTE: u64 = 2;
/// Bytes of memory for each value of a spec. A string takes 24, plus the allocator's smallest
/// block.
const SPEC_VALUE: u64 = 48;

/// Returns the memory of a spec of this text while it is read, checked, hashed and recorded.
pub(super) fn spec_cost(json: &str) -> u64 {
    SPEC_BYTE * json.len() as u64 + SPEC_VALUE * values(json.as_bytes())
}

/// Returns the memory of specs of this total length while they are read from the catalog.
pub(crate) fn stored_cost(bytes: u64) -> u64 {
    bytes.saturating_mul(STORED_BYTE)
}

/// Returns the memory of a spec for as long as it is kept.
pub(crate) fn kept_cost(spec: &JobSpec) -> u64 {
    let mut size = Size::default();
    serde_json::to_writer(&mut size, spec).expect("a spec is plain data");
    size.bytes + SPEC_VALUE * size.values
}

/// Returns an upper bound on the number of values in a part of a JSON text.
fn values(text: &[u8]) -> u64 {
    let begins = text.iter().filter(|b| matches!(b, b',' | b'[' | b'{'));
    begins.count() as u64
}

/// Counts written bytes and discards them.
#[derive(Default)]
struct Size {
    bytes: u64,
    values: u64,
}

impl io::Write for Size {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.bytes += text.len() as u64;
        self.values += values(text);
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
