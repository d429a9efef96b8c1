//! Captures of laboratories: what comes in is what the files have.

use std::path::{Path, PathBuf};

use picofarm_dataset::SingleRender;
use picofarm_exchange::capture::{Beam, Capture, import};
use picofarm_exchange::{ExportFormat, Exporter};
use picofarm_files::Opener;
use picofarm_store::open_store;
use tempfile::TempDir;

use crate::common::Lcg;
use crate::files::{mat, npy::npy};

const SPOTS: usize = 3;
const ROWS: usize = 4;
const COLUMNS: usize = 5;
const BINS: usize = 40;
/// Metres that light travels in a picosecond.
const LIGHT_M_PS: f64 = 299_792_458.0 * 1e-12;

/// Counts `[spot][row][column][bin]`.
fn counts() -> Vec<f32> {
    let mut rng = Lcg(7);
    (0..SPOTS * ROWS * COLUMNS * BINS)
        .map(|_| (rng.next() * 9.0).floor())
        .collect()
}

/// A description without histograms; `more` has further fields, with a comma in front.
fn description(more: &str) -> String {
    format!(
        r#"{{"gate": {{"start_m": 1.0, "bin_width_m": 0.05}}, "camera": {{"fov_deg": 60}}, "laser_m": [0.1, 0, 0],
            "spots_m": [[0, 0, 2], [1, 0, 2], [0, 0.5, 2.5]]{more}}}"#
    )
}

