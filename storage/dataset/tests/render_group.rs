//! Render groups: exact, all or nothing, and never over something else.

use picofarm_dataset::{RenderArray, write_render_group};
use proptest::prelude::*;
use serde_json::{Map, json};
use zarrs::array::{Array, ArraySubset};
use zarrs::filesystem::FilesystemStore;

fn array<'a>(
    name: &'a str,
    shape: &'a [u64],
    names: &'a [&'a str],
    data: &'a [f32],
) -> RenderArray<'a> {
    RenderArray {
        name,
        shape,
        dimension_names: names,
        data,
    }
}

#[test]
fn arrays_of_every_rank_come_back_bit_for_bit_through_zarrs() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("new/render");
    // 2,112,000 values: several chunks, cut off at the edges.
    let shape = [55, 60, 640];
    let data: Vec<f32> = (0..55 * 60 * 640).map(|i| i as f32 * 0.37 - 5e4).collect();
    let special = [f32::NAN, f32::INFINITY, -0.0, 1e-42];
    let arrays = [
        array("transient", &shape, &["row", "column", "bin"], &data),
        array("long", &[2_112_000], &["i"], &data),
        array("special", &[4], &["j"], &special),
        array("scalar", &[], &[], &special[1..2]),
    ];
    write_render_group(&dir, &arrays, &Map::from_iter([("a".into(), json!(1))])).unwrap();
    let store = std::sync::Arc::new(FilesystemStore::new(&dir).unwrap());
    for wanted in arrays {
        let array = Array::open(store.clone(), &format!("/{}", wanted.name)).unwrap();
        let all = ArraySubset::new_with_shape(wanted.shape.to_vec());
        let values: Vec<f32> = array.retrieve_array_subset(&all).unwrap();
        let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert!(bits(&values) == bits(wanted.data), "{}", wanted.name);
    }
    assert_eq!(
        std::fs::read_dir(folder.path().join("new"))
            .unwrap()
            .count(),
        1
    );
}

#[test]
fn nothing_is_overwritten_and_a_failure_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let one = [array("a", &[1], &["x"], &[1.0])];
    // An empty folder is taken, a full one and a file are not.
    write_render_group(folder.path(), &one, &Map::new()).unwrap();
    let error = write_render_group(folder.path(), &one, &Map::new())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("is not empty, and nothing is overwritten"),
        "{error}"
    );
    let file = folder.path().join("zarr.json");
    let error = write_render_group(&file, &one, &Map::new())
        .unwrap_err()
        .to_string();
    assert!(error.contains("is a file"), "{error}");
    let wrong = [
        (
            array("a/b", &[1], &["x"], &[1.0]),
            "expected a name of letters",
        ),
        (array("a", &[2], &["x"], &[1.0]), "expected 2 values"),
        (
            array("a", &[1], &[], &[1.0]),
            "expected 1 dimension names, found 0",
        ),
    ];
    let dir = folder.path().join("sub");
    for (array, words) in wrong {
        let error = write_render_group(&dir, &[array], &Map::new())
            .unwrap_err()
            .to_string();
        assert!(error.contains(words), "{error}");
        assert!(!dir.exists());
    }
    let twice = write_render_group(&dir, &[one[0], one[0]], &Map::new())
        .unwrap_err()
        .to_string();
    assert!(twice.contains("found it twice"), "{twice}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 16, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_shape_round_trips(shape in proptest::collection::vec(1u64..12, 1..4)) {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path().join("g");
        let n: u64 = shape.iter().product();
        let data: Vec<f32> = (0..n).map(|i| i as f32).collect();
        let names = &["a", "b", "c"][..shape.len()];
        write_render_group(&dir, &[array("x", &shape, names, &data)], &Map::new()).unwrap();
        let store = std::sync::Arc::new(FilesystemStore::new(&dir).unwrap());
        let values: Vec<f32> = Array::open(store, "/x").unwrap()
            .retrieve_array_subset(&ArraySubset::new_with_shape(shape)).unwrap();
        prop_assert_eq!(values, data);
    }
}
