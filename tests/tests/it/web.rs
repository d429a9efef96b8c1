//! `picofarm web` and the pages of `picofarm up`, in a real browser.

use picofarm_tests::{Browser, Cli, Farm, Job, Process, Rooms, Scratch, http, wait::until};
use serde_json::Value;

/// A server for a farm's store.
struct Web {
    process: Process,
    link: String,
}

impl Web {
    fn start(cli: &Cli, store: &str) -> Self {
        let args = ["web", "--listen", "127.0.0.1:0", "--json", "--store", store];
        let mut process = cli.start("web", &args);
        let line: Value = serde_json::from_str(&process.first_line()).unwrap();
        let link = line["web"].as_str().expect("it prints its link").to_owned();
        Self { process, link }
    }

    /// The address of a path.
    fn at(&self, path: &str) -> String {
        let (origin, _) = self.link.split_once("/?key=").unwrap();
        format!("{origin}{path}")
    }
}

/// Opens a page and fails on anything in its console.
fn visit(browser: &Browser, url: &str) {
    browser.open(url);
    let lines = browser.console();
    assert!(lines.is_empty(), "{url}: {lines:?}");
}

/// The colours of the picture.
const PIXELS: &str = "const gl = document.getElementById('view').getContext('webgl2'); \
    const p = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight); \
    gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, p); \
    return [...p].join(',')";

#[test]
fn a_browser_plays_light_in_flight_and_shows_the_histogram_of_a_pixel() {
    let farm = Farm::start("web-flight");
    let worker = farm.worker("a");
    let store = farm.store();
    let file = farm.scratch.join("rooms.toml");
    std::fs::write(
        &file,
        format!(
            "name = \"rooms\"\n{}",
            Rooms::fine(2).per_spot().stage(&store)
        ),
    )
    .unwrap();
    let job = farm.json(&["job", "submit", &file.display().to_string()]);
    farm.until_ended(job["job"].as_str().unwrap());
    drop(worker);
    let Some(browser) = Browser::start("web", farm.scratch.path()) else {
        return;
    };
    let web = Web::start(&farm.cli(), &store.display().to_string());
    visit(&browser, &web.link);
    let pages = [
        "/",
        "/jobs",
        "/workers",
        "/events",
        "/events?logs=yes",
        "/audit",
        "/data",
        "/models",
        "/data?set=0%2Frooms",
        "/data?set=0%2Frooms&sort=error&mirrors=no",
        "/data/scene?set=0%2Frooms&scene=0&scene2=1",
    ];
    for path in pages {
        visit(&browser, &web.at(path));
    }
    // Images are shown, and the pointer reads values.
    browser.until("[...document.images].every(i => i.complete && i.naturalWidth > 0)");
    browser.run("document.querySelector('.frame').focus()");
    browser.press("\u{e014}");
    browser.until("document.getElementById('readout').textContent.includes('depth')");

    visit(&browser, &web.at("/flight?set=0%2Frooms&scene=0"));
    browser.until("document.documentElement.dataset.flight === 'full'");
    let seek = |bin: &str| {
        browser.run(&format!(
            "const t = document.getElementById('time'); t.value = {bin}; \
             t.dispatchEvent(new Event('input')); t.dispatchEvent(new Event('change'))"
        ));
        browser
            .run("return new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))");
        browser.run(PIXELS)
    };
    let (early, late) = (seek("30"), seek("70"));
    assert_ne!(early, late, "other times show other light");
    assert_eq!(seek("30"), early, "a time always shows the same light");

    browser.click("screen", [0.3, 0.6]);
    browser.until("document.documentElement.dataset.picked === '9,19'");
    browser.until("document.getElementById('picked').textContent.includes('two bounces')");
    let drawn = "const c = document.getElementById('histogram'); \
        return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].some(x => x > 0)";
    assert_eq!(browser.run(drawn), true);
    browser.press("\u{e014}");
    browser.until("document.documentElement.dataset.picked === '10,19'");

    // Space plays, and time moves on.
    let time = "return document.getElementById('clock').textContent";
    let before = browser.run(time);
    browser.press(" ");
    until("the time to move on", || {
        (browser.run(time) != before).then_some(())
    });
    browser.press(" ");

    // The light of one spot is another picture.
    let all = seek("40");
    browser.run(
        "const s = document.getElementById('light'); s.value = 'spot-2'; s.dispatchEvent(new Event('change'))",
    );
    browser.until("document.documentElement.dataset.flight === 'full'");
    assert_ne!(seek("40"), all);
    // Shares are those of all light.
    browser.until("!document.getElementById('picked').textContent.includes('%')");
    // The address has the state: a new page shows the same.
    let there = browser.run("return location.href");
    let shown = browser.run("return document.getElementById('clock').textContent");
    visit(&browser, there.as_str().unwrap());
    browser.until("document.documentElement.dataset.flight === 'full'");
    assert_eq!(
        browser.run("return document.getElementById('light').value"),
        "spot-2"
    );
    assert_eq!(browser.run(time), shown);
    let lines = browser.console();
    assert!(lines.is_empty(), "{lines:?}");
    drop(web.process);
}

