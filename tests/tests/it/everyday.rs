//! Commands of a new user, and ordinary mishaps.

use std::{
    fs,
    io::{BufRead, BufReader},
};

use picofarm_tests::{Cli, Farm, Job, Scratch, Signal, poison, store, wait::until};

/// Runs a small demo.
fn demo(cli: &Cli, resolution: &str) -> serde_json::Value {
    let args = ["demo", "--scenes", "1", "--samples", "4", "--spots", "4"];
    let more = ["--assets", "parametric", "--workers", "1", "--resolution"];
    cli.json(&[&args[..], &more, &[resolution]].concat())
}

/// Generates a scene, `room.glb`.
fn room(cli: &Cli) {
    let args = ["scene", "generate", "--kind", "primitive", "--seed", "5"];
    cli.run(
        &[
            &args[..],
            &["--spots", "4", "--resolution", "16", "--out", "room.glb"],
        ]
        .concat(),
    )
    .ok();
}

#[test]
fn a_demo_of_other_settings_gets_a_data_set_of_its_own_and_paths_may_climb() {
    let scratch = Scratch::new("demo-settings");
    let cli = Cli::new(scratch.path());
    let first = demo(&cli, "16");
    let place = scratch.join("picofarm-demo/store/rooms");
    let hashes = store::hashes(&place);
    // Another resolution, like other furniture, gives another data set.
    let second = demo(&cli, "8");
    assert_ne!(first["dataset"], second["dataset"]);
    let other = second["dataset"].as_str().unwrap();
    assert!(other.contains("/store/rooms-"), "{other}");
    assert_eq!(store::hashes(&place), hashes, "the first stays as it is");
    // Each data set is found again.
    assert_eq!(demo(&cli, "8")["dataset"], second["dataset"]);
    assert_eq!(demo(&cli, "16")["dataset"], first["dataset"]);

    fs::create_dir(scratch.join("inner")).unwrap();
    let inner = Cli::new(&scratch.join("inner"));
    let climbs = "../picofarm-demo/store/rooms";
    inner.run(&["dataset", "info", climbs]).ok();
    inner.run(&["dataset", "verify", climbs]).ok();
    inner
        .run(&["dataset", "split", climbs, "--fractions", "1,0,0"])
        .ok();
    inner
        .run(&["model", "list", "../picofarm-demo/store"])
        .fails(3, &["no models in", "picofarm-demo/store/models", "hint:"]);
    inner
        .run(&["model", "list", "../nowhere"])
        .fails(3, &["nowhere: there is no such folder"]);
    inner
        .run(&["dataset", "info", "s3:/bucket/rooms"])
        .fails(2, &["s3://bucket/rooms"]);
}

#[test]
fn a_second_job_file_gets_a_name_of_its_own() {
    let scratch = Scratch::new("init");
    let cli = Cli::new(scratch.path());
    cli.run(&["job", "init"]).ok();
    let ended = cli.run(&["job", "init", "--kind", "train"]).ok();
    assert!(
        ended.stdout.contains("picofarm job plan train.toml"),
        "{}",
        ended.stdout
    );
    assert!(scratch.join("job.toml").exists() && scratch.join("train.toml").exists());
    cli.run(&["job", "init", "my jobs.toml"]).ok();
    cli.run(&["job", "init", "my jobs.toml", "--kind", "graph"])
        .fails(
            3,
            &[
                "my jobs.toml exists",
                "picofarm job init 'my jobs-2.toml' --kind graph",
            ],
        );
    cli.run(&["demo", "--seed", "-1"])
        .fails(2, &["-1", "--seed"]);
}

#[test]
fn a_followed_job_outlives_its_coordinator() {
    let mut farm = Farm::start("watch");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let watching = farm.cli().start("watch", &["job", "watch", &id]);
    // The watcher is connected when the history shows that it waits. Killing the coordinator
    // earlier would test nothing.
    until("the watcher's first line", || {
        let log = fs::read_dir(farm.scratch.path()).unwrap();
        log.map(|e| e.unwrap().path())
            .filter(|p| p.to_string_lossy().ends_with("-watch.stderr"))
            .any(|p| fs::read_to_string(p).unwrap().contains("0/2 scenes"))
            .then_some(())
    });
    farm.kill_coordinator();
    farm.start_coordinator();
    let _worker = farm.worker("worker");
    let ended = watching.end().ok();
    assert!(ended.stderr.contains("is away"), "{}", ended.stderr);
    assert!(ended.stdout.contains("2 done"), "{}", ended.stdout);
}

