//! Expands a stage with `matrix = { … }` into one stage for each combination of values.

use serde_json::{Map, Value};

use super::{
    limits::MAX_STAGES,
    spec_error::SpecError,
    substitute::{plain, substitute},
};

/// Returns the instances of a stage with a matrix. A stage without one is returned unchanged.
pub(super) fn instances(mut stage: Value) -> Result<Vec<Value>, SpecError> {
    let Some(matrix) = stage.as_object_mut().and_then(|s| s.remove("matrix")) else {
        return Ok(vec![stage]);
    };
    let fail = |what: &str| Err(SpecError::new("stage.matrix", what));
    let Value::Object(matrix) = matrix else {
        return fail("must be a table of lists, e.g. { dark = [0.0, 0.1] }");
    };
    let mut parameters: Vec<(String, Value)> = matrix.into_iter().collect();
    parameters.sort_by(|a, b| a.0.cmp(&b.0));
    let mut choices: Vec<Vec<(String, Value)>> = vec![vec![]];
    for (name, values) in parameters {
        let Some(values) = values.as_array().filter(|v| !v.is_empty()) else {
            return fail(&format!("{name} must be a list of at least one value"));
        };
        if choices.len() * values.len() > MAX_STAGES {
            return fail(&format!("stands for more than {MAX_STAGES} stages"));
        }
        let with = |choice: &Vec<(String, Value)>, value: &Value| {
            let mut choice = choice.clone();
            choice.push((name.clone(), value.clone()));
            choice
        };
        choices = choices
            .iter()
            .flat_map(|choice| values.iter().map(|value| with(choice, value)))
            .collect();
    }
    let instance = |choice: Vec<(String, Value)>| {
        let mut stage = stage.clone();
        let values: Vec<String> = choice.iter().map(|(_, value)| plain(value)).collect();
        if let Some(table) = stage.as_object_mut() {
            name_instance(table, &values.join(","));
        }
        for (name, value) in &choice {
            substitute(&mut stage, &format!("{{{name}}}"), value);
        }
        stage
    };
    Ok(choices.into_iter().map(instance).collect())
}

/// Changes `name` to `name[values]`, unless the name contains its values already.
fn name_instance(stage: &mut Map<String, Value>, values: &str) {
    let kind = stage
        .get("kind")
        .and_then(Value::as_str)
        .unwrap_or("render");
    let name = stage.get("name").and_then(Value::as_str).unwrap_or(kind);
    if !name.contains('{') {
        let name = format!("{name}[{values}]");
        stage.insert("name".into(), Value::String(name));
    }
}

/// Returns the name of a matrix stage without its values: `tof` for `tof[125,1]`. Returns `None`
/// for a stage outside any matrix.
pub fn of_matrix(name: &str) -> Option<&str> {
    name.strip_suffix(']')?.split_once('[').map(|(of, _)| of)
}

/// Returns whether two stages belong to one matrix, by their names.
pub fn same_matrix(a: &str, b: &str) -> bool {
    of_matrix(a).is_some_and(|of| of_matrix(b) == Some(of))
}

/// Returns the common name of the stages of one matrix, `tof[…]`, or the name of a single stage.
/// Empty for no stage.
pub fn together(names: &[impl AsRef<str>]) -> String {
    match names {
        [] => String::new(),
        [name] => name.as_ref().to_owned(),
        [name, ..] => format!("{}[…]", of_matrix(name.as_ref()).unwrap_or(name.as_ref())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_of_one_matrix_are_told_by_their_names() {
        assert!(same_matrix("tof[1]", "tof[125,1]"));
        assert!(!same_matrix("tof[1]", "tof-stem[1]"));
        assert!(!same_matrix("tof", "tof"), "of no matrix");
        assert_eq!(together(&["tof[1]", "tof[2]"]), "tof[…]");
        assert_eq!(together(&["tof[1]"]), "tof[1]");
        assert_eq!(together(&["rooms"]), "rooms");
    }
}
