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
            "name = \"rooms\"\n{}\
             [[stage]]\nname = \"apart\"\nkind = \"demultiplex\"\nsource = \"rooms\"\n\
             output = {{ store = {store:?}, dataset = \"apart\" }}\n\
             [[stage]]\nname = \"rooms-3d\"\nkind = \"reconstruct\"\nsource = \"rooms\"\n\
             reconstruct = {{ views = 2, grid = {{ nodes = 48, iterations = 30 }} }}\n\
             output = {{ store = {store:?}, dataset = \"rooms-3d\" }}\n",
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
    // The light of a render agrees with its geometry.
    browser.until("document.querySelectorAll('[data-verdict]').length === 2");
    let verdicts =
        "return [...document.querySelectorAll('[data-verdict]')].map(e => e.textContent).join()";
    let verdicts = browser.run(verdicts);
    assert_eq!(
        browser.run("return [...document.querySelectorAll('[data-verdict]')].every(e => e.dataset.verdict === 'agrees')"),
        true,
        "{verdicts}"
    );
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
    browser.until("document.getElementById('seen').textContent.startsWith('One flash')");
    let drawn = "const c = document.getElementById('histogram'); \
        return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].some(x => x > 0)";
    assert_eq!(browser.run(drawn), true);
    browser.press("\u{e014}");
    browser.until("document.documentElement.dataset.picked === '10,19'");

    // The room in space is another picture, which turns by pointer and keyboard.
    let frames = "return new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))";
    let flat = seek("60");
    browser.run("document.getElementById('screen').focus()");
    browser.press("3");
    browser.until("document.documentElement.dataset.view === 'space'");
    browser.run(frames);
    let in_space = browser.run(PIXELS);
    assert_ne!(in_space, flat);
    browser.press("\u{e014}\u{e013}+");
    browser.run(frames);
    let turned = browser.run(PIXELS);
    assert_ne!(turned, in_space, "arrow keys turn the room");
    browser.run("document.getElementById('surface').click()");
    browser.run(frames);
    assert_ne!(
        browser.run(PIXELS),
        turned,
        "light arrives later than it is at the surfaces"
    );
    browser.run("document.getElementById('surface').click()");
    let orbit = "return new URLSearchParams(location.search).get('orbit')";
    let view = browser.run(orbit);
    assert!(
        view.as_str()
            .is_some_and(|view| view.split(',').count() == 6)
    );
    // A click without a drag picks a point.
    browser.run("delete document.documentElement.dataset.picked");
    browser.press("\u{e011}");
    browser.run(frames);
    browser.click("screen", [0.5, 0.5]);
    browser.until("document.documentElement.dataset.picked");
    browser.run("document.getElementById('screen').focus()");
    browser.press("2");
    browser.run(frames);
    assert_eq!(
        browser.run("const v = document.getElementById('view'); return [v.width, v.height].join()"),
        "32,32"
    );

    // Each export makes a file of its kind.
    for (button, kind) in [
        ("export", "png"),
        ("gif", "gif"),
        ("figure", "svg"),
        ("record", "webm"),
    ] {
        browser.run("document.documentElement.dataset.saved = ''");
        browser.run(&format!(
            "document.getElementById('speed').value = 2; document.getElementById('{button}').click()"
        ));
        browser.until(&format!(
            "/\\.{kind} [1-9]/.test(document.documentElement.dataset.saved)"
        ));
    }
    browser.until("document.getElementById('play').textContent === 'Play'");
    browser.run("document.getElementById('speed').value = 0");

    // A finger on the strip of light shows the time under it.
    let scrub = "const e = document.getElementById('energy'), b = e.getBoundingClientRect(); \
        e.dispatchEvent(new PointerEvent('pointerdown', {pointerId: 1, pointerType: 'touch', \
        clientX: b.left + b.width / 2, clientY: b.top + 5, bubbles: true}))";
    browser.run(scrub);
    browser.run(frames);
    let middle = "const t = document.getElementById('time'); return t.value / t.max";
    let at = browser.run(middle).as_f64().unwrap();
    assert!((at - 0.5).abs() < 0.02, "{at}");

    // Space plays, and time moves on.
    browser.run("document.getElementById('screen').focus()");
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

    // The reconstruction in 3D, with the colours of its errors.
    visit(&browser, &web.at("/data/scene?set=0%2Frooms&scene=1"));
    browser.run("document.querySelector('a[href*=\"/data/room?\"]').click()");
    browser.until("document.documentElement.dataset.room === 'shown'");
    let shown = |colour: &str| {
        browser.run(&format!(
            "const c = document.getElementById('colour'); c.value = '{colour}'; \
             c.dispatchEvent(new Event('input', {{bubbles: true}}))"
        ));
        browser.run(frames);
        browser.run(PIXELS)
    };
    let (shape, error, seen) = (shown("shape"), shown("error"), shown("seen"));
    assert!(shape != error && error != seen && seen != shape);
    browser.run("document.getElementById('hidden').click()");
    browser.run(frames);
    assert_ne!(browser.run(PIXELS), seen, "what the camera does not see");
    browser.run("document.getElementById('screen').focus()");
    browser.press("\u{e012}");
    let there = browser.run("return location.href");
    let view = browser.run(orbit);
    visit(&browser, there.as_str().unwrap());
    browser.until("document.documentElement.dataset.room === 'shown'");
    browser.press("\t");
    assert_eq!(browser.run(orbit), view, "the address has the view");
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
