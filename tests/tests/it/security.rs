//! Access control: real processes with valid and invalid certificates and tokens, and the answer to
//! each.

use std::{fs, os::unix::fs::PermissionsExt, path::Path};

use picofarm_tests::{Cli, Job, Process, Scratch, http, store, wait::until};
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair, date_time_ymd,
};

type Authority = CertifiedIssuer<'static, KeyPair>;

fn private(path: &Path, text: &str) {
    fs::write(path, text).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o600)).unwrap();
}

/// Creates a certificate authority. Its certificate is written to `NAME.pem`.
fn authority(scratch: &Scratch, name: &str) -> Authority {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, name);
    let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
    fs::write(scratch.join(&format!("{name}.pem")), issuer.pem()).unwrap();
    issuer
}

/// Creates a certificate for `host` with the common name `name`, in `NAME.pem` and `NAME.key`.
fn certificate(scratch: &Scratch, by: &Authority, name: &str, host: &str, until: i32) {
    let mut params = CertificateParams::new(vec![host.to_owned()]).unwrap();
    params.distinguished_name.push(DnType::CommonName, name);
    params.not_before = date_time_ymd(2000, 1, 1);
    params.not_after = date_time_ymd(until, 1, 1);
    let key = KeyPair::generate().unwrap();
    let signed = params.signed_by(&key, by).unwrap();
    fs::write(scratch.join(&format!("{name}.pem")), signed.pem()).unwrap();
    private(&scratch.join(&format!("{name}.key")), &key.serialize_pem());
}

/// Starts a coordinator and waits for its URL.
fn coordinator(cli: &Cli, options: &[&str]) -> (Process, String) {
    let args = [
        "coordinator",
        "--json",
        "--catalog",
        "catalog.sqlite",
        "--listen",
        "127.0.0.1:0",
    ];
    let mut process = cli.start("coordinator", &[&args[..], options].concat());
    let document: serde_json::Value = serde_json::from_str(&process.first_line()).unwrap();
    let url = document["coordinator"].as_str().unwrap().to_owned();
    (process, url)
}

fn token(cli: &Cli, name: &str, roles: &str) -> String {
    let args = [
        "token",
        "create",
        "--tokens",
        "tokens.toml",
        "--name",
        name,
        "--role",
        roles,
    ];
    let made = cli.json(&args);
    made["token"].as_str().unwrap().to_owned()
}

#[test]
fn made_certificates_serve_a_farm_and_are_renewed_while_it_runs() {
    let scratch = Scratch::new("certificates");
    let cli = Cli::new(scratch.path());
    let make = ["certificates", "tls", "--host", "localhost,127.0.0.1"];
    cli.run(&make).ok();
    for (file, mode) in [("ca.key", 0o600), ("farm.key", 0o600), ("ca.pem", 0o644)] {
        let meta = fs::metadata(scratch.join("tls").join(file)).unwrap();
        assert_eq!(meta.permissions().mode() & 0o777, mode, "{file}");
    }
    let token = token(&cli, "ada", "view");
    let tls = ["--tls-cert", "tls/farm.pem", "--tls-key", "tls/farm.key"];
    let options = [&tls[..], &["--tokens", "tokens.toml"]].concat();
    let (process, url) = coordinator(&cli, &options);
    let port = url.rsplit(':').next().unwrap();
    let list = ["job", "list"];
    let caller = cli
        .clone()
        .with("PICOFARM_CA", "tls/ca.pem")
        .with("PICOFARM_TOKEN", &token);
    for host in ["localhost", "127.0.0.1"] {
        let url = format!("https://{host}:{port}");
        caller
            .clone()
            .with("PICOFARM_COORDINATOR", &url)
            .run(&list)
            .ok();
    }
    let authority = fs::read(scratch.join("tls/ca.pem")).unwrap();
    let before = fs::read(scratch.join("tls/farm.pem")).unwrap();
    cli.run(&make).ok();
    assert_eq!(fs::read(scratch.join("tls/ca.pem")).unwrap(), authority);
    assert_ne!(fs::read(scratch.join("tls/farm.pem")).unwrap(), before);
    let at = caller.with("PICOFARM_COORDINATOR", &url);
    at.run(&list).ok();
    process.kill();
    fs::remove_file(scratch.join("tls/ca.key")).unwrap();
    cli.run(&make).fails(3, &["ca.pem", "without ca.key"]);
    for host in ["", "é", "bad host", "https://farm", "farm:7420"] {
        let make = ["certificates", "other", "--host", host];
        cli.run(&make).fails(3, &["--host", "name or an address"]);
    }
    cli.run(&["certificates", "other", "--host", "farm,::1"])
        .ok();
    fs::copy(scratch.join("tls/ca.pem"), scratch.join("other/ca.pem")).unwrap();
    cli.run(&["certificates", "other", "--host", "farm"])
        .fails(3, &["ca.pem", "not the certificate of ca.key"]);
    fs::remove_file(scratch.join("other/ca.pem")).unwrap();
    cli.run(&["certificates", "other", "--host", "farm"]).ok();
    assert!(
        scratch.join("other/ca.pem").exists(),
        "it is made again from its key"
    );
}

