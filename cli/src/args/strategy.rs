//! `--strategy` and `--strategies`: manual choice of the renderer's sampling strategies.

use picofarm_settings::{Choice, Strategy};

use crate::error::{CliError, Result};

/// One choice: a field of [`Strategy`] by name, and its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Chosen {
    name: String,
    choice: Choice,
}

/// A set of strategies for comparison in a benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    pub name: String,
    pub strategy: Strategy,
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

/// The variants of one word of `--strategies`.
#[derive(Debug, Clone, PartialEq)]
pub struct Ways(Vec<Variant>);

/// Parses `default`, `each` (each strategy turned off in turn), `path-reuse=1` or
/// `path-reuse=1+mirror-images=off`.
///
/// # Errors
/// Returns the errors of [`parse`], or an error if a strategy is chosen twice.
pub fn ways(text: &str) -> Result<Ways, String> {
    let default = Variant {
        name: "picofarm".into(),
        strategy: Strategy::default(),
    };
    let of = |text: &str| -> Result<Variant, String> {
        let chosen = text.split('+').map(parse).collect::<Result<Vec<_>, _>>()?;
        Ok(Variant {
            name: text.into(),
            strategy: together(&chosen).map_err(|e| e.message)?,
        })
    };
    match text {
        "default" => Ok(Ways(vec![default])),
        "each" => {
            // A strategy without a switch is a size, and size 1 turns it off.
            let without = |name: &str| {
                let name = name.replace('_', "-");
                of(&format!("{name}=off")).or_else(|_| of(&format!("{name}=1")))
            };
            let all = Strategy::NAMES
                .into_iter()
                .map(without)
                .collect::<Result<Vec<_>, _>>()?;
            Ok(Ways([vec![default], all].concat()))
        }
        _ => Ok(Ways(vec![of(text)?])),
    }
}

/// Returns all variants to compare, in order and without duplicates.
pub fn variants(ways: &[Ways]) -> Vec<Variant> {
    let mut all: Vec<Variant> = vec![];
    for way in ways.iter().flat_map(|w| &w.0) {
        if !all.contains(way) {
            all.push(way.clone());
        }
    }
    all
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

    #[test]
    fn ways_have_the_name_they_were_given() {
        let all = |words: &[&str]| {
            let ways: Vec<_> = words.iter().map(|w| ways(w).unwrap()).collect();
            variants(&ways)
        };
        let found = all(&["default", "path-reuse=1+mirror-images=off", "default"]);
        let names: Vec<_> = found.iter().map(|v| v.name.as_str()).collect();
        assert_eq!(names, ["picofarm", "path-reuse=1+mirror-images=off"]);
        assert_eq!(found[0].strategy, Strategy::default());
        let both = found[1].strategy;
        assert_eq!(
            (both.path_reuse, both.mirror_images),
            (Some(1), Some(false))
        );
        assert!(
            ways("path-reuse=1+path-reuse=2")
                .unwrap_err()
                .contains("twice")
        );

        let each = all(&["each"]);
        assert_eq!(each.len(), 1 + Strategy::NAMES.len());
        assert_eq!(each[1].name, "path-reuse=1");
        assert!(each.iter().any(|v| v.name == "light-vertices=off"));
    }
}
