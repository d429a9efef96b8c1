//! Tests of render groups: they are exact, written atomically, and never overwrite other files.

use picofarm_dataset::{RenderArray, RenderGroup, write_render_group};
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
    let group = RenderGroup::open(&dir).unwrap();
    assert_eq!(group.attributes()["a"], 1);
    assert!(group.has("long") && !group.has("short"));
    for wanted in arrays {
        let (shape, values) = group.read::<f32>(wanted.name).unwrap();
        assert_eq!(shape, wanted.shape);
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
    // An empty folder is accepted; a non-empty one and a file are not.
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

#[test]
fn counts_are_written_in_their_own_type_and_read_by_zarrs_and_by_us() {
    let folder = tempfile::tempdir().unwrap();
    let names = ["row", "column", "bin"];
    let shape = [70, 61, 250];
    let wide: Vec<u32> = (0..70 * 61 * 250).map(|i| i * 3000).collect();
    let narrow: Vec<u16> = wide.iter().map(|v| (v % 65_536) as u16).collect();
    let data = RenderArray {
        name: "counts",
        shape: &shape,
        dimension_names: &names,
        data: &wide[..],
    };
    write_render_group(&folder.path().join("u32"), &[data], &Map::new()).unwrap();
    let data = RenderArray {
        name: "counts",
        shape: &shape,
        dimension_names: &names,
        data: &narrow[..],
    };
    write_render_group(&folder.path().join("u16"), &[data], &Map::new()).unwrap();
    let open = |name: &str| {
        let store = std::sync::Arc::new(FilesystemStore::new(folder.path().join(name)).unwrap());
        Array::open(store, "/counts").unwrap()
    };
    let all = ArraySubset::new_with_shape(shape.to_vec());
    let read: Vec<u32> = open("u32").retrieve_array_subset(&all).unwrap();
    assert!(read == wide);
    let read: Vec<u16> = open("u16").retrieve_array_subset(&all).unwrap();
    assert!(read == narrow);
    let group = RenderGroup::open(&folder.path().join("u16")).unwrap();
    let (found, values) = group.read::<u16>("counts").unwrap();
    assert!(found == shape && values == narrow);
    let error = group.read::<f32>("counts").unwrap_err().to_string();
    assert!(
        error.contains("counts/zarr.json: expected data_type = \"float32\""),
        "{error}"
    );
    assert!(error.ends_with("found \"uint16\""), "{error}");
}

#[test]
fn missing_damaged_and_foreign_parts_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("g");
    let data: Vec<f32> = (0..2_112_000).map(|i| i as f32).collect();
    let one = [array("a", &[55, 60, 640], &["row", "column", "bin"], &data)];
    write_render_group(&dir, &one, &Map::new()).unwrap();
    let fails = || {
        let group = RenderGroup::open(&dir).unwrap();
        group.read::<f32>("a").unwrap_err().to_string()
    };
    let chunk = dir.join("a/c/1/0/0");
    let bytes = std::fs::read(&chunk).unwrap();
    std::fs::remove_file(&chunk).unwrap();
    let error = fails();
    assert!(
        error.starts_with("cannot read ") && error.contains("a/c/1/0/0"),
        "{error}"
    );
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 1;
    std::fs::write(&chunk, &flipped).unwrap();
    let error = fails();
    assert!(error.contains("a/c/1/0/0"), "{error}");
    std::fs::write(&chunk, &bytes).unwrap();
    let path = dir.join("a/zarr.json");
    let text = std::fs::read_to_string(&path).unwrap();
    for (from, to, says) in [
        ("blosc", "gzip", "expected codecs"),
        ("\"shape\": [", "\"shape\": [-1,", "expected positive sizes"),
        (
            "\"shape\": [",
            "\"shape\": [7,",
            "expected chunks within the shape",
        ),
        ("{", "", "expected the JSON of a Zarr v3 node"),
    ] {
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let error = fails();
        assert!(
            error.contains("a/zarr.json: ") && error.contains(says),
            "{error}"
        );
    }
    std::fs::write(&path, text).unwrap();
    RenderGroup::open(&dir).unwrap().read::<f32>("a").unwrap();
    let error = RenderGroup::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("zarr.json"), "{error}");
    let error = RenderGroup::open(&dir.join("a")).unwrap_err().to_string();
    assert!(error.contains("expected a group"), "{error}");
}

#[test]
fn a_file_larger_than_it_may_be_is_refused_with_its_name_and_the_limit() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("huge");
    std::fs::create_dir(&dir).unwrap();
    // A file without content takes no room on the disk.
    let file = std::fs::File::create(dir.join("zarr.json")).unwrap();
    file.set_len((64 << 20) + 1).unwrap();
    let said = RenderGroup::open(&dir).unwrap_err().to_string();
    assert!(
        said.contains("huge") && said.contains("zarr.json") && said.contains("67108864 bytes"),
        "{said}"
    );
}
