//! Checks every text of a job: its length, and that it has no control characters.

use std::io;

use serde::Serialize;
use serde_json::ser::CharEscape;

use super::bounds::{NAME_BYTES, PLACE_BYTES, TEXT_BYTES, control, cut, length, steers};

/// An invalid text.
#[derive(Debug)]
pub(super) struct Fault {
    /// The path to the text: names of fields, and positions in lists.
    pub path: Vec<String>,
    /// Description of the fault.
    pub what: String,
}

/// Checks every text of a value.
///
/// # Errors
/// Returns the first invalid text.
pub(super) fn check(value: &impl Serialize) -> Result<(), Fault> {
    let mut walk = Walk::default();
    let mut writer = serde_json::Serializer::with_formatter(io::sink(), &mut walk);
    if value.serialize(&mut writer).is_ok() {
        return Ok(());
    }
    let what = walk
        .wrong
        .unwrap_or_else(|| "cannot be written as JSON".into());
    let path = walk.path.into_iter().map(|step| match step {
        Step::Key(key) => cut(&key, NAME_BYTES),
        Step::Item(at) => at.to_string(),
    });
    Err(Fault {
        path: path.collect(),
        what,
    })
}

/// A step from a value to one inside it.
#[derive(Debug)]
enum Step {
    Key(String),
    Item(usize),
}

/// Visits every text while a job is serialized as JSON without output. Nothing is copied, and no
/// field can be forgotten.
#[derive(Debug, Default)]
struct Walk {
    path: Vec<Step>,
    in_key: bool,
    /// Bytes of the current text.
    bytes: usize,
    wrong: Option<String>,
}

impl Walk {
    fn refuse(&mut self, what: String) -> io::Result<()> {
        self.wrong = Some(what);
        Err(io::Error::other("a text that cannot be used"))
    }

    /// Returns the longest allowed length of the current text.
    fn most(&self) -> usize {
        let named = self.path.iter().rev().find_map(|step| match step {
            Step::Key(key) => Some(&**key),
            Step::Item(_) => None,
        });
        match named {
            Some(
                "name" | "dataset" | "model" | "models" | "among" | "split" | "needs" | "nonce"
                | "sweep" | "id",
            ) => NAME_BYTES,
            Some("store" | "dest" | "folder") => PLACE_BYTES,
            _ => TEXT_BYTES,
        }
    }

    fn text(&mut self, text: &str) -> io::Result<()> {
        self.bytes += text.len();
        if let Some(c) = text.chars().find(|c| steers(*c)) {
            return self.refuse(control(c));
        }
        if self.in_key
            && let Some(Step::Key(key)) = self.path.last_mut()
        {
            key.push_str(text);
        }
        Ok(())
    }
}

impl serde_json::ser::Formatter for &mut Walk {
    fn begin_array<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        self.path.push(Step::Item(0));
        Ok(())
    }

    fn begin_array_value<W: ?Sized + io::Write>(
        &mut self,
        _: &mut W,
        first: bool,
    ) -> io::Result<()> {
        if let Some(Step::Item(at)) = self.path.last_mut() {
            *at += usize::from(!first);
        }
        Ok(())
    }

    fn end_array<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        self.path.pop();
        Ok(())
    }

    fn begin_object_key<W: ?Sized + io::Write>(&mut self, _: &mut W, _: bool) -> io::Result<()> {
        self.path.push(Step::Key(String::new()));
        self.in_key = true;
        Ok(())
    }

    fn end_object_key<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        self.in_key = false;
        Ok(())
    }

    fn end_object_value<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        self.path.pop();
        Ok(())
    }

    fn begin_string<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        self.bytes = 0;
        Ok(())
    }

    fn end_string<W: ?Sized + io::Write>(&mut self, _: &mut W) -> io::Result<()> {
        match length(self.bytes, self.most()) {
            Ok(()) => Ok(()),
            Err(what) => self.refuse(what),
        }
    }

    fn write_string_fragment<W: ?Sized + io::Write>(
        &mut self,
        _: &mut W,
        fragment: &str,
    ) -> io::Result<()> {
        self.text(fragment)
    }

    fn write_char_escape<W: ?Sized + io::Write>(
        &mut self,
        _: &mut W,
        escape: CharEscape,
    ) -> io::Result<()> {
        self.text(match escape {
            CharEscape::Quote => "\"",
            CharEscape::ReverseSolidus => "\\",
            CharEscape::Solidus => "/",
            CharEscape::Backspace => "\u{8}",
            CharEscape::FormFeed => "\u{c}",
            CharEscape::LineFeed => "\n",
            CharEscape::CarriageReturn => "\r",
            CharEscape::Tab => "\t",
            CharEscape::AsciiControl(byte) => {
                return self.refuse(control(char::from(byte)));
            }
        })
    }
}
