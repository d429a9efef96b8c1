//! Frames of consumer-nlos: ST's are read, the pickles of ams are refused.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use picofarm_exchange::capture::{Beam, Capture, import};
use picofarm_files::Opener;
use tempfile::TempDir;

use crate::files::npy::npy;

const BINS: usize = 12;

/// A `.npz` file of these arrays.
fn npz(folder: &Path, name: &str, arrays: &[(&str, Vec<u8>)]) -> PathBuf {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    for (array, bytes) in arrays {
        zip.start_file(format!("{array}.npy"), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    let path = folder.join(name);
    std::fs::write(&path, zip.finish().unwrap().into_inner()).unwrap();
    path
}

/// A sensor `distance` in front of a wall, which looks straight at it: 8×8 zones.
fn frame(distance: f64) -> (Vec<f64>, Vec<f64>) {
    let counts = (0..64 * BINS).map(|i| (i % 37) as f64).collect();
    let half = (22.5f64).to_radians().tan();
    let points = (0..64)
        .flat_map(|zone| {
            let at = |k: usize| ((k as f64 + 0.5) / 4.0 - 1.0) * half * distance;
            // The wall's x is towards the left.
            [-at(zone % 8), at(zone / 8), 0.0]
        })
        .collect();
    (counts, points)
}

fn read(file: &Path) -> Result<Capture, String> {
    import(&[file.to_owned()], None, &Opener::anywhere()).map_err(|e| e.to_string())
}

#[test]
fn a_frame_of_zones_has_its_counts_its_bins_and_the_depth_of_the_wall() {
    let folder = TempDir::new().unwrap();
    let (counts, points) = frame(0.5);
    let arrays = [
        ("hists", npy("<f8", &[64, BINS], &counts)),
        ("pt_cloud", npy("<f8", &[64, 3], &points)),
        ("cam_z", npy("<f8", &[], &[0.5f64])),
    ];
    let file = npz(folder.path(), "volume_000001.npz", &arrays);
    let capture = read(&file).unwrap();
    assert_eq!((capture.height, capture.width), (8, 8));
    assert_eq!(capture.origin.format, "consumer-nlos");
    assert_eq!(capture.name, "volume_000001");
    let expected: Vec<f32> = counts.iter().map(|c| *c as f32).collect();
    assert_eq!(capture.sum, expected);
    assert!(capture.per_spot.is_none());
    assert_eq!(
        (capture.gate.start_m, capture.gate.bins),
        (0.0, BINS as u32)
    );
    assert!((capture.gate.bin_width_m - 250e-12 * 299_792_458.0).abs() < 1e-12);
    // A flat wall: one depth, and spots on it.
    for depth in capture.depth.as_ref().unwrap() {
        assert!((depth - 0.5).abs() < 1e-6, "{depth}");
    }
    assert_eq!(capture.beams.len(), 64);
    for (zone, beam) in capture.beams.iter().enumerate() {
        let Beam::Spot { position, path_m } = beam else {
            panic!("{beam:?}")
        };
        let x = -points[zone * 3] as f32;
        assert!((position[0] - x).abs() < 1e-6 && (position[2] - 0.5).abs() < 1e-6);
        let range = position.iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!((path_m - range).abs() < 1e-6);
    }
    let notes = capture.origin.conversions.join("; ");
    assert!(
        notes.contains("8x8 zones") && notes.contains("from the relay wall"),
        "{notes}"
    );
    // Without the sensor's place only directions are known.
    let file = npz(folder.path(), "tracking.npz", &arrays[..2]);
    let capture = read(&file).unwrap();
    assert!(capture.depth.is_none());
    assert!(
        capture
            .beams
            .iter()
            .all(|b| matches!(b, Beam::Direction(_)))
    );
    // A description has precedence.
    std::fs::write(
        folder.path().join("capture.json"),
        r#"{"pixels": [4, 16], "gate": {"start_m": 0.1, "bin_width_ps": 250.405}}"#,
    )
    .unwrap();
    let capture = read(&file).unwrap();
    assert_eq!((capture.height, capture.width), (4, 16));
    assert_eq!(capture.gate.start_m, 0.1);
}

#[test]
fn a_broken_frame_names_the_array_at_fault() {
    let folder = TempDir::new().unwrap();
    let (counts, points) = frame(0.5);
    let good = [
        ("hists", npy("<f8", &[64, BINS], &counts)),
        ("pt_cloud", npy("<f8", &[64, 3], &points)),
        ("cam_z", npy("<f8", &[], &[0.5f64])),
    ];
    for (which, bytes, says) in [
        (0, npy("<f8", &[48, 16], &counts), "48 zones of 16 bins"),
        (0, npy("<f8", &[768], &counts), "[zone][bin]"),
        (1, npy("<f8", &[3, 64], &points), "[64, 3]"),
        (2, npy("<f8", &[], &[-1.0f64]), "one distance in metres"),
    ] {
        let mut arrays = good.clone();
        arrays[which].1 = bytes;
        let error = read(&npz(folder.path(), "bad.npz", &arrays)).unwrap_err();
        assert!(
            error.contains(says) && error.contains(arrays[which].0),
            "{error}"
        );
    }
    // Two frames are no two spots.
    let files = ["a.npz", "b.npz"].map(|name| npz(folder.path(), name, &good));
    let error = import(&files, None, &Opener::anywhere())
        .unwrap_err()
        .to_string();
    assert!(error.contains("import each frame alone"), "{error}");
}

#[test]
fn pickles_are_refused_by_name_with_the_way_to_convert_them() {
    let folder = TempDir::new().unwrap();
    let write = |name: &str, pickle: &[u8]| {
        let mut bytes = npy("|O", &[], &[0u8; 0]);
        bytes.extend(pickle);
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let ams = write(
        "iter_0.npy",
        b"\x80\x03cnumpy.core.multiarray\n_reconstruct\nX\x09\0\0\0histogram.",
    );
    let error = read(&ams).unwrap_err();
    for part in ["iter_0.npy", "ams scan", "numpy.save", "1144"] {
        assert!(error.contains(part), "{part}: {error}");
    }
    let other = write("other.npy", b"\x80\x03]q\x00.");
    let error = read(&other).unwrap_err();
    assert!(
        error.contains("other.npy") && !error.contains("ams scan"),
        "{error}"
    );
}

/// The files of the public repository, which are not part of this one.
#[test]
fn public_frames_and_scans_are_read_or_refused() {
    let folder = std::env::var_os("PICOFARM_CONSUMER_NLOS").map(PathBuf::from);
    let Some(folder) = folder.filter(|f| f.is_dir()) else {
        println!(
            "skipped: set PICOFARM_CONSUMER_NLOS to a folder with files of sidsoma/consumer-nlos to run this test"
        );
        return;
    };
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    files.sort();
    let (mut frames, mut scans) = (0, 0);
    for file in &files {
        match file.extension().and_then(|e| e.to_str()) {
            Some("npz") => {
                let capture = read(file).unwrap();
                assert_eq!(
                    (capture.height, capture.width, capture.gate.bins),
                    (4, 4, 128)
                );
                let light: f32 = capture.sum.iter().sum();
                assert!(light > 1e4, "{light}");
                // The sensor stood within two metres of the wall.
                let depth = capture.depth.unwrap();
                assert!(depth.iter().all(|d| (0.1..2.0).contains(d)), "{depth:?}");
                frames += 1;
            }
            Some("npy") => {
                assert!(read(file).unwrap_err().contains("ams scan"));
                scans += 1;
            }
            _ => {}
        }
    }
    assert!(frames + scans > 0, "the folder has no such file");
}
