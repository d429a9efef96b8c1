//! Tests of `picofarm scene sense`.

use futures::executor::block_on;
use picofarm_dataset::{
    Dataset, DatasetSpec, Intrinsics, Profile, Provenance, SceneRecord, SingleRenderParts, Subsets,
    Wavelength, write_single_render,
};

use super::*;
use crate::args::SensorArgs;

fn args(folder: &Path, out: &str) -> SceneSense {
    SceneSense {
        render: folder.join("render"),
        out: folder.join(out),
        sensor: SensorArgs {
            rebin: Some(4),
            ..SensorArgs::default()
        },
        on_counts: false,
        seed: 7,
        scene: 0,
        threads: Some(1),
    }
}

fn measure(args: &SceneSense) -> Result<Report> {
    sense(args, &sensor::settings(&args.sensor)?)
}

/// A render of 3×2 pixels and 50 bins of 8 ps, as `scene render --split` writes it.
fn rendered(folder: &Path) {
    rendered_in(folder, 0.01);
}

/// The same with another unit of light.
fn rendered_in(folder: &Path, unit: f32) {
    let shape = [3u64, 2, 50];
    let two: Vec<f32> = (0..300)
        .map(|i| if i % 50 == 20 { unit } else { 0.0 })
        .collect();
    let mut transient = two.clone();
    transient[5] = 5.0 * unit;
    let spec = DatasetSpec {
        scenes: 1,
        height: 3,
        width: 2,
        spots: 1,
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: 1.0,
            bin_width_m: 0.002_398_34,
            bins: 50,
        },
        profile: Profile::LOSSLESS,
    };
    let record = SceneRecord {
        transient: &transient,
        subsets: &[],
        depth: &[1.0; 6],
        range: &[1.0; 6],
        normal: &[0.0; 18],
        instance: &[1; 6],
        label: &[1; 6],
        specular: &[0; 6],
        visibility: &[1; 6],
        two_bounce: &[],
        rgb: &[0.5; 18],
        spots: &[None],
        intrinsics: Intrinsics {
            fx: 2.0,
            fy: 2.0,
            cx: 1.0,
            cy: 1.5,
        },
        camera: [[0.0; 4]; 4],
        laser: [0.0; 3],
        scale: 1.0,
    };
    let provenance = Provenance {
        task_key: "a test".into(),
        renderer: "transient-1".into(),
        seed: 0,
        plan: Value::Null,
    };
    let attributes = json!({
        "scene": "room", "camera": {"a": 1}, "spots": [], "renderer": "transient-1", "gate": spec.gate,
    });
    let two = RenderArray {
        name: "two",
        shape: &shape,
        dimension_names: &["row", "column", "bin"],
        data: &two,
    };
    let parts = SingleRenderParts {
        arrays: &[two],
        attributes: attributes.as_object().unwrap(),
        picture: b"",
    };
    let encode = |dataset: &Dataset| dataset.encode(0, &record, &provenance);
    let dir = folder.join("render");
    block_on(write_single_render(&dir, &spec, encode, &parts)).unwrap();
}

#[test]
fn photon_counts_get_noise_only_when_asked_and_say_so() {
    let folder = tempfile::tempdir().unwrap();
    rendered_in(folder.path(), 1.0);
    let mut args = args(folder.path(), "again");
    let Err(refused) = measure(&args) else {
        panic!("photon counts");
    };
    assert!(
        refused.message.contains("photon counts"),
        "{}",
        refused.message
    );
    assert!(refused.hint.unwrap().contains("--on-counts"));
    args.on_counts = true;
    let made = measure(&args).unwrap_or_else(|e| panic!("{}", e.message));
    assert!(made.text.contains("photon counts"), "{}", made.text);
}

