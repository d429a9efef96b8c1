//! The generated wire code matches the schema. It is committed, because building the schema
//! compiler takes longer than building all code that it generates.

use std::{fs, path::Path};

/// Set to 1 to write the file again.
const UPDATE: &str = "PICOFARM_UPDATE_WIRE";
const HEAD: &str = "// @generated from proto/schema by tonic-prost-build; tests/it/generated.rs says how to make it again.\n";

#[test]
fn the_code_of_the_wire_is_what_the_schema_makes() {
    let here = std::env::var("CARGO_MANIFEST_DIR").unwrap();
    let here = Path::new(&here);
    let mut files: Vec<String> = fs::read_dir(here.join("schema/picofarm/v1"))
        .unwrap()
        .map(|file| {
            let name = file.unwrap().file_name().into_string().unwrap();
            format!("picofarm/v1/{name}")
        })
        .collect();
    files.sort();
    let descriptors = protox::compile(files, [here.join("schema")]).unwrap();
    let out = tempfile::tempdir().unwrap();
    tonic_prost_build::configure()
        .emit_rerun_if_changed(false)
        .codec_path("crate::codec::SmallCodec")
        .out_dir(out.path())
        .compile_fds(descriptors)
        .unwrap();
    let made: Vec<_> = fs::read_dir(out.path())
        .unwrap()
        .map(|f| f.unwrap().file_name())
        .collect();
    assert_eq!(made, ["picofarm.v1.rs"], "one package");
    let made = HEAD.to_owned() + &fs::read_to_string(out.path().join("picofarm.v1.rs")).unwrap();
    let kept = here.join("src/generated/picofarm.v1.rs");
    if std::env::var(UPDATE).is_ok_and(|v| v == "1") {
        fs::write(&kept, &made).unwrap();
    }
    assert!(
        fs::read_to_string(&kept).unwrap() == made,
        "proto/src/generated/picofarm.v1.rs is not what proto/schema makes; run `{UPDATE}=1 cargo test -p picofarm-proto \
         --test generated` and commit the file"
    );
}
