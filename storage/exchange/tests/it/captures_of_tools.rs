//! Captures in the formats of laboratories, written by the tools of these formats.

use std::path::{Path, PathBuf};
use std::process::Command;

use picofarm_exchange::capture::{Beam, Capture, import};
use picofarm_files::Opener;
use tempfile::TempDir;

const HALF: usize = 4 * 5 * 24;

/// The capture of each format in a new folder, and the photons `[spot][row][column][bin]` of all.
/// Empty without a Python that has the tools.
fn written() -> Option<(TempDir, Vec<String>, Vec<f32>)> {
    let python = std::env::var_os("PICOFARM_PYTHON");
    let ready = python.as_ref().is_some_and(|python| {
        let probe = ["-c", "import h5py, numpy, scipy.io"];
        let probe = Command::new(python).args(probe).output();
        probe.is_ok_and(|o| o.status.success())
    });
    let Some(python) = python.filter(|_| ready) else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, scipy and h5py to run this test"
        );
        return None;
    };
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../tests/interop/make_captures.py");
    let made = Command::new(python)
        .arg(script)
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(
        made.status.success(),
        "{}",
        String::from_utf8_lossy(&made.stderr)
    );
    let formats = String::from_utf8(made.stdout).unwrap();
    let raw = std::fs::read(folder.path().join("expected.npy")).unwrap();
    let expected = bytemuck::pod_collect_to_vec(&raw[raw.len() - 2 * HALF * 4..]);
    Some((
        folder,
        formats.lines().map(str::to_owned).collect(),
        expected,
    ))
}

fn read(folder: &Path) -> Result<Capture, String> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_none_or(|e| e != "json"))
        .collect();
    files.sort();
    import(&files, None, &Opener::anywhere()).map_err(|e| e.to_string())
}

#[test]
fn every_format_gives_the_same_photons() {
    let Some((folder, formats, expected)) = written() else {
        return;
    };
    if !formats.iter().any(|f| f == "ptu") {
        println!("skipped in part: PICOFARM_PYTHON has no ptufile, so no PTU files were made");
    }
    for format in &formats {
        let capture = read(&folder.path().join(format)).unwrap_or_else(|e| panic!("{format}: {e}"));
        match &capture.per_spot {
            Some(all) => assert_eq!(*all, expected, "{format}"),
            None => assert_eq!(capture.sum, expected[..HALF], "{format}"),
        }
        assert_eq!((capture.height, capture.width), (4, 5), "{format}");
        assert_eq!(capture.origin.outside, 0.0, "{format}");
        let wall = ["y-tal", "zaragoza"].contains(&format.as_str());
        let (start, width) = match wall {
            true => (3.5, 0.03),
            false => (-640e-12 * 299_792_458.0, 64e-12 * 299_792_458.0),
        };
        // A hundredth of a bin.
        assert!(
            (capture.gate.start_m - start).abs() < width / 100.0,
            "{format}: {:?}",
            capture.gate
        );
        assert!(
            (capture.gate.end_m() - start - 24.0 * width).abs() < width / 100.0,
            "{format}"
        );
    }
}

#[test]
fn a_relay_wall_is_seen_from_the_sensor() {
    let Some((folder, ..)) = written() else {
        return;
    };
    let capture = read(&folder.path().join("y-tal")).unwrap();
    let i = capture.intrinsics;
    // Points are 0.5 m apart in x and 0.4 m in y, and 2 m away.
    assert!(
        (i.fx - 4.0).abs() < 1e-5 && (i.fy - 5.0).abs() < 1e-5,
        "{i:?}"
    );
    // The first pixel is the point (-1, 0.6): 1.2 m to the left of the sensor and 0.7 m above it.
    let pixel = [-1.2 / 2.0 * i.fx + i.cx, -0.7 / 2.0 * i.fy + i.cy];
    assert!(
        (pixel[0] - 0.5).abs() < 1e-5 && (pixel[1] - 0.5).abs() < 1e-5,
        "{pixel:?}"
    );
    let Beam::Spot { position, .. } = capture.beams[0] else {
        panic!("{:?}", capture.beams)
    };
    // The spot is 0.1 m to the left of the sensor, and 0.3 m above it.
    for (found, expected) in position.iter().zip([-0.1, -0.3, 2.0]) {
        assert!((found - expected).abs() < 1e-6, "{position:?}");
    }
}