fn write(folder: &Path, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn read(files: &[PathBuf]) -> Result<Capture, String> {
    import(files, None, &Opener::anywhere()).map_err(|e| e.to_string())
}

fn sums(all: &[f32]) -> Vec<f32> {
    let len = all.len() / SPOTS;
    (0..len)
        .map(|at| (0..SPOTS).map(|s| all[s * len + at]).sum())
        .collect()
}

#[test]
fn arrays_come_in_with_every_bin_whatever_their_axes() {
    let all = counts();
    let folder = TempDir::new().unwrap();
    write(folder.path(), "capture.json", description(""));
    let file = write(
        folder.path(),
        "a.npy",
        npy("<f4", &[SPOTS, ROWS, COLUMNS, BINS], &all),
    );
    let plain = read(&[file]).unwrap();
    assert_eq!(plain.per_spot.as_deref(), Some(&all[..]));
    assert_eq!(plain.sum, sums(&all));
    assert_eq!((plain.height, plain.width, plain.gate.bins), (4, 5, 40));
    assert_eq!(plain.name, "a");
    let Beam::Spot { position, path_m } = plain.beams[1] else {
        panic!("{:?}", plain.beams)
    };
    assert_eq!(position, [1.0, 0.0, 2.0]);
    assert!((f64::from(path_m) - (0.81f64 + 4.0).sqrt()).abs() < 1e-6);

    // Bins, columns, spots, rows.
    let mut turned = vec![0.0f32; all.len()];
    for (at, x) in all.iter().enumerate() {
        let (bin, column) = (at % BINS, at / BINS % COLUMNS);
        let (row, spot) = (at / (BINS * COLUMNS) % ROWS, at / (BINS * COLUMNS * ROWS));
        turned[((bin * COLUMNS + column) * SPOTS + spot) * ROWS + row] = *x;
    }
    write(
        folder.path(),
        "capture.json",
        description(r#", "axes": ["bin", "column", "spot", "row"]"#),
    );
    let file = write(
        folder.path(),
        "b.npy",
        npy("<f4", &[BINS, COLUMNS, SPOTS, ROWS], &turned),
    );
    assert_eq!(read(&[file]).unwrap().per_spot, plain.per_spot);
}

#[test]
fn files_of_one_spot_each_are_joined_in_their_order() {
    let all = counts();
    let folder = TempDir::new().unwrap();
    let len = all.len() / SPOTS;
    let files: Vec<PathBuf> = [2, 0, 1]
        .map(|spot: usize| {
            let h = &all[spot * len..][..len];
            write(
                folder.path(),
                &format!("s{spot}.npy"),
                npy("<f4", &[ROWS, COLUMNS, BINS], h),
            )
        })
        .into();
    write(folder.path(), "capture.json", description(""));
    let capture = read(&files).unwrap();
    for (at, spot) in [2, 0, 1].into_iter().enumerate() {
        assert_eq!(capture.spot(at), Some(&all[spot * len..][..len]));
    }
    assert_eq!(capture.origin.files.len(), 4, "{:?}", capture.origin.files);
    // The same files, named by the description.
    let names = r#", "histograms": ["s2.npy", "s0.npy", "s1.npy"]"#;
    let described = write(folder.path(), "capture.json", description(names));
    assert_eq!(read(&[described]).unwrap().per_spot, capture.per_spot);
}

#[test]
fn matlab_arrays_of_pixels_come_in() {
    let all = counts();
    let folder = TempDir::new().unwrap();
    // One spot, [pixel, bin], first index fastest.
    let one = &all[..ROWS * COLUMNS * BINS];
    let mut columns = vec![0.0f64; one.len()];
    for (at, x) in one.iter().enumerate() {
        columns[at % BINS * ROWS * COLUMNS + at / BINS] = f64::from(*x);
    }
    let dims = [(ROWS * COLUMNS) as i32, BINS as i32];
    let file = mat::version_5(&[
        mat::matrix("other", [1, 1], &[3.5]),
        mat::matrix("cube", dims, &columns),
    ]);
    let file = write(folder.path(), "a.mat", file);
    let only = r#", "axes": ["pixel", "bin"], "pixels": [4, 5]"#;
    write(folder.path(), "capture.json", description(only));
    let said = read(std::slice::from_ref(&file)).unwrap_err();
    assert!(
        said.contains("\"cube\"") && said.contains("\"array\""),
        "{said}"
    );
    let chosen = format!(r#"{only}, "array": "cube""#);
    write(folder.path(), "capture.json", description(&chosen));
    let capture = read(&[file]).unwrap();
    assert_eq!(capture.sum, one);
    assert_eq!(capture.per_spot, None);
}

#[test]
fn a_gate_in_picoseconds_is_that_in_metres() {
    let all = counts();
    let folder = TempDir::new().unwrap();
    let file = write(
        folder.path(),
        "a.npy",
        npy("<f4", &[SPOTS, ROWS, COLUMNS, BINS], &all),
    );
    let ps = 0.05 / LIGHT_M_PS;
    let gate = format!(
        r#"{{"t0_ps": {}, "bin_width_ps": {ps}}}"#,
        -1.0 / LIGHT_M_PS
    );
    let text = description("").replace(r#"{"start_m": 1.0, "bin_width_m": 0.05}"#, &gate);
    write(folder.path(), "capture.json", &text);
    let capture = read(std::slice::from_ref(&file)).unwrap();
    // A hundredth of a bin.
    assert!(
        (capture.gate.start_m - 1.0).abs() < 5e-4,
        "{:?}",
        capture.gate
    );
    assert!(
        (capture.gate.bin_width_m - 0.05).abs() < 1e-9,
        "{:?}",
        capture.gate
    );
    // A part of it: the rest is counted.
    let kept = text.replace(
        r#""bin_width_ps""#,
        r#""keep_m": [1.5, 2.5], "bin_width_ps""#,
    );
    write(folder.path(), "capture.json", kept);
    let part = read(&[file]).unwrap();
    assert_eq!(part.gate.bins, 20);
    assert!((part.gate.start_m - 1.5).abs() < 5e-4, "{:?}", part.gate);
    let total = |h: &[f32]| h.iter().map(|x| f64::from(*x)).sum::<f64>();
    assert_eq!(total(&part.sum) + part.origin.outside, total(&capture.sum));
    assert_eq!(part.sum[..20], capture.sum[10..30]);
}

#[test]
fn positions_are_turned_into_the_cameras_axes() {
    let folder = TempDir::new().unwrap();
    let file = write(
        folder.path(),
        "a.npy",
        npy(
            "<u2",
            &[ROWS, COLUMNS, BINS],
            &[1u16; ROWS * COLUMNS * BINS],
        ),
    );
    let text = r#"{"gate": {"start_m": 1, "bin_width_m": 0.05}, "camera": {"fx": 5, "fy": 6, "cx": 2, "cy": 1.5},
        "frame": ["left", "up", "forward"], "laser_m": [0.2, 0.1, 0], "directions": [[-1, 2, 2]]}"#;
    write(folder.path(), "capture.json", text);
    let capture = read(&[file]).unwrap();
    assert_eq!(capture.laser, [-0.2, -0.1, 0.0]);
    let Beam::Direction(way) = capture.beams[0] else {
        panic!("{:?}", capture.beams)
    };
    for (found, expected) in way.iter().zip([1.0 / 3.0, -2.0 / 3.0, 2.0 / 3.0]) {
        assert!((found - expected as f32).abs() < 1e-6, "{way:?}");
    }
    let i = capture.intrinsics;
    assert_eq!([i.fx, i.fy, i.cx, i.cy], [5.0, 6.0, 2.0, 1.5]);
}

#[test]
fn a_table_of_photons_is_binned_and_what_falls_outside_is_counted() {
    let folder = TempDir::new().unwrap();
    let gate = r#""gate": {"t0_ps": 100.0, "start_ps": 200.0, "bin_width_ps": 10.0, "bins": 5}"#;
    let events = r#""events": {"time": "dtime", "time_ps": 2.0, "row": "y", "column": "x"}, "pixels": [2, 3]"#;
    let text = description(&format!(", {events}"));
    let text = text.replace(r#""gate": {"start_m": 1.0, "bin_width_m": 0.05}"#, gate);
    write(folder.path(), "capture.json", text);
    // Channels of 2 ps: 100 begins at 200 ps, the start of the gate.
    let table = "# a comment\ny,x,dtime\n0,0,100\n0,0,104\n1,2,105\n1,2,124\n1,2,125\n1,2,99\n2,0,110\n0,1,110.9\n";
    let file = write(folder.path(), "t.csv", table);
    let capture = read(&[file]).unwrap();
    let mut expected = vec![0.0; 2 * 3 * 5];
    expected[0] = 2.0;
    expected[5 * 5 + 1] = 1.0;
    expected[5 * 5 + 4] = 1.0;
    expected[5 + 2] = 1.0;
    assert_eq!(capture.sum, expected);
    // 125 and 99 are outside the gate, row 2 outside the image.
    assert_eq!(capture.origin.outside, 3.0);
    assert!((capture.gate.start_m - 100.0 * LIGHT_M_PS).abs() < 1e-9);
    let broken = write(folder.path(), "t.csv", "y,x,dtime\n0,0,100\n0,0,?\n");
    let said = read(&[broken]).unwrap_err();
    assert!(
        said.contains("line 3, column 2") && said.contains("\"?\""),
        "{said}"
    );
}

#[test]
fn photons_between_markers_are_spread_over_the_columns() {
    let folder = TempDir::new().unwrap();
    let gate = r#""gate": {"start_m": 0, "bin_width_ps": 4.0, "bins": 10}"#;
    let events = r#""events": {"time": 1, "time_ps": 4.0, "marker": 0, "clock": 2,
        "line_start": 1, "line_stop": 2, "frame": 4, "separator": ";"}, "pixels": [2, 4]"#;
    let text = description(&format!(", {events}"));
    let text = text.replace(r#""gate": {"start_m": 1.0, "bin_width_m": 0.05}"#, gate);
    write(folder.path(), "capture.json", text);
    // A photon before the first line, two in the first, one in the second, one in the first again.
    let table = "0;3;5\n1;0;100\n0;3;100\n0;3;199\n2;0;200\n1;0;300\n0;7;325\n2;0;400\n4;0;401\n1;0;500\n0;1;550\n2;0;600\n";
    let capture = read(&[write(folder.path(), "t.csv", table)]).unwrap();
    let mut expected = vec![0.0; 2 * 4 * 10];
    expected[3] = 1.0;
    expected[3 * 10 + 3] = 1.0;
    expected[(4 + 1) * 10 + 7] = 1.0;
    expected[2 * 10 + 1] = 1.0;
    assert_eq!(capture.sum, expected);
    assert_eq!(capture.origin.outside, 1.0);
}

#[test]
fn what_a_description_lacks_or_contradicts_is_named() {
    let folder = TempDir::new().unwrap();
    let all = counts();
    let file = write(
        folder.path(),
        "a.npy",
        npy("<f4", &[SPOTS, ROWS, COLUMNS, BINS], &all),
    );
    let said = read(std::slice::from_ref(&file)).unwrap_err();
    for word in [
        "gate",
        "camera",
        "laser_m",
        "spots_m",
        "\"bin_width_ps\"",
        "3 histograms of 4x5",
    ] {
        assert!(said.contains(word), "{word}: {said}");
    }
    for (from, to, words) in [
        (
            "\"fov_deg\": 60",
            "\"fov_deg\": 200",
            ["camera.fov_deg", "200"],
        ),
        (
            "\"bin_width_m\": 0.05",
            "\"bin_width_ps\": 0.032",
            ["gate.bin_width_ps", "0.0000096 m; are these nanoseconds?"],
        ),
        (
            "\"bin_width_m\": 0.05",
            "\"bin_width_m\": 32",
            ["gate.bin_width_m", "are these picoseconds?"],
        ),
        (
            "\"fov_deg\": 60",
            "\"fx\": -48, \"cy\": 2",
            ["camera", "found fx -48, cy 2;"],
        ),
        (
            "\"laser_m\"",
            "\"axes\": [\"row\", \"spot\", \"column\", \"bin\"], \"laser_m\"",
            ["[4, 3, 5, 40]", "in their order in \"axes\""],
        ),
        ("\"start_m\": 1.0,", "", ["gate.start_m", "t0_ps"]),
        ("\"start_m\"", "\"starts\"", ["unknown field", "starts"]),
        ("[1, 0, 2], ", "", ["spots_m", "2"]),
        (
            "\"spots_m\"",
            "\"directions\": [[0, 0, 0]], \"spot\"",
            ["unknown field", "spot"],
        ),
        (
            "\"laser_m\"",
            "\"axes\": [\"row\", \"bin\"], \"laser_m\"",
            ["axes", "4 axes"],
        ),
        (
            "\"laser_m\"",
            "\"frame\": [\"left\", \"right\", \"up\"], \"laser_m\"",
            ["frame", "each once"],
        ),
        (
            "\"laser_m\"",
            "\"depth_m\": \"../d.npy\", \"laser_m\"",
            ["d.npy", "outside"],
        ),
    ] {
        let text = description("").replace(from, to);
        assert_ne!(text, description(""), "{from}");
        write(folder.path(), "capture.json", text);
        let said = read(std::slice::from_ref(&file)).unwrap_err();
        for word in words {
            assert!(said.contains(word), "{word}: {said}");
        }
    }
}

#[test]
fn folders_without_files_of_a_laboratory_are_refused_with_the_way_out() {
    let folder = TempDir::new().unwrap();
    let said = || read(&[folder.path().to_owned()]).unwrap_err();
    assert!(said().contains("the folder is empty"), "{}", said());
    write(folder.path(), "notes.txt", "none");
    assert!(said().contains("capture.json in the folder"), "{}", said());
    assert!(!said().contains("--format"), "{}", said());
    write(folder.path(), "zarr.json", "{}");
    assert!(
        said().contains("already a data set; use it as it is"),
        "{}",
        said()
    );
}

#[test]
fn an_unknown_file_is_described() {
    let folder = TempDir::new().unwrap();
    write(folder.path(), "capture.json", description(""));
    for (bytes, word) in [
        (&b"\x00\x01binary rubbish"[..], "binary rub"),
        (b"time, pixel\n1, 2\n", "time, pixel"),
    ] {
        let said = read(&[write(folder.path(), "x.dat", bytes)]).unwrap_err();
        assert!(said.contains("x.dat") && said.contains(word), "{said}");
        assert!(said.contains("\"t0_ps\": 14242.8"), "{said}");
    }
}

#[tokio::test]
async fn a_folder_gives_back_what_was_written() {
    let folder = TempDir::new().unwrap();
    let all = counts();
    let depth = vec![2.0f32; ROWS * COLUMNS];
    write(folder.path(), "d.npy", npy("<f4", &[ROWS, COLUMNS], &depth));
    let file = write(
        folder.path(),
        "a.npy",
        npy("<f4", &[SPOTS, ROWS, COLUMNS, BINS], &all),
    );
    for more in ["", r#", "depth_m": "d.npy", "name": "the room""#] {
        let ways = description(more).replace("spots_m", "directions");
        for text in [description(more), ways] {
            write(folder.path(), "capture.json", text);
            let capture = read(std::slice::from_ref(&file)).unwrap();
            assert_eq!(capture.depth.is_some(), !more.is_empty());
            let out = folder.path().join("out");
            capture.write(&out, b"picture").await.unwrap();
            assert_eq!(Capture::read(&out).await.unwrap(), capture);
            std::fs::remove_dir_all(out).unwrap();
        }
    }
}

#[tokio::test]
async fn exports_of_a_capture_come_back_in() {
    let folder = TempDir::new().unwrap();
    let depth = npy("<f4", &[ROWS, COLUMNS], &[2.0f32; ROWS * COLUMNS]);
    write(folder.path(), "d.npy", depth);
    let all = &counts()[..ROWS * COLUMNS * BINS];
    let file = write(
        folder.path(),
        "a.npy",
        npy("<f4", &[ROWS, COLUMNS, BINS], all),
    );
    let text = description(r#", "depth_m": "d.npy""#);
    let described = write(folder.path(), "capture.json", text);
    let capture = read(&[file]).unwrap();
    let out = folder.path().join("out");
    capture.write(&out, b"picture").await.unwrap();
    let dataset = SingleRender::open(&out).await.unwrap().dataset;
    std::fs::remove_file(described).unwrap();
    for (format, end) in [
        (ExportFormat::Hdf5, "h5"),
        (ExportFormat::WebDataset, "tar"),
    ] {
        let to = folder.path().join(end);
        let (store, prefix) = open_store(to.to_str().unwrap()).unwrap();
        let mut export = Exporter::new(format, &dataset, &[0], &*store, prefix).unwrap();
        export.step(0).await.unwrap();
        export.finish().await.unwrap();
        let mut files: Vec<PathBuf> = ["", "scenes", "shards", "data"]
            .iter()
            .filter_map(|folder| std::fs::read_dir(to.join(folder)).ok())
            .flatten()
            .map(|e| e.unwrap().path())
            .collect();
        files.retain(|p| p.extension().is_some_and(|e| e == end));
        let back = read(&files).unwrap();
        assert_eq!(back.sum, capture.sum);
        assert_eq!(back.depth, capture.depth);
        assert_eq!((back.gate, back.laser), (capture.gate, capture.laser));
        assert_eq!(back.intrinsics, capture.intrinsics);
        assert_eq!(back.beams, capture.beams);
    }
}
