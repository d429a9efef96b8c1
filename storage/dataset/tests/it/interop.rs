//! Tests that zarr-python and xarray read the same values from our data sets and render groups,
//! without our code. They run if `PICOFARM_PYTHON` names a Python with numpy, zarr and xarray.

use crate::common;

use std::path::Path;
use std::process::Command;

use common::*;
use picofarm_dataset::*;
use picofarm_store::*;
use serde_json::{Map, Value, json};

struct Expected<'a> {
    folder: &'a Path,
    shapes: Map<String, Value>,
}

impl Expected<'_> {
    fn add<T: bytemuck::Pod>(&mut self, name: &str, dtype: &str, shape: &[u64], values: &[T]) {
        assert_eq!(shape.iter().product::<u64>(), values.len() as u64, "{name}");
        std::fs::write(
            self.folder.join(format!("{name}.bin")),
            bytemuck::cast_slice(values),
        )
        .unwrap();
        self.shapes.insert(name.into(), json!([dtype, shape]));
    }
}

/// Reorders images of 36×40 pixels and 24 bins from `[row][column][bin]` to `[bin][row][column]`.
fn by_bin<T: Copy>(values: &[T]) -> Vec<T> {
    let images = values.chunks_exact(36 * 40 * 24);
    images
        .flat_map(|image| (0..24).flat_map(|bin| image.iter().skip(bin).step_by(24)))
        .copied()
        .collect()
}

#[tokio::test]
async fn zarr_python_and_xarray_read_the_same_values() {
    let Some(python) = std::env::var_os("PICOFARM_PYTHON") else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, zarr and xarray to run this test"
        );
        return;
    };
    for name in Profile::NAMES {
        let profile = Profile::parse(name).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let data = folder.path().join("data set");
        let expected = folder.path().join("expected");
        let render = folder.path().join("render");
        std::fs::create_dir(&expected).unwrap();
        let spec = DatasetSpec {
            per_spot: true,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            ..spec(profile)
        };
        let (store, prefix) = open_store(data.to_str().unwrap()).unwrap();
        let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
        let mut scene = Scene::new(&spec, 8);
        scene.transient[123] = 5e9 / scene.scale;
        let mut alone: Vec<Vec<f32>> = (9..18).map(|i| Scene::new(&spec, i).transient).collect();
        if profile == Profile::CountsU16 {
            let whole = |h: &mut f32| *h = (*h * scene.scale).round() / scene.scale;
            alone.iter_mut().flatten().for_each(whole);
            scene.transient.iter_mut().for_each(whole);
        }
        let subsets = [SubsetRecord {
            quantity: Quantity::TransientSpots,
            planes: alone.iter().map(Vec::as_slice).collect(),
        }];
        let record = SceneRecord {
            subsets: &subsets,
            ..scene.record()
        };
        dataset.publish(1, &record, &provenance()).await.unwrap();

        let h = dataset.read_transient(1).await.unwrap();
        let mut e = Expected {
            folder: &expected,
            shapes: Map::new(),
        };
        let alone = alone.concat();
        let (one, nine) = (&[24, 36, 40], &[9, 24, 36, 40]);
        match profile {
            Profile::SqrtU16 { delta } => {
                let code = SquareRoot::new(delta, scene.scale);
                let q: Vec<u16> = scene.transient.iter().map(|h| code.encode(*h)).collect();
                let each: Vec<u16> = alone.iter().map(|h| code.encode(*h)).collect();
                e.add("transient", "<u2", one, &by_bin(&q));
                e.add("transient_spots", "<u2", nine, &by_bin(&each));
            }
            Profile::CountsU16 => {
                let whole = |h: &f32| (h * scene.scale).round().min(65_535.0) as u16;
                let q: Vec<u16> = scene.transient.iter().map(whole).collect();
                let each: Vec<u16> = alone.iter().map(whole).collect();
                e.add("transient", "<u2", one, &by_bin(&q));
                e.add("transient_spots", "<u2", nine, &by_bin(&each));
            }
            Profile::PlainF32 { .. } => {
                let spots = dataset.read_histogram(1, Quantity::TransientSpots).await;
                e.add("transient", "<f4", one, &by_bin(&h));
                e.add("transient_spots", "<f4", nine, &by_bin(&spots.unwrap()));
            }
        }
        let f32s = [
            (Quantity::Intensity, vec![36, 40]),
            (Quantity::Depth, vec![36, 40]),
            (Quantity::Range, vec![36, 40]),
            (Quantity::Spots, vec![9, 7]),
            (Quantity::Intrinsics, vec![4]),
            (Quantity::Camera, vec![4, 4]),
            (Quantity::Laser, vec![3]),
            (Quantity::Scale, vec![]),
        ];
        for (quantity, shape) in f32s {
            let values = dataset.read::<f32>(1, quantity).await.unwrap();
            e.add(quantity.name(), "<f4", &shape, &values);
        }
        let u8s = [
            (Quantity::Specular, vec![36, 40]),
            (Quantity::Visibility, vec![2, 36, 40]),
            (Quantity::Rgb, vec![36, 40, 3]),
        ];
        for (quantity, shape) in u8s {
            e.add(
                quantity.name(),
                "|u1",
                &shape,
                &dataset.read::<u8>(1, quantity).await.unwrap(),
            );
        }
        e.add("instance", "<u4", &[36, 40], &scene.instance);
        e.add("label", "<u2", &[36, 40], &scene.label);
        e.add(
            "normal",
            "<i2",
            &[36, 40, 3],
            &dataset.read::<i16>(1, Quantity::Normal).await.unwrap(),
        );
        e.add(
            "n",
            "<f4",
            &[36, 40, 3],
            &dataset.read_normal(1).await.unwrap(),
        );
        e.add("lit", "|u1", &[9, 36, 40], &scene.visibility);
        e.add("h", "<f4", &[24, 36, 40], &by_bin(&h));
        std::fs::write(
            expected.join("shapes.json"),
            Value::from(e.shapes).to_string(),
        )
        .unwrap();
        let arrays = [RenderArray {
            name: "transient",
            shape: &[36, 40, 24],
            dimension_names: &["row", "column", "bin"],
            data: &h,
        }];
        let attributes = Map::from_iter([("note".to_string(), json!("made by a test"))]);
        write_render_group(&render, &arrays, &attributes).unwrap();

        let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
            .join("../../tests/interop/read_dataset.py");
        let output = Command::new(&python)
            .args([
                script.as_os_str(),
                data.as_os_str(),
                "1".as_ref(),
                expected.as_os_str(),
                render.as_os_str(),
            ])
            .output()
            .unwrap();
        let (out, err) = (
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr),
        );
        println!("{profile:?}\n{out}");
        assert!(output.status.success(), "{profile:?}\n{out}\n{err}");
    }
}