#[test]
fn confocal_scans_are_refused_with_the_reason() {
    let Some((folder, ..)) = written() else {
        return;
    };
    let python = std::env::var_os("PICOFARM_PYTHON").unwrap();
    let code = "import h5py, scipy.io, numpy as np, sys\n\
        f = h5py.File(sys.argv[1] + '/y-tal/a.hdf5', 'r+')\n\
        del f['H'], f['laser_grid_xyz']\n\
        f['H'] = np.ones((24, 5, 4)); f['laser_grid_xyz'] = f['sensor_grid_xyz'][()]\n\
        scipy.io.savemat(sys.argv[1] + '/npz/s.mat', {'rect_data': np.ones((4, 4, 8)), 'width': 0.5})";
    let made = Command::new(python)
        .args(["-c", code])
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(
        made.status.success(),
        "{}",
        String::from_utf8_lossy(&made.stderr)
    );
    let said = read(&folder.path().join("y-tal")).unwrap_err();
    assert!(
        said.contains("confocal") && said.contains("fixed laser point"),
        "{said}"
    );
    let stanford = folder.path().join("npz/s.mat");
    let said = import(&[stanford], None, &Opener::anywhere())
        .unwrap_err()
        .to_string();
    assert!(
        said.contains("confocal") && said.contains("rect_data"),
        "{said}"
    );
}

#[test]
fn a_bounce_flash_collection_keeps_its_spots_apart() {
    let Some((folder, ..)) = written() else {
        return;
    };
    let python = std::env::var_os("PICOFARM_PYTHON").unwrap();
    let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../tests/interop/make_mat.py");
    let collection = folder.path().join("collection");
    std::fs::create_dir(&collection).unwrap();
    let mut made = Command::new(python);
    let made = made.arg(script).arg(&collection);
    let made = made
        .args(["20", "16", "5000", "14.2428e-9"])
        .output()
        .unwrap();
    assert!(
        made.status.success(),
        "{}",
        String::from_utf8_lossy(&made.stderr)
    );
    let said = import(std::slice::from_ref(&collection), None, &Opener::anywhere())
        .unwrap_err()
        .to_string();
    assert!(said.contains("t0"), "{said}");
    let text = r#"{"gate": {"t0_ps": 14242.8}, "frame": ["left", "up", "forward"], "laser_m": [0.257, 0, 0]}"#;
    std::fs::write(collection.join("capture.json"), text).unwrap();
    let capture = import(std::slice::from_ref(&collection), None, &Opener::anywhere()).unwrap();
    assert_eq!((capture.beams.len(), capture.gate.bins), (2, 1502));
    assert_eq!(capture.laser, [-0.257, 0.0, 0.0]);
    let sum: Vec<f32> = std::iter::zip(capture.spot(0).unwrap(), capture.spot(1).unwrap())
        .map(|(a, b)| a + b)
        .collect();
    assert_eq!(capture.sum, sum);
    assert!(capture.depth.is_none());
    // A kept range has both of its ends.
    let keep = r#""t0_ps": 14242.8, "bin_width_ps": 8.0, "keep_m": [1.0, 2.2]"#;
    let text = text.replace(r#""t0_ps": 14242.8"#, keep);
    std::fs::write(collection.join("capture.json"), &text).unwrap();
    let kept = import(std::slice::from_ref(&collection), None, &Opener::anywhere()).unwrap();
    assert!((kept.gate.start_m - 1.0).abs() < kept.gate.bin_width_m);
    assert!((kept.gate.end_m() - 2.2).abs() < 1.5 * kept.gate.bin_width_m);
    let text = text.replace(r#", "bin_width_ps": 8.0"#, "");
    std::fs::write(collection.join("capture.json"), text).unwrap();
    let said = import(&[collection], None, &Opener::anywhere()).unwrap_err();
    assert!(said.to_string().contains("gate.bin_width_ps"), "{said}");
}