#[test]
fn the_right_certificate_and_token_are_let_in_and_all_others_are_told_why_not() {
    let scratch = Scratch::new("security");
    let cli = Cli::new(scratch.path());
    let ours = authority(&scratch, "ours");
    authority(&scratch, "theirs");
    certificate(&scratch, &ours, "server", "localhost", 4000);
    let worker = token(&cli, "worker", "work");
    let ada = token(&cli, "ada", "submit");
    let eve = token(&cli, "eve", "view");
    let tls = [
        "--tls-cert",
        "server.pem",
        "--tls-key",
        "server.key",
        "--tokens",
        "tokens.toml",
    ];
    let trace = [&tls[..], &["--log", "trace"]].concat();
    let (mut process, url) = coordinator(&cli, &trace);
    assert!(url.starts_with("https://localhost:"), "{url}");
    let port = url.rsplit(':').next().unwrap().to_owned();
    let at = |cli: &Cli, url: &str| cli.clone().with("PICOFARM_COORDINATOR", url);
    let trusting = at(&cli, &url).with("PICOFARM_CA", "ours.pem");
    let with = |token: &str| trusting.clone().with("PICOFARM_TOKEN", token);

    // Tokens.
    let list = ["job", "list"];
    with(&ada).run(&list).ok();
    with(&eve).run(&list).ok();
    trusting
        .run(&list)
        .fails(4, &["wants a token", "PICOFARM_TOKEN"]);
    with("pf-wrong")
        .run(&list)
        .fails(4, &["not known", "revoked"]);
    with(&worker)
        .run(&list)
        .fails(4, &["\"worker\"", "needs the role view", "has work"]);
    let job = Job::quick(&scratch.join("store"), 1);
    job.write(&scratch.join("job.toml"));
    let submit = ["job", "submit", "job.toml"];
    with(&eve)
        .run(&submit)
        .fails(4, &["\"eve\"", "needs the role submit", "has view"]);
    private(&scratch.join("ada.token"), &format!("{ada}\n"));
    let from_file = [&list[..], &["--token-file", "ada.token"]].concat();
    trusting.run(&from_file).ok();
    fs::set_permissions(scratch.join("ada.token"), fs::Permissions::from_mode(0o644)).unwrap();
    trusting
        .run(&from_file)
        .fails(3, &["ada.token", "chmod o-rwx"]);

    // Certificates.
    at(&cli, &url)
        .with("PICOFARM_CA", "theirs.pem")
        .run(&list)
        .fails(4, &["not signed by", "theirs.pem", "--ca"]);
    at(&cli, &url)
        .with("PICOFARM_CA", "nowhere.pem")
        .run(&list)
        .fails(3, &["nowhere.pem"]);
    at(&cli, &url)
        .with("PICOFARM_CA", "server.key")
        .run(&list)
        .fails(3, &["server.key", "BEGIN CERTIFICATE"]);
    at(&trusting, &format!("https://127.0.0.1:{port}"))
        .run(&list)
        .fails(4, &["is not for \"127.0.0.1\""]);
    at(&trusting, &format!("http://127.0.0.1:{port}"))
        .run(&list)
        .fails(4, &["speaks TLS", "https://"]);
    at(&trusting, "http://farm.example:1")
        .with("PICOFARM_TOKEN", &ada)
        .run(&list)
        .fails(3, &["in the clear"]);

    // A worker without the role, one with it, and its work.
    let work = ["worker", "--threads", "1", "--log", "trace", "--name"];
    with(&ada)
        .run(&[&work[..], &["ada"]].concat())
        .fails(4, &["needs the role work"]);
    trusting
        .run(&[&work[..], &["nobody"]].concat())
        .fails(4, &["wants a token"]);
    let works = with(&worker).start("worker", &[&work[..], &["w"]].concat());
    with(&ada).run(&[&submit[..], &["--watch"]].concat()).ok();
    assert_eq!(store::finished(&job.place()), [0]);

    // A revoked token.
    cli.run(&["token", "revoke", "--tokens", "tokens.toml", "worker"])
        .ok();
    works.end().fails(4, &["\"worker\" was revoked"]);
    cli.run(&["token", "revoke", "--tokens", "tokens.toml", "ada"])
        .ok();
    until("ada's end", || {
        let refused = with(&ada).run(&list);
        (refused.code == Some(4)).then_some(())
    });
    with(&eve).run(&list).ok();
    assert!(process.runs());
    drop(process);

    for entry in fs::read_dir(scratch.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "stderr") {
            let log = fs::read_to_string(&path).unwrap();
            for token in [&ada, &eve, &worker] {
                assert!(
                    !log.contains(&token[3..]),
                    "{} holds a token",
                    path.display()
                );
            }
        }
    }
}