#[test]
fn a_followed_job_whose_coordinator_stays_away_ends_with_a_code_of_its_own_and_says_how_to_go_on() {
    let mut farm = Farm::start("away");
    let id = farm.submit(&Job::quick(&farm.store(), 2));
    let mut watching = farm.cli().start("watch", &["job", "watch", &id]);
    watching.until_says("0/2 scenes");
    farm.kill_coordinator();
    let ended = watching.end().fails(4, &["stayed away for"]);
    let way_on = format!("picofarm job watch {id}");
    assert!(ended.stderr.contains(&way_on), "{}", ended.stderr);
}

#[test]
fn a_coordinator_that_does_not_answer_is_left_for_the_next() {
    let mut farm = Farm::start("mute");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    job.write(&farm.scratch.join("job.toml"));
    // The system accepts connections, but nobody ever reads from them.
    let mute = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mute = format!("http://{}", mute.local_addr().unwrap());
    let good = farm.url().to_owned();
    let at = |urls: &str| farm.cli().with("PICOFARM_COORDINATOR", urls);
    let both = at(&format!("{mute},{good}"));
    let status = ["job", "status", &id, "--json"];
    let commands = [
        &status[..],
        &["job", "list"],
        &["workers"],
        &["job", "explain", &id],
    ];
    let all: Vec<_> = commands
        .iter()
        .map(|args| both.start("mute", args))
        .collect();
    let alone = at(&mute).start("mute", &["job", "list"]);
    let gone = at(&format!("{mute},http://127.0.0.1:1")).start("mute", &["job", "list"]);
    for process in all {
        process.end().ok();
    }
    farm.coordinator().signal(Signal::Stop);
    let frozen = farm.cli().start("frozen", &["job", "list"]);
    let asked = farm.cli().start("frozen", &["job", "submit", "job.toml"]);
    let silent = "it took the connection and did not answer";
    alone
        .end()
        .fails(4, &["no coordinator answers", &mute, silent]);
    gone.end()
        .fails(4, &[&mute, silent, "http://127.0.0.1:1 (", "refused"]);
    frozen
        .end()
        .fails(4, &["no coordinator answers", &good, silent]);
    asked.end().fails(4, &["no coordinator answers", &good]);
}