#[test]
fn counts_and_rates_are_written_with_all_that_made_them() {
    let folder = tempfile::tempdir().unwrap();
    rendered(folder.path());
    let with = |out: &str, change: fn(&mut SensorArgs)| {
        let mut args = args(folder.path(), out);
        change(&mut args.sensor);
        args
    };
    let counts = measure(&with("counts", |s| {
        s.peak_photons = Some("100".into());
    }))
    .unwrap();
    assert_eq!(counts.facts["data_type"], "uint16");
    assert_eq!(counts.facts["scale_from"], "two");
    assert_eq!(counts.facts["peak_photons"], 100.0);
    assert!(
        counts.text.contains("last 2 bin(s) left over"),
        "{}",
        counts.text
    );
    let group = RenderGroup::open(&folder.path().join("counts")).unwrap();
    let (shape, values) = group.read::<u16>("counts").unwrap();
    assert_eq!(shape, [3, 2, 12]);
    let sum: f64 = values.iter().map(|v| f64::from(*v)).sum();
    assert_eq!(counts.facts["photons"], sum);
    let a = group.attributes();
    assert_eq!(a["gate"]["bins"], 12);
    assert_eq!(a["gate"]["bin_width_m"], 4.0 * 0.002_398_34);
    assert_eq!(a["render"]["gate"]["bins"], 50);
    assert_eq!(a["render"]["renderer"], "transient-1");
    assert_eq!(a["camera"]["a"], 1);
    assert_eq!(a["dropped"]["bins"], 2);
    let sensor: Sensor = serde_json::from_value(a["sensor"].clone()).unwrap();
    assert_eq!(sensor.scale, Scale::Peak { photons: 100.0 });
    let mut expected = with("rate", |s| s.no_poisson = true);
    expected.sensor.photons_per_unit = a["scale"].as_f64();
    let rate = measure(&expected).unwrap();
    assert_eq!(rate.facts["data_type"], "float32");
    let group = RenderGroup::open(&folder.path().join("rate")).unwrap();
    let (_, rate) = group.read::<f32>("rate").unwrap();
    let expected: f64 = rate.iter().map(|r| f64::from(*r)).sum();
    assert!((sum - expected).abs() < 5.0 * expected.sqrt());
    // Bright counts need 32 bits.
    let bright = measure(&with("bright", |s| s.photons_per_unit = Some(1e8))).unwrap();
    assert_eq!(bright.facts["data_type"], "uint32");
}

#[test]
fn zones_and_bins_of_the_sensor_are_those_of_the_counts() {
    let folder = tempfile::tempdir().unwrap();
    rendered(folder.path());
    let with = |out: &str, change: fn(&mut SensorArgs)| {
        let mut args = args(folder.path(), out);
        args.sensor.rebin = None;
        args.sensor.zones = Some("1x2".into());
        change(&mut args.sensor);
        args
    };
    let zones = measure(&with("zones", |s| {
        s.gate = Some("3335,20,10".into());
        s.photons_per_unit = Some(1e4);
    }))
    .unwrap();
    assert_eq!(zones.facts["shape"], json!([1, 2, 10]));
    assert_eq!(zones.facts["notes"], json!([]));
    assert_eq!(zones.facts["gate"]["bins"], 10);
    let start = zones.facts["gate"]["start_m"].as_f64().unwrap();
    assert!((start - 3335.0 / PS_PER_M).abs() < 1e-9);
    let bought = measure(&with("bought", |s| {
        s.preset = Some(crate::args::PresetArg(picofarm_sensor::Preset::Tmf8828));
    }))
    .unwrap();
    assert_eq!(bought.facts["shape"], json!([1, 2, 128]));
    assert_eq!(bought.facts["scale_from"], "transient");
    for part in ["63°", "one flash", "the render's 1 spots", "assumed"] {
        assert!(bought.text.contains(part), "{part}: {}", bought.text);
    }
    let camera = json!({"intrinsics": {"fx": 8.0, "fy": 6.0, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}});
    let sensor = Sensor {
        zones: Some(picofarm_sensor::Zones {
            rows: 2,
            columns: 4,
        }),
        ..Sensor::default()
    };
    let expected = json!({"intrinsics": {"fx": 4.0, "fy": 2.0, "cx": 2.0, "cy": 1.0, "width": 4, "height": 2}});
    assert_eq!(zoned(&camera, &sensor), expected);
}

#[test]
fn nothing_is_overwritten_and_faults_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    rendered(folder.path());
    let list = || {
        let mut all: Vec<_> = std::fs::read_dir(folder.path())
            .unwrap()
            .map(|e| e.unwrap().file_name())
            .collect();
        all.sort();
        all
    };
    let before = list();
    let fails = |args: SceneSense| {
        let Err(error) = measure(&args) else {
            panic!("expected an error")
        };
        (error.code, error.message)
    };
    let (_, message) = fails(args(folder.path(), "render"));
    assert!(message.contains("not empty"), "{message}");
    let (code, message) = fails(SceneSense {
        render: folder.path().join("absent"),
        ..args(folder.path(), "out")
    });
    assert!(
        code == Code::Input && message.contains("absent"),
        "{message}"
    );
    let with = |change: fn(&mut SensorArgs)| {
        let mut args = args(folder.path(), "out");
        change(&mut args.sensor);
        args
    };
    let (_, message) = fails(with(|s| s.rebin = Some(51)));
    assert!(message.contains("rebin: expected 1 to 50"), "{message}");
    let (_, message) = fails(with(|s| s.dark = Some(-1.0)));
    assert!(message.contains("sensor.dark_per_bin"), "{message}");
    let chunk = folder.path().join("render/transient/c/0/0/0/0");
    let mut bytes = std::fs::read(&chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&chunk, bytes).unwrap();
    let (code, message) = fails(args(folder.path(), "out"));
    assert!(
        code == Code::Damaged && message.contains("transient/c/0/0/0/0"),
        "{message}"
    );
    assert_eq!(list(), before);
}
