//! `--strategy`: manual choice of the renderer's sampling strategies.

use picofarm_settings::{Choice, Strategy};

use crate::error::{CliError, Result};

/// One choice: a field of [`Strategy`] by name, and its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Chosen {
    name: String,
    choice: Choice,
}

/// Parses `path-reuse=1` or `mirror-images=off`.
///
/// # Errors
/// Returns a message that lists the valid names.
pub fn parse(text: &str) -> Result<Chosen, String> {
    let Some((name, value)) = text.split_once('=') else {
        let all = Strategy::NAMES.join(", ");
        return Err(format!(
            "expected NAME=VALUE with a number, on or off; the names are {all}"
        ));
    };
    let name = name.trim().replace('-', "_");
    let choice = match value.trim() {
        "on" | "true" => Choice::On(true),
        "off" | "false" => Choice::On(false),
        number => Choice::Size(
            number
                .parse()
                .map_err(|_| format!("{name} = {number:?}: expected a number, on or off"))?,
        ),
    };
    Strategy::default().choose(&name, choice)?;
    Ok(Chosen { name, choice })
}

/// Combines several choices.
///
/// # Errors
/// Fails if a strategy is chosen twice.
pub fn together(chosen: &[Chosen]) -> Result<Strategy> {
    let mut all = Strategy::default();
    for (i, c) in chosen.iter().enumerate() {
        if chosen[..i].iter().any(|earlier| earlier.name == c.name) {
            let what = format!("--strategy: {} is chosen twice", c.name);
            return Err(CliError::input(what));
        }
        all.choose(&c.name, c.choice)
            .map_err(|e| CliError::input(format!("--strategy: {e}")))?;
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_with_dashes_or_underscores() {
        let read = |text: &[&str]| {
            let chosen: Vec<_> = text.iter().map(|t| parse(t).unwrap()).collect();
            together(&chosen)
        };
        let all = read(&["path-reuse=2", "mirror-images=off", "light_vertices=on"]).unwrap();
        assert_eq!(all.path_reuse, Some(2));
        assert_eq!(all.mirror_images, Some(false));
        assert_eq!(all.light_vertices, Some(true));
        assert_eq!(read(&[]).unwrap(), Strategy::default());
        let twice = read(&["path-reuse=1", "path-reuse=2"]).unwrap_err();
        assert!(twice.message.contains("path_reuse is chosen twice"));
    }

    #[test]
    fn what_is_unknown_is_answered_with_what_is_known() {
        for (text, part) in [
            ("lobes=off", "mirror_images"),
            ("path-reuse", "NAME=VALUE"),
            ("path-reuse=few", "\"few\""),
            ("path-reuse=on", "number"),
            ("mirror-images=3", "off"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
