//! Tables of photon events.

use std::path::Path;

use super::super::ImportError;
use super::super::files::Files;
use super::arrays::Part;
use super::describe::{Described, Description};
use super::kinds::unknown;

pub(super) fn read(
    file: &Path,
    _description: &Description,
    _described: &Described,
    _reader: &Files,
) -> Result<Part, ImportError> {
    Err(unknown(file, "a text file"))
}
