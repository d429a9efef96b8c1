//! Reprocess settings: dependencies of keys, and refusals.

use picofarm_proto::{
    key::{TaskKey, derived_key},
    spec::ReprocessSettings,
};

fn read(text: &str) -> Result<ReprocessSettings, toml::de::Error> {
    toml::from_str::<ReprocessSettings>(text).map(|mut settings| {
        settings.normalise();
        settings
    })
}

fn good(text: &str) -> ReprocessSettings {
    let settings = read(text).unwrap();
    settings.check("sqrt-u16").unwrap();
    settings
}

#[test]
fn everything_that_shapes_a_result_is_part_of_its_key_and_nothing_else_is() {
    let settings = [
        "",
        "histogram = \"transient_4\"",
        "histogram = \"transient_spots\"\nspots = [0, 5]",
        "histogram = \"transient_spots\"\nspots = [0, 6]",
        "seed = 1",
        "version = \"sensor-2\"",
        "drop_left_over = true",
        "[sensor]\nrebin = 4",
        "[sensor]\npoisson = false",
        "[sensor]\ndark_per_bin = 0.5",
        "[sensor]\npulse = { kind = \"none\" }",
        "[sensor]\njitter = { kind = \"sb3d_compat\" }",
        "[sensor]\nscale = { kind = \"peak\", photons = 100.0 }",
        "[sensor]\ndead_time = { kind = \"first_photon\", pulses = 7 }",
        "[sensor]\ndead_time = { kind = \"free_running\", pulses = 7, dead_ps = 1e4, period_ps = 1e5 }",
        "[sensor]\nzones = { rows = 8, columns = 8 }",
        "[sensor]\ngate = { start_ps = 0.0, bin_width_ps = 250.0, bins = 96 }",
        "[sensor]\ncrosstalk = { probability = 0.01 }",
        "[sensor]\nafterpulsing = { probability = 0.01, decay_ps = 1e4 }",
        "[sensor]\npreset = \"tmf8828\"",
        "[sensor]\npreset = \"tmf8828\"\nrebin = 2",
    ];
    let keys = settings.map(|text| good(text).stage_key("sqrt-u16"));
    for (i, key) in keys.iter().enumerate() {
        assert!(!keys[..i].contains(key), "{:?}", settings[i]);
    }
    assert_ne!(good("").stage_key("plain-f32"), keys[0]);
    // A preset is the same as its values.
    let values = picofarm_settings::Preset::Tmf8828.sensor();
    let values = ReprocessSettings {
        sensor: values,
        ..ReprocessSettings::default()
    };
    assert_eq!(
        values.stage_key("sqrt-u16"),
        good("[sensor]\npreset = \"tmf8828\"").stage_key("sqrt-u16")
    );
    // Defaults written out, and any order of fields, give the same key.
    let written = good("[sensor]\nrebin = 1\npulse = { kind = \"analytic\", fwhm_ps = 128.0 }");
    assert_eq!(written.stage_key("sqrt-u16"), keys[0]);
    let reversed = good("histogram = \"transient_spots\"\nspots = [5, 0]");
    assert_eq!(reversed.stage_key("sqrt-u16"), keys[2]);
    let tasks = [1, 2].map(|k| derived_key(&keys[0], &TaskKey([k; 32])));
    assert_ne!(tasks[0], tasks[1]);
    // This key names stored results, so it must never change.
    assert_eq!(tasks[0].to_string(), KEY);
}

const KEY: &str = "4512d45dc12a6dffcd02b87c3b8a8a5869f32c3bac2c971f8566f617f65b4323";

#[test]
fn what_cannot_be_used_is_named() {
    let field = |text: &str, profile: &str| read(text).unwrap().check(profile).unwrap_err().field;
    for (text, expected) in [
        ("spots = [1]", "reprocess.spots"),
        ("histogram = \"transient_spots\"", "reprocess.spots"),
        (
            "histogram = \"transient_spots\"\nspots = [1, 1]",
            "reprocess.spots",
        ),
        ("[sensor]\nrebin = 0", "reprocess.sensor.rebin"),
        (
            "[sensor]\ndark_per_bin = -1.0",
            "reprocess.sensor.dark_per_bin",
        ),
        (
            "[sensor]\npulse = { kind = \"analytic\", fwhm_ps = 0.0 }",
            "reprocess.sensor.pulse.fwhm_ps",
        ),
        (
            "[sensor]\npulse = { kind = \"sampled\", bin_width_ps = 8.0, values = [] }",
            "reprocess.sensor.pulse.values",
        ),
        (
            "[sensor]\nscale = { kind = \"peak_range\", low = 5.0, high = 4.0 }",
            "reprocess.sensor.scale.high",
        ),
        (
            "[sensor]\ndead_time = { kind = \"first_photon\", pulses = 0 }",
            "reprocess.sensor.dead_time.pulses",
        ),
        (
            "[sensor]\npreset = \"ads6311\"\nzones = { rows = 0, columns = 8 }",
            "reprocess.sensor.zones",
        ),
    ] {
        assert_eq!(field(text, "sqrt-u16"), expected, "{text}");
    }
    assert_eq!(
        field("[sensor]\npoisson = false", "counts-u16"),
        "output.profile"
    );
    for unknown in [
        "rebin = 4",
        "histogram = \"transient_9\"",
        "[sensor]\nnoise = 1",
    ] {
        let error = read(unknown).unwrap_err().to_string();
        let name = unknown.split(['=', '"']).nth(1).unwrap_or_default();
        assert!(error.contains("unknown"), "{name}: {error}");
    }
}
