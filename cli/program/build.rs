//! Passes the features and the commit for `picofarm --version` to the compiler.

use std::{path::Path, process::Command};

/// Features listed by `picofarm --version`, in the order of `Cargo.toml`.
const FEATURES: [&str; 9] = [
    "clouds", "figures", "formats", "postgres", "networks", "cuda", "wgpu", "traces", "web",
];

/// Returns the output of git, or `None` outside a checkout or without git.
fn git(args: &[&str]) -> Option<String> {
    let output = Command::new("git").args(args).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    (output.status.success() && !text.trim().is_empty()).then(|| text.trim().to_owned())
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // The log of HEAD grows with each commit and checkout.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"])
        && Path::new(&log).exists()
    {
        println!("cargo::rerun-if-changed={log}");
    }
    let commit = git(&["log", "-1", "--format=%h %cs"]).unwrap_or_else(|| "no commit".to_owned());
    let has = |name: &&str| {
        let variable = format!("CARGO_FEATURE_{}", name.to_uppercase());
        std::env::var_os(variable).is_some()
    };
    let built: Vec<&str> = FEATURES.into_iter().filter(has).collect();
    let features = match built.is_empty() {
        true => "none".to_owned(),
        false => built.join(", "),
    };
    println!("cargo::rustc-env=PICOFARM_COMMIT={commit}");
    println!("cargo::rustc-env=PICOFARM_FEATURES={features}");
}
