//! Compiles the schema with protox, so that no protoc need be installed.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files = [
        "picofarm/v1/audit.proto",
        "picofarm/v1/job.proto",
        "picofarm/v1/explain.proto",
        "picofarm/v1/jobs_service.proto",
        "picofarm/v1/farm_service.proto",
    ];
    let descriptors = protox::compile(files, ["schema"])?;
    tonic_prost_build::configure()
        .emit_rerun_if_changed(false)
        .compile_fds(descriptors)?;
    println!("cargo:rerun-if-changed=schema");
    Ok(())
}
