//! `--strategies`: the variants of a renderer that a benchmark compares.

use picofarm_cli::args::strategy;
use picofarm_settings::Strategy;

/// A set of strategies for comparison in a benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    pub name: String,
    pub strategy: Strategy,
}

/// The variants of one word of `--strategies`.
#[derive(Debug, Clone, PartialEq)]
pub struct Word(Vec<Variant>);

/// Parses `default`, `each` (each strategy turned off in turn), `path-reuse=1` or
/// `path-reuse=1+mirror-images=off`.
///
/// # Errors
/// Returns the errors of `strategy::parse`, or an error if a strategy is chosen twice.
pub fn parse(text: &str) -> Result<Word, String> {
    let default = Variant {
        name: "picofarm".into(),
        strategy: Strategy::default(),
    };
    let read = |text: &str| -> Result<Variant, String> {
        let chosen = text
            .split('+')
            .map(strategy::parse)
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Variant {
            name: text.into(),
            strategy: strategy::together(&chosen).map_err(|e| e.message)?,
        })
    };
    match text {
        "default" => Ok(Word(vec![default])),
        "each" => {
            // A strategy without a switch is a size, and size 1 turns it off.
            let without = |name: &str| {
                let name = name.replace('_', "-");
                read(&format!("{name}=off")).or_else(|_| read(&format!("{name}=1")))
            };
            let all = Strategy::NAMES
                .into_iter()
                .map(without)
                .collect::<Result<Vec<_>, _>>()?;
            Ok(Word([vec![default], all].concat()))
        }
        _ => Ok(Word(vec![read(text)?])),
    }
}

/// Returns all variants to compare, in order and without duplicates.
pub fn variants(words: &[Word]) -> Vec<Variant> {
    let mut all: Vec<Variant> = vec![];
    for variant in words.iter().flat_map(|word| &word.0) {
        if !all.contains(variant) {
            all.push(variant.clone());
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_variant_has_the_name_it_was_given() {
        let all = |words: &[&str]| {
            let words: Vec<_> = words.iter().map(|w| parse(w).unwrap()).collect();
            variants(&words)
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
            parse("path-reuse=1+path-reuse=2")
                .unwrap_err()
                .contains("twice")
        );

        let each = all(&["each"]);
        assert_eq!(each.len(), 1 + Strategy::NAMES.len());
        assert_eq!(each[1].name, "path-reuse=1");
        assert!(each.iter().any(|v| v.name == "light-vertices=off"));
    }
}