#[test]
fn a_revocation_is_confirmed_by_the_coordinators_that_are_asked() {
    let scratch = Scratch::new("revoke");
    let cli = Cli::new(scratch.path());
    let names = ["eve", "bob", "ada", "cid"];
    let tokens = names.map(|name| token(&cli, name, "admin"));
    let (_ours, url) = coordinator(&cli, &["--tokens", "tokens.toml"]);
    // The coordinator has another token file, to which nobody copies the revocation.
    fs::copy(scratch.join("tokens.toml"), scratch.join("copy.toml")).unwrap();
    fs::create_dir(scratch.join("elsewhere")).unwrap();
    let elsewhere = Cli::new(&scratch.join("elsewhere"));
    let (_other, other) = coordinator(&elsewhere, &["--tokens", "../copy.toml"]);
    let with = |urls: &str| cli.clone().with("PICOFARM_COORDINATOR", urls);
    let revoke = |name| ["token", "revoke", "--tokens", "tokens.toml", name];

    let asked = with(&url).run(&revoke("eve")).ok();
    assert!(asked.stdout.contains(&format!("{url} refuses eve now")));
    with(&url)
        .with("PICOFARM_TOKEN", &tokens[0])
        .run(&["job", "list"])
        .fails(4, &["not known"]);

    let both = with(&format!("{url},{other}"));
    let asked = both.run(&revoke("bob"));
    let asked = asked.fails(4, &["bob still has access at", &other]);
    assert!(asked.stdout.contains(&format!("{other} STILL ACCEPTS bob")));
    assert!(asked.stdout.contains(&format!("{url} refuses bob now")));

    let asked = with("http://127.0.0.1:1").run(&revoke("ada")).ok();
    assert!(
        asked
            .stdout
            .contains("http://127.0.0.1:1 could not be asked")
    );
    let asked = cli.run(&revoke("cid")).ok();
    assert!(asked.stdout.contains("only the file was changed"));
    let args = ["token", "list", "--tokens", "tokens.toml"];
    assert_eq!(cli.json(&args), serde_json::json!([]));
}

#[test]
fn nobody_is_let_in_while_the_token_file_cannot_be_used() {
    let scratch = Scratch::new("unreadable");
    let cli = Cli::new(scratch.path());
    let eve = token(&cli, "eve", "admin");
    let args = ["--tokens", "tokens.toml", "--http", "127.0.0.1:0"];
    let (process, url) = coordinator(&cli, &args);
    let document: serde_json::Value = serde_json::from_str(process.stdout().trim()).unwrap();
    let ready = format!("{}/readyz", document["http"].as_str().unwrap());
    let eve = cli
        .clone()
        .with("PICOFARM_COORDINATOR", &url)
        .with("PICOFARM_TOKEN", &eve);
    let list = ["job", "list"];
    eve.run(&list).ok();
    let mode = |mode| {
        let file = scratch.join("tokens.toml");
        fs::set_permissions(file, fs::Permissions::from_mode(mode)).unwrap();
    };
    mode(0o644);
    until("the end of the grace", || {
        (eve.run(&list).code == Some(4)).then_some(())
    });
    eve.run(&list)
        .fails(4, &["cannot use the token file", "refuses every caller"]);
    let (code, body) = http::get(&ready).unwrap();
    assert_eq!(code, 503);
    assert!(body.contains("the token file cannot be used"), "{body}");
    assert!(body.contains("chmod o-rwx"), "{body}");
    assert!(process.stderr().contains("every caller is refused until"));
    mode(0o600);
    until("the end of the closure", || {
        (eve.run(&list).code == Some(0)).then_some(())
    });
    until("readiness", || {
        (http::get(&ready).unwrap().0 == 200).then_some(())
    });
}