#[test]
fn results_that_do_not_reach_stdout_fail_the_command() {
    let scratch = Scratch::new("stdout");
    let cli = Cli::new(scratch.path());
    let into = |args: &[&str], file: &str| {
        let stdout = fs::OpenOptions::new().write(true).open(file).unwrap();
        cli.command(args).stdout(stdout).output().unwrap()
    };
    let create = [
        "token", "create", "--tokens", "t.toml", "--name", "a", "--role", "view",
    ];
    for args in [
        &["config"][..],
        &["config", "--json"],
        &["--version"],
        &["job", "--help"],
        &["completions", "bash"],
        &create,
    ] {
        let ended = into(args, "/dev/full");
        let said = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(7), "{args:?}: {said}");
        assert!(said.contains("standard output"), "{args:?}: {said}");
        assert_eq!(into(args, "/dev/null").status.code(), Some(0), "{args:?}");
    }
    // A reader that closes the pipe early.
    let mut child = cli
        .command(&["config"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let ended = child.wait_with_output().unwrap();
    assert_eq!((ended.status.code(), &*ended.stderr), (Some(0), &[][..]));
    // A full stderr does not end running work either.
    let full = fs::OpenOptions::new()
        .write(true)
        .open("/dev/full")
        .unwrap();
    let ended = cli.command(&["job", "status", "x"]).stderr(full).output();
    assert_eq!(ended.unwrap().status.code(), Some(4));
}

#[test]
fn files_that_never_end_are_refused_by_name() {
    let scratch = Scratch::new("endless");
    let cli = Cli::new(scratch.path());
    for args in [
        &["job", "plan", "/dev/zero"][..],
        &["job", "submit", "/dev"],
        &["sweep", "extend", "/dev/zero", "--trials", "2"],
        &["job", "list", "--token-file", "/dev/zero"],
        &[
            "job",
            "list",
            "--coordinator",
            "https://localhost:1",
            "--ca",
            "/dev/zero",
        ],
        &["token", "list", "--tokens", "/dev/zero"],
    ] {
        cli.run(args).fails(3, &["/dev"]);
    }
}

#[test]
fn a_terminal_that_closes_ends_a_farm_in_order() {
    let scratch = Scratch::new("hangup");
    let cli = Cli::new(scratch.path());
    let args = ["--listen", "127.0.0.1:0"];
    let up = [&["up", "--workers", "1"][..], &args].concat();
    let alone = [&["coordinator", "--allow-insecure"][..], &args].concat();
    for args in [up, alone] {
        let mut farm = cli.start("farm", &args);
        farm.first_line();
        farm.signal(Signal::Hangup);
        let ended = farm.end().ok();
        assert!(ended.stderr.contains("stopping"), "{}", ended.stderr);
    }
}

#[test]
fn a_log_that_nobody_reads_stops_nobody() {
    let scratch = Scratch::new("unread");
    let cli = Cli::new(scratch.path());
    let args = ["coordinator", "--allow-insecure", "--listen", "127.0.0.1:0"];
    let mut coordinator = cli
        .command(&[&args[..], &["--json", "--log", "trace"]].concat())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let stdout = coordinator.stdout.as_mut().unwrap();
    BufReader::new(stdout).read_line(&mut line).unwrap();
    let document: serde_json::Value = serde_json::from_str(&line).unwrap();
    let cli = cli.with(
        "PICOFARM_COORDINATOR",
        document["coordinator"].as_str().unwrap(),
    );
    // About 10 kB of log each; the capacity of a pipe is 64 kB.
    for _ in 0..20 {
        cli.run(&["job", "list"]).ok();
    }
    coordinator.kill().unwrap();
    coordinator.wait().unwrap();
}

#[test]
fn a_lost_worker_is_named_with_its_task() {
    let farm = Farm::with_lease("lost", 2.0);
    let id = farm.submit(&Job::slow(&farm.store(), 1));
    let worker = farm.worker("unlucky");
    assert!(farm.until_busy(&id, &["unlucky"]));
    worker.kill();
    let said = until("a word on the worker", || {
        let said = farm.run(&["job", "logs", &id]).ok().stdout;
        said.contains("unlucky was lost").then_some(said)
    });
    assert!(
        said.contains("worker unlucky was lost (connection closed) while it ran task 0"),
        "{said}"
    );
    let said = farm.run(&["job", "explain", &id]).ok().stdout;
    assert!(said.contains("worker unlucky was lost"), "{said}");
}

#[test]
fn a_cancelled_job_submitted_again_is_not_said_to_run() {
    let farm = Farm::start("again");
    let job = Job::quick(&farm.store(), 3);
    let id = farm.submit(&job);
    let file = farm.scratch.join("quick.toml").display().to_string();
    let plan = farm.run(&["job", "plan", &file]).ok();
    assert!(plan.stdout.contains("it is active"), "{}", plan.stdout);
    let again = farm.run(&["job", "submit", &file]).ok();
    assert!(
        again.stdout.contains("was there already: active"),
        "{}",
        again.stdout
    );
    farm.run(&["job", "cancel", &id]).ok();
    let ended = farm
        .run(&["job", "submit", &file])
        .fails(5, &["was cancelled", "--again"]);
    assert!(!ended.stdout.contains("3 run"), "{}", ended.stdout);
    assert!(!ended.stderr.contains("follow it"), "{}", ended.stderr);
    let plan = farm.run(&["job", "plan", &file]).ok();
    assert!(plan.stdout.contains("it was cancelled"), "{}", plan.stdout);
    let _worker = farm.worker("worker");
    farm.run(&["job", "submit", &file, "--again", "--watch"])
        .ok();
}

#[test]
fn a_plan_says_which_paths_carry_the_variance_where_it_is_asked() {
    let farm = Farm::start("variance");
    let cli = farm.cli();
    room(&cli);
    let plan = ["scene", "plan", "room.glb", "--resolution", "8"];
    let plan = [&plan[..], &["--samples", "2"]].concat();
    let plain = cli.run(&plan).ok().stdout;
    assert!(!plain.contains("of variance"), "{plain}");
    let asked = [&plan[..], &["--variance"]].concat();
    let table = cli.run(&asked).ok().stdout;
    assert!(table.contains("% of energy, of variance"), "{table}");
    let classes = cli.json(&asked)["variance"].clone();
    for share in ["energy", "variance"] {
        let all = classes.as_array().unwrap().iter();
        let sum: f64 = all.map(|c| c[share].as_f64().unwrap()).sum();
        assert!((sum - 1.0).abs() < 1e-6, "{share}: {classes}");
    }
}

#[test]
fn scenes_without_light_say_why() {
    let farm = Farm::start("dark");
    let cli = farm.cli();
    room(&cli);
    let render = [
        "scene",
        "render",
        "room.glb",
        "--resolution",
        "8",
        "--samples",
        "2",
    ];
    for (gate, why) in [
        (
            ["--gate-start-m", "1000", "--bins", "8"],
            "gate starts at 1000.00 m",
        ),
        (
            ["--bin-width-m", "0.001", "--bins", "8"],
            "gate ends at 1.01 m",
        ),
    ] {
        let out = gate[1].replace('.', "-");
        let ended = cli
            .run(&[&render[..], &gate, &["--out", &out]].concat())
            .ok();
        let said = ended.stdout;
        assert!(said.contains("warning: the histogram is empty"), "{said}");
        assert!(said.contains(why), "{said}");
    }
    let plan = [
        "scene",
        "plan",
        "room.glb",
        "--resolution",
        "8",
        "--samples",
        "2",
    ];
    let narrow = ["--bin-width-m", "0.001", "--bins", "8"];
    let ended = cli.run(&[&plan[..], &narrow].concat()).ok();
    assert!(
        ended
            .stdout
            .contains("warning: no light arrives within the gate: first light at"),
        "{}",
        ended.stdout
    );
    let ended = cli.run(&plan).ok();
    assert!(!ended.stdout.contains("warning"), "{}", ended.stdout);

    let job = Job {
        gate_start_m: 1000.0,
        ..Job::quick(&farm.store(), 2)
    };
    job.write(&farm.scratch.join("dark.toml"));
    let _worker = farm.worker("worker");
    let ended = farm.run(&["job", "submit", "dark.toml", "--watch"]).ok();
    assert!(
        ended
            .stderr
            .contains("warning: all 2 scenes rendered are without light"),
        "{}",
        ended.stderr
    );
}

/// Checks that a text moves no cursor, and that none of its lines imitates this program's messages.
fn assert_harmless(text: &str) {
    let bad = |c: char| (c.is_control() && c != '\n') || ('\u{202a}'..='\u{202e}').contains(&c);
    assert!(!text.contains(bad), "{text:?}");
    let forged = |line: &str| line.starts_with("error: forged") || line.starts_with("forged");
    assert!(!text.lines().any(forged), "{text}");
}

#[test]
fn what_workers_and_scenes_send_reaches_no_terminal_unescaped() {
    let mut farm = Farm::start("terminal-farm");
    let _worker = farm.worker("honest");
    poison::lie(farm.url());
    let job = poison::job(&farm.store(), farm.scratch.path(), 0);
    let id = farm.submit(&job);
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    poison::assert_told(&farm.events(&id));
    for args in [
        &["workers"][..],
        &["events", "--last", "100"],
        &["job", "list"],
        &["job", "status", &id],
        &["job", "logs", &id],
        &["job", "explain", &id],
        &["job", "logs", &id, "--task", "0"],
    ] {
        let ended = farm.run(args).ok();
        assert_harmless(&ended.stdout);
        assert_harmless(&ended.stderr);
    }
    let log = farm.coordinator().stderr();
    assert!(log.contains("owned"), "{log}");
    assert_harmless(&log);
}

#[test]
fn names_from_elsewhere_move_no_cursor_and_forge_no_line() {
    let scratch = Scratch::new("terminal");
    let cli = Cli::new(scratch.path());
    let evil = "x\u{1b}]0;owned\u{7}\u{1b}[2J\u{9b}1A\nerror: forged\u{202e}.glb";
    let ended = cli.run(&["scene", "show", evil]).code(3);
    assert_harmless(&ended.stderr);
    let ended = cli.run(&["scene", "show", evil, "--json"]).code(3);
    assert_harmless(&ended.stderr);
    assert!(
        ended.error()["message"].as_str().unwrap().contains(evil),
        "JSON says the same"
    );
    // The contents of a file also come from others.
    let json = format!(
        "{{\"asset\": {{\"version\": \"2.0\"}}, \"extensionsRequired\": [{}]}}",
        serde_json::to_string(evil).unwrap()
    );
    fs::write(scratch.join("evil.gltf"), json).unwrap();
    assert_harmless(&cli.run(&["scene", "show", "evil.gltf"]).code(3).stderr);
    fs::write(
        scratch.join("job.toml"),
        format!("name = \"n\"\n{:?} = 1\n", "evil\u{9b}31m"),
    )
    .unwrap();
    assert_harmless(&cli.run(&["job", "plan", "job.toml"]).code(3).stderr);
    assert_harmless(&cli.run(&["dataset", "info", evil]).stderr);
}

#[test]
fn a_job_file_is_checked_without_a_coordinator() {
    let scratch = Scratch::new("check");
    let cli = Cli::new(scratch.path());
    cli.run(&["job", "init"]).ok();
    let checked = cli.json(&["job", "check", "job.toml"]);
    assert_eq!(checked["stages"][0]["kind"], "render");
    assert_eq!(checked["stages"][0]["tasks"], checked["tasks"]);
    let shown = cli.run(&["job", "check", "job.toml"]).ok().stdout;
    assert!(shown.contains("no fault found"), "{shown}");
    let text = fs::read_to_string(scratch.join("job.toml")).unwrap();
    assert!(text.contains("resolution"));
    let wrong = text.replace("resolution", "resolutoin");
    fs::write(scratch.join("wrong.toml"), wrong).unwrap();
    cli.run(&["job", "check", "wrong.toml"])
        .fails(3, &["wrong.toml", "resolutoin", "resolution"]);
    cli.run(&["man", "manuals"]).ok();
    let page = fs::read_to_string(scratch.join("manuals/picofarm-job-check.1")).unwrap();
    assert!(page.contains("without a coordinator"), "{page}");
}

#[test]
fn jobs_are_found_by_number_and_name_and_the_latest_as_last() {
    let farm = Farm::start("numbers");
    let first = farm.submit(&Job::quick(&farm.store(), 1));
    let mut other = Job::quick(&farm.store(), 2);
    other.name = "other".into();
    let second = farm.submit(&other);
    for (name, id) in [
        ("1", &first),
        ("2", &second),
        ("last", &second),
        ("other", &second),
    ] {
        let status = farm.json(&["job", "status", name]);
        assert_eq!(status["id"].as_str(), Some(id.as_str()), "{name}: {status}");
    }
    farm.run(&["job", "status", "3"])
        .fails(3, &["no job \"3\"", "job list"]);
    let list = farm.run(&["job", "list"]).ok().stdout;
    let newest = list.lines().nth(1).unwrap();
    assert!(
        newest.starts_with('2') && newest.contains(&second),
        "{list}"
    );
}

#[test]
fn a_command_runs_once_for_each_job_that_ends_also_after_a_restart() {
    let farm = Farm::start("hook");
    let _worker = farm.worker("worker");
    let said = farm.scratch.join("said");
    let run = "read event; echo \"$PICOFARM_EVENT $PICOFARM_JOB $event\" >> said; exit 3";
    let follow = ["events", "--follow", "--cursor", "cursor", "--run", run];
    let lines = |count: usize| {
        until("the command", || {
            let said = fs::read_to_string(&said).unwrap_or_default();
            let lines: Vec<String> = said.lines().map(String::from).collect();
            (lines.len() >= count).then_some(lines)
        })
    };
    let mut watching = farm.cli().start("events", &follow);
    until("the cursor", || {
        farm.scratch.join("cursor").exists().then_some(())
    });
    let first = farm.submit(&Job::quick(&farm.store(), 1));
    farm.until_ended(&first);
    let heard = lines(1);
    assert!(
        heard[0].starts_with(&format!("ended {first} {{")),
        "{heard:?}"
    );
    watching.until_says("the command ended with exit status: 3");
    watching.kill();
    let mut other = Job::quick(&farm.store(), 2);
    other.name = "other".into();
    let second = farm.submit(&other);
    farm.until_ended(&second);
    let _watching = farm.cli().start("events", &follow);
    let heard = lines(2);
    assert!(
        heard[1].starts_with(&format!("ended {second} {{")),
        "{heard:?}"
    );
    assert_eq!(heard.len(), 2);
    farm.run(&["events", "--follow", "--run", "true", "--kinds", "end"])
        .fails(3, &["--kinds", "\"end\"", "ended"]);
}
