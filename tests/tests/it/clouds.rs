//! Google's and Azure's stores by URL, against a stand-in: the probe of a store, access control,
//! error messages for missing settings, and bandwidth limits as settings.

use picofarm_tests::{Cli, Scratch, cloud::Cloud};

#[test]
fn a_google_store_is_probed_and_what_it_wants_is_said() {
    let scratch = Scratch::new("gcs");
    let cloud = Cloud::start(&["Bearer good-token"]);
    let cli = Cli::new(scratch.path()).with("GOOGLE_BASE_URL", &cloud.url());
    let doctor = ["doctor", "--store", "gs://lab/sets"];
    cli.run(&doctor)
        .fails(7, &["gs://lab", "GOOGLE_ALLOW_HTTP=true"]);
    let cli = cli.with("GOOGLE_ALLOW_HTTP", "true");
    let good = cli.clone().with("GOOGLE_BEARER_TOKEN", "good-token");
    good.run(&doctor).ok();
    assert_eq!(cloud.count(), 0, "the probe left nothing");
    let bad = cli.clone().with("GOOGLE_BEARER_TOKEN", "bad-token");
    let ended = bad.run(&doctor).fails(
        7,
        &["gs://lab/sets", "403", "GOOGLE_APPLICATION_CREDENTIALS"],
    );
    assert!(!ended.stderr.contains("bad-token"), "{}", ended.stderr);
    cli.with("GOOGLE_APPLICATION_CREDENTIALS", "none.json")
        .run(&doctor)
        .fails(7, &["GOOGLE_APPLICATION_CREDENTIALS", "No such file"]);
    good.run(&["dataset", "info", "gs://lab/none"])
        .fails(3, &["gs://lab/none", "no data set"]);
}

#[test]
fn an_azure_store_is_probed_and_what_it_wants_is_said() {
    let scratch = Scratch::new("azure");
    let cloud = Cloud::start(&["SharedKey lidar:"]);
    let cli = Cli::new(scratch.path())
        .with("AZURE_STORAGE_ENDPOINT", &cloud.url())
        .with("AZURE_ALLOW_HTTP", "true");
    let doctor = ["doctor", "--store", "az://lab/sets"];
    cli.run(&doctor)
        .fails(7, &["az://lab", "AZURE_STORAGE_ACCOUNT_NAME is not set"]);
    let key = |name: &str| {
        cli.clone()
            .with("AZURE_STORAGE_ACCOUNT_NAME", name)
            .with("AZURE_STORAGE_ACCOUNT_KEY", "c2VjcmV0LWtleQ==")
    };
    key("lidar").run(&doctor).ok();
    assert_eq!(cloud.count(), 0, "the probe left nothing");
    let ended = key("other")
        .run(&doctor)
        .fails(7, &["az://lab/sets", "403", "AZURE_STORAGE_ACCOUNT_KEY"]);
    assert!(!ended.stderr.contains("c2VjcmV0"), "{}", ended.stderr);
    key("lidar")
        .run(&["dataset", "info", "az://lab/none"])
        .fails(3, &["az://lab/none", "no data set"]);
}

#[test]
fn limits_on_bandwidth_are_settings_above_zero() {
    let scratch = Scratch::new("bandwidth");
    let cli = Cli::new(scratch.path());
    let limited = cli.clone().with("PICOFARM_STORE_UPLOAD_MB_S", "12.5");
    let shown = limited.json(&["config"]);
    assert_eq!(shown["store_upload_mb_s"]["value"], "12.5", "{shown}");
    assert_eq!(shown["store_download_mb_s"]["value"], "", "{shown}");
    for wrong in ["0", "-1", "fast"] {
        cli.clone()
            .with("PICOFARM_STORE_DOWNLOAD_MB_S", wrong)
            .run(&["doctor"])
            .fails(3, &["store_download_mb_s"]);
    }
    let cloud = Cloud::start(&["Bearer good-token"]);
    limited
        .with("PICOFARM_STORE_DOWNLOAD_MB_S", "12.5")
        .with("GOOGLE_BASE_URL", &cloud.url())
        .with("GOOGLE_ALLOW_HTTP", "true")
        .with("GOOGLE_BEARER_TOKEN", "good-token")
        .run(&["doctor", "--store", "gs://lab/sets"])
        .ok();
}