#[test]
fn a_token_ends_when_it_expires() {
    let scratch = Scratch::new("expires");
    let cli = Cli::new(scratch.path());
    let create = [
        "token",
        "create",
        "--tokens",
        "tokens.toml",
        "--role",
        "admin",
    ];
    let made = |name, expires| {
        let more = ["--name", name, "--expires", expires];
        cli.run(&[&create[..], &more, &["--json"]].concat())
    };
    made("old", "2020-01-01").fails(2, &["in the past"]);
    let token = |name, expires| {
        let document = made(name, expires).ok().json();
        document["token"].as_str().unwrap().to_owned()
    };
    let (long, short) = (token("long", "90d"), token("short", "6s"));
    let (_process, url) = coordinator(&cli, &["--tokens", "tokens.toml"]);
    let with = |token: &str| {
        cli.clone()
            .with("PICOFARM_COORDINATOR", &url)
            .with("PICOFARM_TOKEN", token)
    };
    // An open stream ends too.
    let follows = with(&short).start("events", &["events", "--follow"]);
    until("the end of the token", || {
        (with(&short).run(&["job", "list"]).code == Some(4)).then_some(())
    });
    with(&short)
        .run(&["job", "list"])
        .fails(4, &["\"short\" expired at"]);
    with(&long).run(&["job", "list"]).ok();
    drop(follows);
    let list = cli.run(&["token", "list", "--tokens", "tokens.toml"]).ok();
    assert!(list.stdout.contains("expired 20"), "{}", list.stdout);
    assert!(list.stdout.contains("expires 20"), "{}", list.stdout);
}

#[test]
fn client_certificates_are_judged_by_the_authorities_of_now() {
    let scratch = Scratch::new("authorities");
    let cli = Cli::new(scratch.path());
    let ours = authority(&scratch, "ours");
    let theirs = authority(&scratch, "theirs");
    certificate(&scratch, &ours, "server", "localhost", 4000);
    certificate(&scratch, &theirs, "eve", "eve.example", 4000);
    fs::copy(scratch.join("theirs.pem"), scratch.join("clients.pem")).unwrap();
    let tls = ["--tls-cert", "server.pem", "--tls-key", "server.key"];
    let (process, url) = coordinator(&cli, &[&tls[..], &["--client-ca", "clients.pem"]].concat());
    let eve = cli
        .clone()
        .with("PICOFARM_COORDINATOR", &url)
        .with("PICOFARM_CA", "ours.pem")
        .with("PICOFARM_CERT", "eve.pem")
        .with("PICOFARM_KEY", "eve.key");
    let list = ["job", "list"];
    eve.run(&list).ok();
    let clients = scratch.join("clients.pem");
    fs::write(&clients, "no certificate\n").unwrap();
    until("the end of the grace", || {
        (eve.run(&list).code == Some(4)).then_some(())
    });
    eve.run(&list)
        .fails(4, &["cannot use the client certificate authorities"]);
    assert!(process.stderr().contains("clients.pem"));
    fs::copy(scratch.join("theirs.pem"), &clients).unwrap();
    until("the end of the closure", || {
        (eve.run(&list).code == Some(0)).then_some(())
    });
    // A worker's connection from before the change does not outlive its certificate authority.
    let mut worker = eve.start("worker", &["worker", "--threads", "1", "--log", "info"]);
    worker.until_says("connected");
    fs::copy(scratch.join("ours.pem"), &clients).unwrap();
    worker.until_says("authorities have changed");
    eve.run(&list).fails(4, &["does not know the authority"]);
}