#[test]
fn a_browser_cancels_a_job_by_its_form_and_not_by_a_link() {
    let farm = Farm::start("web-job");
    let job = farm.submit(&Job::quick(&farm.store(), 3));
    let Some(browser) = Browser::start("web", farm.scratch.path()) else {
        return;
    };
    let web = Web::start(&farm.cli(), &farm.store().display().to_string());
    visit(&browser, &web.link);
    let page = web.at(&format!("/jobs/{job}"));
    browser.open(&format!("{page}/cancel"));
    // The browser reports the refused status.
    assert!(browser.console().iter().any(|line| line.contains("405")));
    assert_eq!(farm.status(&job)["state"], "active");

    visit(&browser, &page);
    browser.run("document.getElementById('act-pause').click()");
    browser.until("document.getElementById('act-resume') || document.querySelector('.problem')");
    let problem = browser.run("return document.querySelector('.problem')?.textContent ?? ''");
    assert_eq!(problem, "", "the form is accepted");
    assert_eq!(farm.status(&job)["paused"], true);
    // The page follows what others do.
    farm.json(&["job", "resume", &job]);
    browser.until("document.getElementById('act-pause')");
    browser.run("document.querySelector('summary').click()");
    browser.run("document.getElementById('act-cancel').click()");
    browser.until("document.querySelector('h1').textContent.includes('cancelled')");
    assert_eq!(farm.status(&job)["state"], "cancelled");
    assert!(browser.console().is_empty());
}

#[test]
fn an_address_that_others_reach_is_refused_without_a_name() {
    let scratch = Scratch::new("web-open");
    let cli = Cli::new(scratch.path());
    cli.run(&["web", "--listen", "0.0.0.0:0"])
        .fails(3, &["0.0.0.0:0", "--host NAME"]);
    cli.run(&["web", "--host", "farm:80"])
        .fails(3, &["--host farm:80", "without a port"]);
}

#[test]
fn up_serves_the_pages_unless_told_otherwise() {
    let scratch = Scratch::new("web-up");
    let cli = Cli::new(scratch.path());
    let args = ["up", "--listen", "127.0.0.1:0", "--json"];
    let mut up = cli.start("up", &args);
    let line: Value = serde_json::from_str(&up.first_line()).unwrap();
    let link = line["web"].as_str().expect("a link");
    let (origin, _) = link.split_once("/?key=").unwrap();
    let (status, _) = http::get(&format!("{origin}/workers")).expect("somebody answers");
    assert_eq!(status, 401, "the key is needed");
    drop(up);
    let mut quiet = cli.start("quiet", &[&args[..], &["--no-web"]].concat());
    let line: Value = serde_json::from_str(&quiet.first_line()).unwrap();
    assert_eq!(line["web"], Value::Null);
}
