//! The filters of a gallery, as parameters of its address.

use maud::{Markup, html};

use super::super::parts::safe;
use crate::{
    answer::Problem,
    data::{Content, Contents},
    query::{Query, encode},
};

/// The selection and the order of a gallery's scenes.
#[derive(Debug, Default, PartialEq)]
pub struct Filter {
    /// The first and the last scene.
    scenes: [Option<u64>; 2],
    /// Only rooms of this type; empty = all.
    room: String,
    /// Only scenes with or without planar mirrors.
    mirrors: Option<bool>,
    /// Least and largest stated error, percent.
    error: [Option<f64>; 2],
    /// Only scenes whose manifest is damaged, or only others.
    damaged: Option<bool>,
    sort: Sort,
}

/// The order of the scenes.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
enum Sort {
    #[default]
    Scene,
    Error,
    Rays,
    Size,
}

const SORTS: [(&str, &str, Sort); 4] = [
    ("", "scene", Sort::Scene),
    ("error", "largest error first", Sort::Error),
    ("rays", "most rays first", Sort::Rays),
    ("size", "largest first", Sort::Size),
];
const CHOICES: [(&str, Option<bool>); 3] = [("", None), ("yes", Some(true)), ("no", Some(false))];
/// The parameters.
const NAMES: [&str; 8] = [
    "from", "to", "room", "mirrors", "least", "most", "damaged", "sort",
];

impl Filter {
    /// Reads the parameters.
    ///
    /// # Errors
    /// Names a wrong parameter, and what was expected.
    pub fn parse(query: &Query) -> Result<Self, Problem> {
        let choice = |name: &str| {
            let found = query.text(name);
            let choice = CHOICES.iter().find(|(word, _)| *word == found);
            let wrong = || Problem::input(format!("{name}: expected yes or no, found {found:?}"));
            choice.map(|(_, choice)| *choice).ok_or_else(wrong)
        };
        let percent = |name: &str| match query.text(name) {
            "" => Ok(None),
            text => match text.parse::<f64>() {
                Ok(value) if value >= 0.0 && value.is_finite() => Ok(Some(value)),
                _ => Err(Problem::input(format!(
                    "{name}: expected an error in percent, found {text:?}"
                ))),
            },
        };
        let sort = query.text("sort");
        let Some((_, _, sort)) = SORTS.into_iter().find(|(word, _, _)| *word == sort) else {
            return Err(Problem::input(format!(
                "sort: expected error, rays or size, found {sort:?}"
            )));
        };
        Ok(Self {
            scenes: [query.number("from")?, query.number("to")?],
            room: query.text("room").to_owned(),
            mirrors: choice("mirrors")?,
            error: [percent("least")?, percent("most")?],
            damaged: choice("damaged")?,
            sort,
        })
    }

    /// Returns whether manifests must be read.
    pub fn needs_contents(&self) -> bool {
        let scenes = self.scenes;
        *self
            != Self {
                scenes,
                ..Self::default()
            }
    }

    /// Returns the selected ones of `scenes`, in order.
    pub fn select(&self, scenes: &[u64], contents: Option<&Contents>) -> Vec<u64> {
        let [from, to] = self.scenes;
        let within = |scene: u64| from.is_none_or(|f| scene >= f) && to.is_none_or(|t| scene <= t);
        let scenes = scenes.iter().copied().filter(|scene| within(*scene));
        let Some(contents) = contents else {
            return scenes.collect();
        };
        let known = scenes.filter_map(|scene| Some((scene, contents.get(scene)?)));
        let mut chosen: Vec<_> = known.filter(|(_, content)| self.takes(content)).collect();
        let key = |content: &Content| match self.sort {
            Sort::Scene => 0.0,
            Sort::Error => content.error.unwrap_or(-1.0),
            Sort::Rays => content.rays.map_or(-1.0, |rays| rays as f64),
            Sort::Size => content.bytes as f64,
        };
        chosen.sort_by(|a, b| key(b.1).total_cmp(&key(a.1)));
        chosen.into_iter().map(|(scene, _)| scene).collect()
    }