#[test]
fn mutual_tls_lets_in_whom_the_authority_signed() {
    let scratch = Scratch::new("mutual-tls");
    let cli = Cli::new(scratch.path());
    let ours = authority(&scratch, "ours");
    let theirs = authority(&scratch, "theirs");
    certificate(&scratch, &ours, "server", "localhost", 4000);
    certificate(&scratch, &ours, "ada", "ada.example", 4000);
    certificate(&scratch, &theirs, "eve", "eve.example", 4000);
    certificate(&scratch, &ours, "old", "old.example", 2001);
    let tls = [
        "--tls-cert",
        "server.pem",
        "--tls-key",
        "server.key",
        "--client-ca",
        "ours.pem",
    ];
    let (_process, url) = coordinator(&cli, &tls);
    let trusting = cli
        .clone()
        .with("PICOFARM_COORDINATOR", &url)
        .with("PICOFARM_CA", "ours.pem");
    let as_of = |name: &str| {
        let (cert, key) = (format!("{name}.pem"), format!("{name}.key"));
        trusting
            .clone()
            .with("PICOFARM_CERT", &cert)
            .with("PICOFARM_KEY", &key)
    };
    let list = ["job", "list"];
    as_of("ada").run(&list).ok();
    trusting
        .run(&list)
        .fails(4, &["wants a client certificate", "--cert"]);
    as_of("eve")
        .run(&list)
        .fails(4, &["does not know the authority", "--client-ca"]);
    as_of("old")
        .run(&list)
        .fails(3, &["old.pem", "has expired"]);
    let mixed = trusting
        .clone()
        .with("PICOFARM_CERT", "ada.pem")
        .with("PICOFARM_KEY", "eve.key");
    mixed
        .run(&list)
        .fails(3, &["eve.key", "does not match", "ada.pem"]);
    trusting
        .clone()
        .with("PICOFARM_CERT", "ada.pem")
        .run(&list)
        .fails(3, &["--cert needs --key"]);

    let job = Job::quick(&scratch.join("store"), 2);
    job.write(&scratch.join("job.toml"));
    let _worker = as_of("ada").start("worker", &["worker", "--threads", "1"]);
    as_of("ada")
        .run(&["job", "submit", "job.toml", "--watch"])
        .ok();
    assert_eq!(store::finished(&job.place()), [0, 1]);
}

#[test]
fn a_coordinator_with_unusable_files_says_which() {
    let scratch = Scratch::new("security-files");
    let cli = Cli::new(scratch.path());
    let ours = authority(&scratch, "ours");
    certificate(&scratch, &ours, "server", "localhost", 4000);
    certificate(&scratch, &ours, "other", "localhost", 4000);
    certificate(&scratch, &ours, "old", "localhost", 2001);
    fs::write(scratch.join("broken.toml"), "[[caller]]\nname = 3\n").unwrap();
    fs::set_permissions(
        scratch.join("broken.toml"),
        fs::Permissions::from_mode(0o600),
    )
    .unwrap();
    let start = ["coordinator", "--allow-insecure", "--listen", "127.0.0.1:0"];
    let run = |options: &[&str]| cli.run(&[&start[..], options].concat());
    let tls = |cert, key| run(&["--tls-cert", cert, "--tls-key", key]);
    tls("nowhere.pem", "server.key").fails(3, &["nowhere.pem"]);
    tls("server.key", "server.key").fails(3, &["server.key", "BEGIN CERTIFICATE"]);
    tls("server.pem", "server.pem").fails(3, &["server.pem"]);
    tls("server.pem", "other.key").fails(3, &["other.key", "does not match", "server.pem"]);
    run(&["--tls-cert", "server.pem"]).fails(2, &["--tls-key"]);
    run(&["--tokens", "nowhere.toml"]).fails(3, &["nowhere.toml"]);
    run(&["--tokens", "broken.toml"]).fails(3, &["broken.toml", "name"]);

    // Clients must reject an expired certificate. A plain port is distinguished from one with TLS.
    let old = [
        "--allow-insecure",
        "--tls-cert",
        "old.pem",
        "--tls-key",
        "old.key",
    ];
    let (process, url) = coordinator(&cli, &old);
    let trusting = cli.clone().with("PICOFARM_CA", "ours.pem");
    trusting
        .clone()
        .with("PICOFARM_COORDINATOR", &url)
        .run(&["job", "list"])
        .fails(4, &["has expired"]);
    drop(process);
    let (_process, url) = coordinator(&cli, &["--allow-insecure"]);
    let secure = url.replace("http://", "https://");
    trusting
        .with("PICOFARM_COORDINATOR", &secure)
        .run(&["job", "list"])
        .fails(4, &["does not speak TLS", "http://"]);
}

