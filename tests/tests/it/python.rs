//! The Python package passes its own tests (`python/tests`). It, xarray and tensorstore read the
//! same data as the program, from disk and from S3, and the example of docs/python trains. The
//! notebooks run. Runs if `PICOFARM_PYTHON` names a Python with zarr, xarray, tensorstore, obstore,
//! h5py, pytest, matplotlib, pandas, nbclient and ipykernel.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
};

use picofarm_tests::{Cli, Ended, Farm, Job, Scratch, s3::Server, store};
use serde_json::Value;

/// Number of scenes.
const COUNT: u64 = 5;

fn python(name: &str) -> Option<OsString> {
    let python = std::env::var_os("PICOFARM_PYTHON");
    if python.is_none() {
        eprintln!(
            "SKIPPED {name}: tests/run installs a Python with zarr, xarray, tensorstore, obstore and h5py, PICOFARM_PYTHON names it"
        );
    }
    python
}

/// Returns the folder of this repository.
fn repository() -> PathBuf {
    Path::new(&picofarm_tests::package()).join("..")
}

/// Installs the Python package into a folder of `scratch` and returns commands that import it.
fn with_package(scratch: &Path, cli: Cli) -> Cli {
    let path = scratch.join("site");
    let package = path.join("picofarm");
    let source = repository().join("python/picofarm");
    for folder in ["", "torch"] {
        std::fs::create_dir_all(package.join(folder)).unwrap();
        for entry in source.join(folder).read_dir().unwrap() {
            let file = entry.unwrap().path();
            if file.extension().is_some_and(|e| e == "py") {
                let name = file.file_name().unwrap();
                std::fs::copy(&file, package.join(folder).join(name)).unwrap();
            }
        }
    }
    let module = picofarm_tests::binary::python_module();
    std::os::unix::fs::symlink(module, package.join("_native.abi3.so")).unwrap();
    cli.with("PYTHONPATH", &path.display().to_string())
}

/// Runs a script of this repository to its successful end, with the variables of `cli`.
fn run(python: &OsString, cli: &Cli, script: &str, args: &[&str]) -> Ended {
    let script = repository().join(script).display().to_string();
    // `-B`: writes no bytecode next to the scripts.
    cli.run_other(python, &[&["-B", &script], args].concat())
        .ok()
}

/// Starts a farm with rendered rooms of 32×32 pixels in its store.
fn rooms(name: &str) -> (Farm, PathBuf) {
    let farm = Farm::start(name);
    let job = Job {
        resolution: 32,
        ..Job::quick(&farm.store(), COUNT)
    };
    let text = job.toml().replace(
        "dataset = \"rooms\"",
        "dataset = \"rooms\"\nprofile = \"lossless\"",
    );
    std::fs::write(farm.scratch.join("rooms.toml"), text).unwrap();
    let id = farm.json(&["job", "submit", "rooms.toml"])["job"]
        .as_str()
        .expect("a submission answers with a job")
        .to_owned();
    let _worker = farm.worker("renderer");
    farm.until_ended(&id);
    let place = job.place();
    assert_eq!(store::finished(&place).len() as u64, COUNT);
    (farm, place)
}

/// Reprocesses the same scenes into another profile, so bright that some bins saturate. Returns the
/// location of an HDF5 export, which contains the values that the program itself reads.
fn reprocess(farm: &Farm, source: &Path, target: &str, profile: &str) -> String {
    let source = source.display().to_string();
    let bright = ["--peak-photons", "100000"];
    let noise: &[&str] = match profile {
        "counts-u16" => &[],
        _ => &["--no-poisson"],
    };
    let make = [
        "dataset",
        "reprocess",
        &source,
        target,
        "--profile",
        profile,
    ];
    farm.run(&[&make[..], &bright, noise].concat()).ok();
    let exported = farm.scratch.join(&format!("hdf5-{profile}"));
    let exported = exported.display().to_string();
    farm.run(&["dataset", "export", target, &exported, "--format", "hdf5"])
        .ok();
    exported
}

/// Runs everything that the example does, at one location.
fn everything(python: &OsString, farm: &Farm, source: &Path, place: &dyn Fn(&str) -> String) {
    let cli = with_package(farm.scratch.path(), farm.cli());
    for (profile, saturates) in [
        ("sqrt-u16", true),
        ("coarse", false),
        ("plain-f32", false),
        ("counts-u16", true),
    ] {
        let target = place(profile);
        let exported = reprocess(farm, source, &target, profile);
        let check = "tests/interop/check_package.py";
        let found = run(python, &cli, check, &[&target, &exported]).json();
        assert_eq!(found["scenes"], COUNT);
        assert_eq!(
            found["saturated"].as_u64() > Some(0),
            saturates,
            "{profile}: {found}"
        );
    }
    let target = place("sqrt-u16");
    let readers = run(python, &cli, "docs/python/readers.py", &[&target, "1"]);
    assert!(
        readers.stdout.contains("all three agree"),
        "{}",
        readers.stdout
    );
    farm.run(&["dataset", "split", &target, "--counts", "3,1,1"])
        .ok();
    let train = |more: &[&str]| -> Value {
        let args = [&[&*target, "--split", "train"], more].concat();
        let ended = run(python, &cli, "docs/python/train.py", &args);
        let result = ended.json();
        let with = result["with"].as_str().unwrap();
        assert!(ended.stdout.contains(&format!(
            "training with {}",
            ["numpy", "PyTorch"][usize::from(with == "torch")]
        )));
        assert_eq!(result["scenes"], 3, "{result}");
        let loss = |name: &str| result[name].as_f64().expect("a number");
        assert!(
            loss("last_loss") < 0.8 * loss("first_loss"),
            "it learns: {result}"
        );
        assert!((0.0..=1.0).contains(&loss("waiting")), "{result}");
        result
    };
    train(&["--workers", "2"]);
    assert_eq!(train(&["--workers", "0", "--numpy"])["with"], "numpy");
}

