//! Whether histograms are photon counts, to which no sensor's noise may be added unasked.

use picofarm_dataset::whole_photons;
use serde_json::Value;

/// Returns whether the histogram of a scene is one of photon counts: its plan states that a sensor
/// drew it or that it was counted, or its values are whole numbers of photons and some are not 0.
/// `scale` converts values to photons.
pub fn are_counts(histogram: &[f32], scale: f32, plan: &Value) -> bool {
    let value = plan["value"].as_str();
    if value.is_some_and(|value| value.starts_with("counts")) {
        return true;
    }
    whole_photons(histogram, scale)
}

/// Returns why a sensor with this field is refused for photon counts.
pub fn refusal(field: &str) -> String {
    format!(
        "the histograms are photon counts, which have the pulse, scale and noise of their own sensor; this one would add its \
         own to them (sensor.{field})"
    )
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn whole_photons_and_drawn_values_are_counts_and_light_is_not() {
        let unsaid = json!({});
        assert!(are_counts(&[0.0, 0.5, 3.5], 2.0, &unsaid));
        assert!(!are_counts(&[0.0, 0.5, 3.4], 2.0, &unsaid));
        assert!(
            !are_counts(&[0.0, 0.0], 2.0, &unsaid),
            "no light is no count"
        );
        let drawn = json!({"value": "counts: photons"});
        assert!(are_counts(&[0.1], 2.0, &drawn), "a code may round counts");
        let scale = 1e4f32 / 3.0;
        let counts: Vec<f32> = (0..5000).map(|n| n as f32 / scale).collect();
        assert!(are_counts(&counts, scale, &unsaid));
    }
}
