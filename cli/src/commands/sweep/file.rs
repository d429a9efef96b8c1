//! Edits a job file so that its sweep lists the values of all its trials. The rest of the file,
//! including comments, does not change.

use super::search::Values;
use serde_json::Value;
use toml_edit::{Array, DocumentMut, InlineTable, Item, TableLike};

/// Returns the text of a job file with these trials in the sweep of a stage. The best trial
/// receives the name `promote`.
///
/// # Errors
/// Returns a message about an error in the file, or about the missing stage.
pub fn with_values(
    text: &str,
    stage: &str,
    values: &[Values],
    promote: &str,
) -> Result<String, String> {
    let mut document: DocumentMut = text.parse().map_err(|e| format!("{e}"))?;
    let stages = document.get_mut("stage");
    let stages = stages.and_then(Item::as_array_of_tables_mut);
    let stages = stages.ok_or("its stages are not written as [[stage]]; write them so")?;
    let text_of = |table: &toml_edit::Table, key: &str| {
        table.get(key).and_then(Item::as_str).map(str::to_owned)
    };
    let sweep = stages
        .iter_mut()
        .filter(|table| {
            let name = text_of(table, "name").or_else(|| text_of(table, "kind"));
            name.as_deref() == Some(stage)
        })
        .find_map(|table| table.get_mut("sweep")?.as_table_like_mut());
    let sweep = sweep.ok_or_else(|| {
        format!(
            "no [[stage]] with a sweep is called {stage:?} as it stands there; a stage with a matrix, or whose name has \
             values in it, stands for several: write the one that is meant out"
        )
    })?;
    set(sweep, "values", list(values).into());
    sweep.remove("trials");
    set(sweep, "promote", promote.into());
    Ok(document.to_string())
}

/// Sets a value without removing the comments next to it.
fn set(table: &mut dyn TableLike, key: &str, mut value: toml_edit::Value) {
    match table.get_mut(key).and_then(Item::as_value_mut) {
        Some(there) => {
            *value.decor_mut() = there.decor().clone();
            *there = value;
        }
        None => {
            table.insert(key, Item::Value(value));
        }
    }
}

/// Formats a line for each trial.
fn list(values: &[Values]) -> Array {
    let mut list = Array::new();
    for trial in values {
        let mut table = InlineTable::new();
        for (name, value) in trial {
            table.insert(name, toml(value));
        }
        let mut table = toml_edit::Value::from(table);
        table.decor_mut().set_prefix("\n    ");
        list.push_formatted(table);
    }
    list.set_trailing_comma(true);
    list.set_trailing("\n");
    list
}

fn toml(value: &Value) -> toml_edit::Value {
    match value {
        Value::Bool(truth) => (*truth).into(),
        Value::String(text) => text.as_str().into(),
        Value::Array(items) => Array::from_iter(items.iter().map(toml)).into(),
        Value::Object(table) => {
            let pairs = table
                .iter()
                .map(|(name, value)| (name.as_str(), toml(value)));
            InlineTable::from_iter(pairs).into()
        }
        Value::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(whole), _) => whole.into(),
            (None, Some(number)) => number.into(),
            (None, None) => number.to_string().into(),
        },
        // TOML has no null, so no job file contains one.
        Value::Null => "".into(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn values(lr: f64, width: i64) -> Values {
        [
            ("lr".to_owned(), json!(lr)),
            ("width".to_owned(), json!(width)),
        ]
        .into()
    }

    fn read(text: &str) -> Value {
        serde_json::to_value(toml::from_str::<toml::Table>(text).unwrap()).unwrap()
    }

    #[test]
    fn a_file_keeps_its_comments_and_lists_its_trials() {
        let text = "# A sweep.\nname = \"n\"\n\n[[stage]]\nname = \"rooms\"  # rendered once\n\n[[stage]]\nname = \"tof\"\n\
                    kind = \"train\"\n[stage.sweep]\ntrials = 2   # drawn\nseed = 1 # of draws\n\
                    [stage.sweep.over]\nlr = { log = [1e-4, 1e-1] }  # rates\nwidth = { int = [2, 9] }\n\
                    [stage.train]\nmodel = \"m\"\n";
        let out = with_values(text, "tof", &[values(0.001, 8), values(1e-4, 2)], "m-2").unwrap();
        assert_eq!(
            out,
            "# A sweep.\nname = \"n\"\n\n[[stage]]\nname = \"rooms\"  # rendered once\n\n[[stage]]\nname = \"tof\"\n\
             kind = \"train\"\n[stage.sweep]\nseed = 1 # of draws\n\
             values = [\n    { lr = 0.001, width = 8 },\n    { lr = 0.0001, width = 2 },\n]\npromote = \"m-2\"\n\
             [stage.sweep.over]\nlr = { log = [1e-4, 1e-1] }  # rates\nwidth = { int = [2, 9] }\n\
             [stage.train]\nmodel = \"m\"\n"
        );
        // Applied again to its own output.
        let again = with_values(&out, "tof", &[values(0.001, 8)], "m-1").unwrap();
        assert_eq!(
            read(&again)["stage"][1]["sweep"]["values"],
            json!([{"lr": 0.001, "width": 8}])
        );
        assert_eq!(read(&again)["stage"][1]["sweep"]["promote"], "m-1");
    }

    #[test]
    fn a_sweep_in_one_line_is_extended_too() {
        let text = "[[stage]]\nkind = \"train\"\nsweep = { trials = 1, over = { lr = [1, 2] } }\n";
        let out = with_values(
            text,
            "train",
            &[[("lr".to_owned(), json!(2))].into()],
            "m-1",
        )
        .unwrap();
        let sweep = &read(&out)["stage"][0]["sweep"];
        assert_eq!(
            *sweep,
            json!({"over": {"lr": [1, 2]}, "values": [{"lr": 2}], "promote": "m-1"})
        );
    }

    #[test]
    fn a_stage_that_is_not_there_is_named() {
        let text = "[[stage]]\nname = \"a\"\nkind = \"train\"\n";
        let error = with_values(text, "b[1]", &[], "m").unwrap_err();
        assert!(
            error.contains("\"b[1]\"") && error.contains("write the one that is meant out"),
            "{error}"
        );
        let error = with_values("stage = []", "b", &[], "m").unwrap_err();
        assert!(error.contains("[[stage]]"), "{error}");
    }

    proptest! {
        #[test]
        fn numbers_and_texts_come_back_to_the_bit(lr in any::<f64>().prop_filter("finite", |x| x.is_finite()), n: i64, text: String, truth: bool) {
            let trial: Values = [
                ("lr".to_owned(), json!(lr)), ("n".to_owned(), json!(n)), ("text".to_owned(), json!(text)), ("truth".to_owned(), json!(truth)),
                ("list".to_owned(), json!([{"a b": [lr]}, text])),
            ].into();
            let file = "[[stage]]\nkind = \"train\"\nsweep = {}\n";
            let out = with_values(file, "train", std::slice::from_ref(&trial), "m").unwrap();
            let found = read(&out)["stage"][0]["sweep"]["values"][0].clone();
            prop_assert_eq!(found, serde_json::to_value(&trial).unwrap());
        }
    }
}