    fn takes(&self, content: &Content) -> bool {
        let [least, most] = self.error;
        let percent = content.error.map(|error| 100.0 * error);
        let asked = least.is_some() || most.is_some();
        let error = percent.is_some_and(|error| {
            least.is_none_or(|least| error >= least) && most.is_none_or(|most| error <= most)
        });
        (self.room.is_empty() || content.room == self.room)
            && self
                .mirrors
                .is_none_or(|mirrors| mirrors == content.mirrors)
            && self
                .damaged
                .is_none_or(|damaged| damaged == content.damage.is_some())
            && (error || !asked)
    }

    /// Returns the path of a page of the gallery with the same filters.
    pub fn path(query: &Query, set: &str, start: usize) -> String {
        let start = if start == 0 {
            String::new()
        } else {
            start.to_string()
        };
        let mut pairs = vec![("set", set)];
        pairs.extend(NAMES.map(|name| (name, query.text(name))));
        pairs.push(("start", &start));
        format!("/data?{}", encode(&pairs))
    }

    /// Returns the form of the filters.
    pub fn form(query: &Query, set: &str, contents: Option<&Contents>) -> Markup {
        let number = |name: &str, step: &str| {
            html! { input name=(name) type="number" min="0" step=(step) value=(query.text(name)); }
        };
        let choice = |name: &str, words: [(&str, &str); 3]| {
            html! { select name=(name) { @for (value, text) in words {
                option value=(value) selected[query.text(name) == value] { (text) }
            } } }
        };
        html! {
            form.search action="/data" role="search" {
                input type="hidden" name="set" value=(set);
                label { "scenes from " (number("from", "1")) }
                label { "to " (number("to", "1")) }
                label { "room " input name="room" size="12" list="rooms" value=(query.text("room")); }
                datalist #rooms { @for room in contents.map(Contents::rooms).into_iter().flatten() {
                    option value=(safe(room)) {}
                } }
                label { "mirrors " (choice("mirrors", [("", "any"), ("yes", "with"), ("no", "without")])) }
                label { "error from " (number("least", "any")) }
                label { "to " (number("most", "any")) " %" }
                label { "manifest " (choice("damaged", [("", "any"), ("yes", "damaged"), ("no", "sound")])) }
                label { "order " select name="sort" { @for (value, text, _) in SORTS {
                    option value=(value) selected[query.text("sort") == value] { (text) }
                } } }
                button { "Show" }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Filter, String> {
        Filter::parse(&Query::parse(text)).map_err(|problem| problem.message)
    }

    #[test]
    fn only_filters_of_contents_need_manifests_and_wrong_ones_are_named() {
        assert!(!parse("from=3&to=9&start=24").unwrap().needs_contents());
        for text in [
            "room=kitchen",
            "mirrors=no",
            "least=5",
            "damaged=yes",
            "sort=size",
        ] {
            assert!(parse(text).unwrap().needs_contents(), "{text}");
        }
        for (text, name) in [
            ("mirrors=maybe", "mirrors: expected yes or no"),
            ("most=-1", "most: expected an error in percent"),
            ("sort=age", "sort: expected error, rays or size"),
            ("from=x", "from: expected a whole number"),
        ] {
            let found = parse(text).unwrap_err();
            assert!(found.starts_with(name), "{found}");
        }
    }

    #[test]
    fn a_scene_without_an_error_is_in_no_range_of_errors() {
        let with = |error| Content {
            error,
            room: "kitchen".into(),
            mirrors: true,
            ..Content::default()
        };
        let takes = |text: &str, error| parse(text).unwrap().takes(&with(error));
        assert!(takes("least=5&most=10", Some(0.07)));
        assert!(!takes("least=5&most=10", Some(0.2)));
        assert!(!takes("most=10", None) && takes("room=kitchen", None));
        assert!(!takes("room=bath", None) && !takes("mirrors=no", None));
        assert!(!takes("damaged=yes", None) && takes("damaged=no", None));
    }
}
