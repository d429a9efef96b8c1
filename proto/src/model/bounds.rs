//! How long a text and how large a number may be that comes from outside, and the checks. All bounds are here.
//!
//! Two rules. A *name* (of a job, a data set, a worker, a store, any text of a job) that breaks its bound is refused, with
//! the field's name: whoever sent it can send another. A *free text* (an error message, a log line, a reason) is made
//! printable and cut: refusing it would lose an honest worker's report.

use std::io;

use serde::Serialize;
use serde_json::ser::CharEscape;

use super::job::{JobSpec, SpecError};

/// Bytes of a name: of a job, stage, data set, split, model, report, worker, user. A store's place and two names with a few
/// letters between are one index entry of the catalog, and Postgres takes at most 2,704 bytes there.
pub const NAME_BYTES: usize = 200;
/// Bytes of a store's place, or of another folder's or file's path or URL that the catalog indexes.
pub const PLACE_BYTES: usize = 1024;
/// Bytes of any other text of a job: a path's limit on Linux.
pub const TEXT_BYTES: usize = 4096;
/// Bytes of a message for people. It is stored for each failed task and repeated in the history.
pub const MESSAGE_BYTES: usize = 4096;
/// Labels, assets or kinds that a worker names, and labels that a stage asks for.
pub const LIST: usize = 256;
/// Leases that a worker names at a time; a message of 1 MiB holds some 20,000.
pub const LEASES: usize = 16_384;
/// Running tasks of a job whose status tells what they are at, some 1 MB with the longest texts; of more it tells who runs
/// them and how far they are. A status is sent a few times a second.
pub const RUNNING: usize = 1_000;
/// Seconds that a task may have taken: some thirty years.
pub const SECONDS: f64 = 1e9;
/// Bytes that a task may have published; the databases' integers are signed.
pub const BYTES: u64 = i64::MAX as u64;

