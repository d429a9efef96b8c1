//! Estimates depend on the settings, and exist if they can be computed.

use super::{Shape, peak_bytes};
use crate::spec::JobSpec;

fn job(stages: &str) -> JobSpec {
    serde_json::from_str(&format!(r#"{{"name": "m", "stage": [{stages}]}}"#)).unwrap()
}

fn rendering(resolution: u32, more: &str) -> String {
    format!(
        r#"{{"scenes": {{"kind": "primitive", "count": 2, "spots": 100}},
            "render": {{"renderer": "r", "resolution": {resolution}{more}}},
            "output": {{"store": "/s", "dataset": "d"}}}}"#
    )
}

fn of(job: &JobSpec, stage: usize) -> Option<u64> {
    peak_bytes(&job.stages[stage].task, &job.known(stage), 2)
}

#[test]
fn the_greatest_image_takes_more_than_its_histogram() {
    let histogram = 4 * 4096 * 4096 * 637;
    let job = job(&rendering(4096, ""));
    let found = of(&job, 0).unwrap();
    assert!((histogram..3 * histogram).contains(&found), "{found}");
}

#[test]
fn more_pixels_bins_or_histograms_take_more() {
    let base = of(&job(&rendering(256, "")), 0);
    for more in [
        rendering(512, ""),
        rendering(256, r#", "bins": 2000"#),
        rendering(256, r#", "per_spot": true"#),
        rendering(256, r#", "subsets": [4, 25]"#),
    ] {
        assert!(of(&job(&more), 0) > base, "{more}");
    }
    let without = rendering(256, r#", "max_bounces": 1"#);
    assert!(of(&job(&without), 0) < base);
}

#[test]
fn rooms_with_furniture_of_many_triangles_take_more() {
    let with = |assets: &str| {
        let room = format!(r#""kind": "furnished", "assets": "{assets}""#);
        let job = job(&rendering(64, "").replace(r#""kind": "primitive""#, &room));
        of(&job, 0).unwrap()
    };
    let primitive = of(&job(&rendering(64, "")), 0).unwrap();
    assert_eq!(with("parametric-1"), primitive);
    // With 355,000 triangles a render took 313 to 350 MB, with 70 MB of the program.
    let more = with("sweethome3d-abc") - primitive;
    assert!((200_000_000..400_000_000).contains(&more), "{more}");
}

#[test]
fn stages_that_read_what_the_job_makes_are_known_and_others_are_not() {
    let reads = |source: &str| {
        format!(
            r#"{{"kind": "reprocess", "source": {source}, "count": 2,
                "reprocess": {{"version": "r", "sensor": {{"rebin": 7}}}},
                "output": {{"store": "/s", "dataset": "e"}}}}"#
        )
    };
    let own = job(&format!("{}, {}", rendering(256, ""), reads("\"render\"")));
    let source = own.known(1).source.unwrap();
    assert_eq!((source.width, source.bins, source.spots), (256, 637, 100));
    assert!(of(&own, 1).unwrap() > 300_000_000);
    let made = super::job::made(&own.stages, (&"/s".into(), &"e".into())).unwrap();
    assert_eq!(made.bins, 91);
    let other = job(&reads(r#"{"store": "/s", "dataset": "other"}"#));
    assert_eq!(of(&other, 0), None);
}

#[test]
fn the_released_network_takes_what_is_known_of_it() {
    let settings = r#"{"target": "tof", "model": "m"}"#;
    let settings: crate::spec::TrainSettings = serde_json::from_str(settings).unwrap();
    let source = Shape {
        height: 256,
        width: 256,
        bins: 637,
        spots: 25,
    };
    let net = settings.network(&source);
    // 356,404,556 parameters.
    let share = net.weights() / (4.0 * 356_404_556.0);
    assert!((0.98..1.02).contains(&share), "{share}");
    let learns = net.learn(&source, 32);
    assert!(learns > 50e9, "{learns}");
    assert!(net.ask(&source) < 0.1 * learns);
}

/// 262,530 values for each block, 36 blocks; 11,504,163 with three channels in and out (11.5 M as
/// published).
#[test]
fn a_swinir_takes_what_is_known_of_it() {
    let settings = r#"{"target": "tof", "model": "m", "net":
        {"architecture": "swinir", "width": 180, "swin": {"groups": 6}}}"#;
    let settings: crate::spec::TrainSettings = serde_json::from_str(settings).unwrap();
    settings.check().unwrap();
    let source = Shape {
        height: 256,
        width: 256,
        bins: 3,
        spots: 25,
    };
    let net = settings.network(&source);
    let share = net.weights() / (4.0 * 11_504_163.0);
    assert!((0.99..1.01).contains(&share), "{share}");
    // Features of 36 blocks, for 65,536 pixels.
    let learns = net.learn(&source, 1);
    assert!(learns > 36.0 * 65_536.0 * 180.0 * 4.0 * 10.0, "{learns}");
    assert!(net.ask(&source) < 0.1 * learns);
}
