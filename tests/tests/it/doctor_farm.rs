//! `picofarm doctor --farm`: every worker checks its own machine.

use std::fs;

use picofarm_tests::{Cli, Process, Scratch, Signal, wait::until};
use serde_json::Value;

fn coordinator(cli: &Cli) -> (Process, String) {
    let args = ["coordinator", "--allow-insecure", "--json"];
    let mut process = cli.start(
        "coordinator",
        &[&args[..], &["--listen", "127.0.0.1:0"]].concat(),
    );
    let line: Value = serde_json::from_str(&process.first_line()).expect("the first line is JSON");
    let url = line["coordinator"].as_str().expect("it names its address");
    (process, url.to_owned())
}

fn worker(cli: &Cli, name: &str, more: &[&str]) -> Process {
    let args = ["worker", "--name", name, "--threads", "1"];
    cli.start(name, &[&args[..], more].concat())
}

#[test]
fn each_worker_proves_its_store_and_scenes_and_one_that_hangs_is_named() {
    let scratch = Scratch::new("doctor-farm");
    let cli = Cli::new(scratch.path());
    let (_coordinator, url) = coordinator(&cli);
    let cli = cli.with("PICOFARM_COORDINATOR", &url);
    cli.run(&["doctor", "--farm"])
        .fails(7, &["no worker is connected"]);
    for folder in ["store", "scenes"] {
        fs::create_dir_all(scratch.join(folder)).unwrap();
    }
    let _free = worker(&cli, "free", &[]);
    let elsewhere = scratch.join("elsewhere").display().to_string();
    let mut bound = worker(&cli, "bound", &["--store-prefix", &elsewhere]);
    let count = || cli.json(&["workers"])["workers"].as_array().map(Vec::len);
    until("two workers", || (count() == Some(2)).then_some(()));

    let ask = ["doctor", "--farm", "--store", "store", "--scenes", "scenes"];
    let ended = cli.run(&[&ask[..], &["--json"]].concat());
    let found = ended
        .fails(
            7,
            &["1 of 2 workers failed a check or did not answer: bound"],
        )
        .json();
    let of = |name: &str, what: &str| {
        let workers = found["workers"].as_array().unwrap();
        let worker = workers.iter().find(|w| w["name"] == name).unwrap();
        let checks = worker["checks"].as_array().unwrap();
        checks.iter().find(|c| c["what"] == what).unwrap()["verdict"].clone()
    };
    for what in ["store", "scenes", "clock"] {
        assert_eq!(of("free", what), "ok", "{found}");
    }
    assert_eq!(
        (of("bound", "store"), of("bound", "scenes")),
        ("bad".into(), "bad".into())
    );
    assert_eq!(of("bound", "clock"), "ok", "{found}");
    assert_eq!(fs::read_dir(scratch.join("store")).unwrap().count(), 0);

    bound.signal(Signal::Stop);
    let ended = cli.run(&["doctor", "--farm", "--store", "store", "--within-s", "2"]);
    let ended = ended.fails(
        7,
        &["1 of 2 workers failed a check or did not answer: bound"],
    );
    assert!(
        ended.stdout.contains("did not answer in time"),
        "{}",
        ended.stdout
    );
    bound.signal(Signal::Continue);
}
