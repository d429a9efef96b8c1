//! Locates the `picofarm` program and the Python extension module under test.
//!
//! Cargo tells only the tests of its own package where a binary is (`CARGO_BIN_EXE_…`), and builds
//! it only for them. This module therefore runs `cargo build --bin picofarm` once per test process.
//! That takes a third of a second if nothing changed, never tests a stale program, and is safe in
//! parallel, because Cargo locks its target folder. Three arguments prevent Cargo from compiling
//! the dependencies a second time with other features: `--workspace` and
//! `--features picofarm/full,picofarm/wgpu`, with which the tests are run, and `--test`, which
//! makes Cargo include the features of development dependencies.

use std::{
    env,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::OnceLock,
};

use serde_json::Value;

/// Returns the program under test: `PICOFARM_TEST_BINARY` if set (for example an installed one),
/// otherwise one built from this workspace with the profile and target folder of the running test.
///
/// # Panics
/// If the program cannot be built.
pub fn picofarm() -> &'static Path {
    static BINARY: OnceLock<PathBuf> = OnceLock::new();
    BINARY.get_or_init(|| match env::var_os("PICOFARM_TEST_BINARY") {
        Some(path) => PathBuf::from(path),
        None => build().program.clone(),
    })
}

/// Returns the shared library of the Python package's extension module, built from this workspace.
///
/// # Panics
/// If the module cannot be built.
pub fn python_module() -> &'static Path {
    &build().python_module
}

/// The files that Cargo built.
struct Built {
    program: PathBuf,
    python_module: PathBuf,
}

fn build() -> &'static Built {
    static BUILT: OnceLock<Built> = OnceLock::new();
    BUILT.get_or_init(run_cargo)
}

fn run_cargo() -> Built {
    let test = env::current_exe().expect("the running test has a path");
    // <target>/<profile>/deps/<test>
    let profile = test
        .ancestors()
        .nth(2)
        .expect("tests lie in a target folder");
    let target = profile.parent().expect("tests lie in a target folder");
    let profile = match profile.file_name().and_then(|n| n.to_str()) {
        Some("debug") => "dev",
        Some(name) => name,
        None => panic!(
            "{}: expected <target>/<profile>/deps/<test>",
            test.display()
        ),
    };
    let mut cargo = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    // Removes the variables that the test runner sets for this package. Otherwise, build scripts
    // that read them (ring's) would run again, here and in the next ordinary build, and everything
    // that depends on them would be rebuilt.
    for (name, _) in env::vars_os() {
        let of_package = [
            "CARGO_PKG_",
            "CARGO_MANIFEST_",
            "CARGO_CFG_",
            "CARGO_BIN_",
            "CARGO_CRATE_",
        ];
        let name = name.to_string_lossy();
        if name == "OUT_DIR" || of_package.iter().any(|part| name.starts_with(part)) {
            cargo.env_remove(&*name);
        }
    }
    let output = cargo
        .args([
            "build",
            "--workspace",
            "--features",
            "picofarm/full,picofarm/wgpu",
            "--bin",
            "picofarm",
            "--lib",
            "--test",
            "it",
        ])
        .args([
            "--message-format",
            "json-render-diagnostics",
            "--profile",
            profile,
        ])
        .arg("--target-dir")
        .arg(target)
        .current_dir(crate::package())
        .stderr(Stdio::inherit())
        .output()
        .expect("cargo starts");
    assert!(output.status.success(), "cargo build: {}", output.status);
    let messages = String::from_utf8_lossy(&output.stdout);
    let messages: Vec<Value> = messages
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect();
    let target = |kind: &str, name: &str| {
        messages
            .iter()
            .find(|m| m["target"]["name"] == name && m["target"]["kind"][0] == kind)
            .unwrap_or_else(|| panic!("cargo names no {kind} {name}"))
    };
    let path = |value: &Value| PathBuf::from(value.as_str().expect("a path"));
    Built {
        program: path(&target("bin", "picofarm")["executable"]),
        python_module: path(&target("cdylib", "picofarm_native")["filenames"][0]),
    }
}