#[test]
fn the_package_reads_what_the_program_exports_and_learns_from_a_disk() {
    let Some(python) = python("python") else {
        return;
    };
    let (farm, source) = rooms("python");
    let place = |profile: &str| farm.store().join(profile).display().to_string();
    everything(&python, &farm, &source, &place);
}

#[test]
fn the_package_passes_its_own_tests() {
    let Some(python) = python("python-package") else {
        return;
    };
    let (farm, source) = rooms("python-package");
    let cli = with_package(farm.scratch.path(), farm.cli())
        .with("PICOFARM_DATASET", &source.display().to_string());
    let tests = repository().join("python/tests").display().to_string();
    let pytest = ["-B", "-m", "pytest", "-q", "-p", "no:cacheprovider", &tests];
    let ended = cli.run_other(&python, &pytest).ok();
    assert!(ended.stdout.contains(" passed"), "{}", ended.stdout);
    assert!(!ended.stdout.contains(" skipped"), "{}", ended.stdout);
}

#[test]
fn the_notebooks_of_the_documentation_run() {
    let Some(python) = python("notebooks") else {
        return;
    };
    let scratch = Scratch::new("notebooks");
    let cli = with_package(scratch.path(), Cli::new(scratch.path()));
    let mut notebooks: Vec<String> = repository()
        .join("docs/notebooks")
        .read_dir()
        .unwrap()
        .map(|entry| entry.unwrap().path().display().to_string())
        .collect();
    notebooks.sort();
    assert_eq!(notebooks.len(), 5, "{notebooks:?}");
    let notebooks: Vec<&str> = notebooks.iter().map(String::as_str).collect();
    let ended = run(&python, &cli, "tests/interop/run_notebooks.py", &notebooks);
    assert_eq!(ended.stdout.matches(": ran").count(), 5, "{}", ended.stdout);
}

#[test]
fn the_package_reads_what_the_program_exports_and_learns_from_s3() {
    let Some(python) = python("python-s3") else {
        return;
    };
    let Some(server) = Server::start("python-s3") else {
        return;
    };
    let (farm, source) = rooms("python-s3-farm");
    let farm = farm.reaching(&server);
    let bucket = server.bucket();
    let place = |profile: &str| format!("s3://{bucket}/deep/{profile}");
    everything(&python, &farm, &source, &place);
}

/// Runs if `PICOFARM_BLENDER_PYTHON` names a Python that also has bpy, which takes 374 MB and
/// supports a single version of Python.
#[test]
fn blender_sees_each_pixel_at_the_depth_that_the_renderer_states() {
    let Some(readers) = python("blender") else {
        return;
    };
    let Some(blender) = std::env::var_os("PICOFARM_BLENDER_PYTHON") else {
        eprintln!("SKIPPED blender: PICOFARM_BLENDER_PYTHON names no Python with bpy");
        return;
    };
    let scratch = Scratch::new("blender");
    let cli = Cli::new(scratch.path());
    for kind in ["primitive", "desktop"] {
        let name = format!("{kind}.glb");
        let generate = ["scene", "generate", "--kind", kind, "--resolution", "64"];
        cli.run(&[&generate[..], &["--out", &name]].concat()).ok();
        let render = ["scene", "render", &name, "--samples", "2", "--out", kind];
        cli.run(&render).ok();
        let images = ["--out", "rgb", "--samples", "2"];
        run(
            &blender,
            &cli,
            "docs/python/blender.py",
            &[&[&*name][..], &images].concat(),
        );
        let compare = format!(
            "import OpenEXR, zarr, numpy as n\n\
             seen = OpenEXR.File('rgb/{kind}.exr', separate_channels=True).channels()['ViewLayer.Depth.Z'].pixels\n\
             apart = n.abs(seen - zarr.open_group('{kind}', mode='r')['depth'][0])\n\
             assert n.mean(apart < 1e-4) > 0.98, n.percentile(apart, [50, 90, 99])"
        );
        cli.run_other(&readers, &["-c", &compare]).ok();
    }
}