/// Whether a terminal does anything with it but show it: control characters, line separators, and those that turn the
/// direction of writing.
pub fn steers(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Checks a name.
///
/// # Errors
/// What is wrong with it.
pub fn name(text: &str, most: usize) -> Result<(), String> {
    if let Some(c) = text.chars().find(|c| steers(*c)) {
        return Err(control(c));
    }
    length(text.len(), most)
}

fn control(c: char) -> String {
    format!(
        "holds the control character U+{:04X}; remove it",
        u32::from(c)
    )
}

fn length(bytes: usize, most: usize) -> Result<(), String> {
    match bytes > most {
        true => Err(format!("is {bytes} bytes long; at most {most} are allowed")),
        false => Ok(()),
    }
}

/// A free text as it is kept: printable, and at most [`MESSAGE_BYTES`].
pub fn message(text: &str) -> String {
    cut(text, MESSAGE_BYTES)
}

/// A name that somebody else chose, as it may stand in a message.
pub fn quoted(text: &str) -> String {
    format!("{:?}", cut(text, NAME_BYTES))
}

/// The beginning of a text in at most `most` bytes (at least 8), printable.
pub fn cut(text: &str, most: usize) -> String {
    const MARK: &str = " …";
    let shown = |c: char| if steers(c) { ' ' } else { c };
    // A character that steers and its space: the text only gets shorter.
    if text.len() <= most {
        return text.chars().map(shown).collect();
    }
    let end = text.floor_char_boundary(most - MARK.len());
    let mut short: String = text[..end].chars().map(shown).collect();
    short.push_str(MARK);
    short
}

/// Checks how long a task took.
///
/// # Errors
/// What is wrong with it.
pub fn seconds(value: f64) -> Result<f64, String> {
    match (0.0..=SECONDS).contains(&value) {
        true => Ok(value),
        false => Err(format!(
            "{value:e} is no time that a task can take; expected 0 to {SECONDS:e} seconds"
        )),
    }
}

/// Checks the length of every text of a job, and that none has control characters.
///
/// # Errors
/// [`SpecError`] that names the first that cannot be used.
pub(super) fn texts(spec: &JobSpec) -> Result<(), SpecError> {
    let mut walk = Walk::default();
    let mut writer = serde_json::Serializer::with_formatter(io::sink(), &mut walk);
    if spec.serialize(&mut writer).is_ok() {
        return Ok(());
    }
    let what = walk
        .wrong
        .unwrap_or_else(|| "cannot be written as JSON".into());
    let mut path = walk.path.into_iter().map(|step| match step {
        Step::Key(key) => cut(&key, NAME_BYTES),
        Step::Item(at) => at.to_string(),
    });
    let mut field: Vec<String> = path.by_ref().collect();
    let at = field.get(1).and_then(|at| at.parse::<usize>().ok());
    if field.first().is_some_and(|first| first == "stage")
        && let Some(stage) = at.and_then(|at| spec.stages.get(at))
    {
        field.drain(..2);
        if spec.stages.len() > 1 {
            field.insert(0, format!("stage.{}", cut(&stage.name, NAME_BYTES)));
        }
    }
    Err(SpecError::new(field.join("."), what))
}

/// A step from a value to one within it.
#[derive(Debug)]
enum Step {
    Key(String),
    Item(usize),
}

/// Looks at every text while a job is written as JSON into nothing: so nothing is copied, and no field is forgotten.
#[derive(Debug, Default)]
struct Walk {
    path: Vec<Step>,
    in_key: bool,
    /// Bytes of the text in hand.
    bytes: usize,
    wrong: Option<String>,
}

impl Walk {
    fn refuse(&mut self, what: String) -> io::Result<()> {
        self.wrong = Some(what);
        Err(io::Error::other("a text that cannot be used"))
    }

    /// How long the text in hand may be.
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn spec() -> serde_json::Value {
        serde_json::json!({"name": "n", "scenes": {"kind": "primitive", "count": 3},
            "render": {"renderer": "r1"}, "resources": {"labels": ["a", "b"]},
            "output": {"store": "file:///s", "dataset": "d"}})
    }

    fn refused(at: &str, value: &str) -> String {
        let mut job = spec();
        *job.pointer_mut(at).unwrap() = value.into();
        let spec: JobSpec = serde_json::from_value(job).unwrap();
        spec.check().unwrap_err().to_string()
    }

    #[test]
    fn a_text_of_a_job_with_a_control_character_is_refused_by_its_field() {
        for steering in ["\0", "\u{1b}[2J", "\n", "\u{7f}", "\u{202e}"] {
            let text = format!("x{steering}y");
            for (at, field) in [
                ("/name", "name: holds"),
                ("/output/store", "output.store: holds"),
                ("/output/dataset", "output.dataset: holds"),
                ("/render/renderer", "render.renderer: holds"),
                ("/resources/labels/1", "resources.labels.1: holds"),
            ] {
                let why = refused(at, &text);
                assert!(why.starts_with(field), "{at}: {why}");
                assert!(!why.chars().any(steers), "{why:?}");
            }
        }
    }

    #[test]
    fn a_text_of_a_job_that_is_too_long_is_refused_with_the_length_allowed() {
        for (at, most) in [
            ("/name", NAME_BYTES),
            ("/output/dataset", NAME_BYTES),
            ("/output/store", PLACE_BYTES),
            ("/render/renderer", TEXT_BYTES),
        ] {
            let why = refused(at, &"x".repeat(most + 1));
            assert!(why.contains(&format!("at most {most}")), "{at}: {why}");
            assert!(why.len() < 200, "the text itself is not repeated: {why}");
        }
    }

    #[test]
    fn in_a_job_of_several_stages_the_error_names_the_stage() {
        let mut job = serde_json::json!({"name": "n", "stage": [spec(), spec()]});
        for stage in job["stage"].as_array_mut().unwrap() {
            stage.as_object_mut().unwrap().remove("name");
        }
        job["stage"][1]["name"] = "second".into();
        job["stage"][1]["output"]["dataset"] = "a\0".into();
        let spec: JobSpec = serde_json::from_value(job).unwrap();
        let why = spec.check().unwrap_err();
        assert_eq!(why.field, "stage.second.output.dataset");
    }

    proptest! {
        #[test]
        fn what_is_cut_is_printable_and_no_longer_than_allowed(text in ".*", most in 8usize..40) {
            let short = cut(&text, most);
            prop_assert!(short.len() <= most.max(8));
            prop_assert!(!short.chars().any(steers));
            if text.len() <= most && !text.chars().any(steers) {
                prop_assert_eq!(short, text);
            }
        }

        #[test]
        fn only_times_that_can_be_are_taken(value in any::<f64>()) {
            prop_assert_eq!(seconds(value).is_ok(), (0.0..=1e9).contains(&value));
        }
    }
}
