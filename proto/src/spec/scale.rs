//! One job file in several sizes. `[scale.NAME]` gives values. Anywhere else in the file the text
//! `"{side}"` becomes the value of `side`, and `{side}` inside a longer text becomes the value's
//! text. `--scale NAME` chooses a scale.

use serde_json::Value;

use super::{
    spec_error::SpecError,
    substitute::{plain, substitute},
};

/// Returns a job file's content at a scale, with values filled in and without its scales.
///
/// # Errors
/// Returns a [`SpecError`] if the file has no such scale, if it has scales and none is chosen, or
/// if its scales do not have the same values.
pub fn scaled(mut job: Value, scale: Option<&str>) -> Result<Value, SpecError> {
    let fail = |what: String| Err(SpecError::new("scale", what));
    let scales = job.as_object_mut().and_then(|job| job.remove("scale"));
    let (scales, scale) = match (scales, scale) {
        (None, None) => return Ok(job),
        (None, Some(name)) => {
            return fail(format!(
                "the job file has no [scale.{name}]; leave --scale away"
            ));
        }
        (Some(Value::Object(scales)), scale) => (scales, scale),
        (Some(_), _) => return fail("must be tables, e.g. [scale.mini]".into()),
    };
    let names: Vec<&str> = scales.keys().map(String::as_str).collect();
    let Some(scale) = scale else {
        return fail(format!(
            "the job file has several sizes; choose one: --scale {}",
            names.join(" | ")
        ));
    };
    let Some(values) = scales.get(scale).and_then(Value::as_object) else {
        return fail(format!(
            "there is no [scale.{scale}], only {}",
            names.join(", ")
        ));
    };
    for (name, other) in &scales {
        let missing = |key: &&String| other.get(key.as_str()).is_none();
        if let Some(key) = values.keys().find(missing) {
            return fail(format!(
                "[scale.{name}] has no {key:?}, which [scale.{scale}] has"
            ));
        }
    }
    for (name, value) in values {
        substitute(&mut job, &format!("{{{name}}}"), value);
    }
    if let Some(object) = job.as_object_mut()
        && let Some(Value::String(title)) = object.get_mut("name")
    {
        *title = format!("{title} ({})", plain(&Value::String(scale.into())));
    }
    Ok(job)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn job() -> Value {
        json!({
            "name": "shadows",
            "scale": { "mini": { "side": 32, "kind": "primitive" }, "paper": { "side": 256, "kind": "furnished" } },
            "stage": [{ "name": "render-{side}", "render": { "resolution": "{side}" }, "matrix": { "seed": [1, 2] },
                        "model": "m-{seed}" }],
        })
    }

    #[test]
    fn values_stand_where_they_are_named_and_parameters_of_matrices_stay() {
        let mini = scaled(job(), Some("mini")).unwrap();
        assert_eq!(
            mini,
            json!({
                "name": "shadows (mini)",
                "stage": [{ "name": "render-32", "render": { "resolution": 32 }, "matrix": { "seed": [1, 2] },
                            "model": "m-{seed}" }],
            })
        );
    }

    #[test]
    fn a_scale_must_be_chosen_must_be_there_and_must_be_whole() {
        let error = |job, scale| scaled(job, scale).unwrap_err().to_string();
        assert_eq!(
            error(job(), None),
            "scale: the job file has several sizes; choose one: --scale mini | paper"
        );
        assert_eq!(
            error(job(), Some("huge")),
            "scale: there is no [scale.huge], only mini, paper"
        );
        let mut partly = job();
        partly["scale"]["paper"]
            .as_object_mut()
            .unwrap()
            .remove("kind");
        assert_eq!(
            error(partly, Some("mini")),
            "scale: [scale.paper] has no \"kind\", which [scale.mini] has"
        );
        assert_eq!(
            error(json!({ "name": "x" }), Some("mini")),
            "scale: the job file has no [scale.mini]; leave --scale away"
        );
        assert_eq!(
            scaled(json!({ "name": "x" }), None).unwrap(),
            json!({ "name": "x" })
        );
    }
}
