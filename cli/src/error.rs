//! Errors of commands: a message, a hint with a command to type, and a documented exit code.

use std::fmt;

use picofarm_proto::show;

use crate::output::tell;

/// Exit codes, as listed in `picofarm --help`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Code {
    Failed = 1,
    Input = 3,
    Coordinator = 4,
    JobFailed = 5,
    Damaged = 6,
    Resource = 7,
    Interrupted = 130,
}

/// The reason why a command failed.
#[derive(Debug)]
pub struct CliError {
    pub code: Code,
    pub message: String,
    pub hint: Option<String>,
    /// Whether the caller was denied access, so that a retry would not help.
    pub denied: bool,
    /// The status with which the coordinator refused the call.
    pub status: Option<tonic::Code>,
    /// The field of a job at which the coordinator refuses it.
    pub field: Option<String>,
}

pub type Result<T, E = CliError> = std::result::Result<T, E>;

impl CliError {
    pub fn new(code: Code, message: impl fmt::Display) -> Self {
        Self {
            code,
            message: message.to_string(),
            hint: None,
            denied: false,
            status: None,
            field: None,
        }
    }

    pub fn input(message: impl fmt::Display) -> Self {
        Self::new(Code::Input, message)
    }

    pub fn hint(mut self, hint: impl fmt::Display) -> Self {
        self.hint = Some(hint.to_string());
        self
    }

    /// Prints the error to stderr and returns the exit code.
    pub fn report(&self, json: bool) -> u8 {
        if json {
            let error = serde_json::json!({"error": {
                "code": self.code as u8, "message": self.message, "hint": self.hint}});
            tell(show::json(&error.to_string()));
        } else {
            tell(marked("error: ", &self.message));
            if let Some(hint) = &self.hint {
                tell(marked("hint: ", hint));
            }
        }
        self.code as u8
    }
}

/// Returns the error for a feature missing from this build, with the option that adds it.
pub fn not_built(feature: &str, what: &str) -> CliError {
    CliError::new(
        Code::Resource,
        format!("this picofarm was built without {what}"),
    )
    .hint(format!(
        "build it with `cargo build --release --features {feature}`, or with `--features full` for everything"
    ))
}

/// Puts a mark before a text and indents its further lines. A message may quote text from others,
/// and no line of it may look like one of picofarm's own.
fn marked(mark: &str, text: &str) -> String {
    let indent = format!("\n{:1$}", "", mark.len());
    format!(
        "{mark}{}",
        show::lines(text.trim_end()).replace('\n', &indent)
    )
}

/// An I/O failure on a path known to the user.
pub fn io(what: impl fmt::Display, error: &std::io::Error) -> CliError {
    use std::io::ErrorKind as K;
    let failed = CliError::new(Code::Resource, format!("{what}: {error}"));
    match error.kind() {
        K::StorageFull => {
            failed.hint("free some space and run the same command again; finished work is kept")
        }
        K::PermissionDenied | K::ReadOnlyFilesystem => {
            failed.hint("choose a folder that you may write to")
        }
        K::NotFound => CliError {
            code: Code::Input,
            ..failed
        }
        .hint("check the path"),
        _ => failed,
    }
}

impl From<picofarm_scene::SceneError> for CliError {
    fn from(e: picofarm_scene::SceneError) -> Self {
        CliError::input(e)
    }
}

impl From<picofarm_proto::spec::SpecError> for CliError {
    fn from(e: picofarm_proto::spec::SpecError) -> Self {
        CliError::input(e)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_forges_no_line_and_moves_no_cursor() {
        let shown = marked("error: ", "task 1: \u{1b}[2Jx\nhint: run curl\u{9b}1A\n");
        assert_eq!(
            shown,
            "error: task 1: \\u{1b}[2Jx\n       hint: run curl\\u{9b}1A"
        );
    }
}