#[test]
fn a_worker_touches_only_its_store_prefixes() {
    let farm = picofarm_tests::Farm::start("store-prefix");
    let elsewhere = farm.scratch.join("elsewhere").display().to_string();
    let job = Job {
        max_failures: 1,
        ..Job::quick(&farm.store(), 1)
    };
    let id = farm.submit(&job);
    let args = ["worker", "--threads", "1", "--store-prefix", &elsewhere];
    let _worker = farm.cli().start("worker", &args);
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    let dead = farm.events_of(&id, "dead");
    let message = dead[0]["message"].as_str().unwrap();
    assert!(
        message.contains("output.store") && message.contains("--store-prefix"),
        "{message}"
    );
    // The submission wrote the store's identity; the worker wrote nothing.
    assert!(picofarm_tests::store::hashes(&farm.store()).is_empty());
}

#[test]
fn a_scene_within_the_prefixes_names_no_file_outside_of_them() {
    let farm = picofarm_tests::Farm::start("store-prefix-scene");
    let inside = farm.scratch.join("inside");
    fs::create_dir(&inside).unwrap();
    let secret = farm.scratch.join("secret");
    fs::write(&secret, "root:x:0:0:hunter2\n").unwrap();
    std::os::unix::fs::symlink(&secret, inside.join("link")).unwrap();
    let prefix = inside.display().to_string();
    let args = ["worker", "--threads", "1", "--store-prefix", &prefix];
    let _worker = farm.cli().start("worker", &args);
    for (name, root) in [
        ("link", "inside"),
        ("../secret", "inside"),
        ("/etc/passwd", "inside"),
        ("../secret", "."),
        ("/etc/passwd", "/"),
    ] {
        let scene = format!(
            r#"<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="60"/></sensor>
            <shape type="ply"><string name="filename" value="{name}"/></shape></scene>"#
        );
        fs::write(inside.join("scene.xml"), scene).unwrap();
        // A submitter can bypass every check in this client program.
        let job = format!(
            "name = \"x\"\n[scenes]\nkind = \"files\"\nroot = {root:?}\nfiles = [\"inside/scene.xml\"]\n\
             [render]\nresolution = 16\nsamples = 2\n[output]\nstore = \"inside/store\"\ndataset = \"d\"\n\
             [limits]\nmax_failures = 1\n"
        );
        fs::write(farm.scratch.join("job.toml"), job).unwrap();
        let said = farm.cli().run(&["job", "submit", "job.toml", "--json"]);
        let all = |ended: &picofarm_tests::cli::Ended| format!("{}{}", ended.stdout, ended.stderr);
        let text = match said.code {
            Some(0) => {
                let id = said.ok().json()["job"].as_str().unwrap().to_owned();
                assert_eq!(farm.until_ended(&id)["state"], "failed");
                all(&farm.cli().run(&["job", "explain", &id]))
            }
            _ => all(&said),
        };
        assert!(
            !text.contains("hunter2") && !text.contains("root:x"),
            "{text}"
        );
        assert!(
            text.contains("is not opened") || text.contains("may not touch"),
            "{text}"
        );
    }
}

#[test]
fn limits_are_named_when_they_are_reached() {
    let scratch = Scratch::new("limits");
    let cli = Cli::new(scratch.path());
    let limits = [
        "--allow-insecure",
        "--max-jobs-per-user",
        "1",
        "--max-tasks-per-job",
        "5",
    ];
    let (_process, url) = coordinator(&cli, &limits);
    let cli = cli.with("PICOFARM_COORDINATOR", &url);
    let submit = |name: &str, count| {
        let job = Job {
            dataset: name.into(),
            ..Job::quick(&scratch.join("store"), count)
        };
        job.write(&scratch.join("job.toml"));
        cli.run(&["job", "submit", "job.toml", "--json"])
    };
    submit("big", 6).fails(7, &["6 tasks", "--max-tasks-per-job"]);
    let first = submit("one", 5).ok().json();
    submit("two", 5).fails(7, &["--max-jobs-per-user"]);
    assert_eq!(
        submit("one", 5).ok().json()["job"],
        first["job"],
        "it is there already"
    );
    cli.run(&["job", "cancel", first["job"].as_str().unwrap()])
        .ok();
    submit("two", 5).ok();
}
