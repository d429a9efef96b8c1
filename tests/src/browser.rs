//! A real Chromium without a screen, driven over WebDriver (<https://www.w3.org/TR/webdriver2>).
//! `tests/run` installs it from Debian's packages chromium and chromium-driver.

use std::{
    io::{Read, Write},
    net::TcpStream,
    path::Path,
    process::Command,
    time::Duration,
};

use serde_json::{Value, json};

use crate::{Process, ports::lasting, wait::until};

/// A window of a new browser. Its WebGL is computed in software.
pub struct Browser {
    address: String,
    session: String,
    // Ends after its session.
    _driver: Process,
}

impl Browser {
    /// Starts a browser with its profile in `dir`; `None`, with a message, without a Chromium.
    ///
    /// # Panics
    /// If there is one and it does not start.
    pub fn start(name: &str, dir: &Path) -> Option<Self> {
        if Command::new("chromedriver")
            .arg("--version")
            .output()
            .is_err()
        {
            eprintln!("SKIPPED {name}: no chromedriver; tests/run installs chromium-driver");
            return None;
        }
        let port = lasting();
        let address = format!("127.0.0.1:{port}");
        let mut command = Command::new("chromedriver");
        command.arg(format!("--port={port}")).env("HOME", dir);
        let driver = Process::start("chromedriver", command, dir);
        until("chromedriver to listen", || {
            TcpStream::connect(&address).ok()
        });
        let profile = format!("--user-data-dir={}", dir.join("profile").display());
        let options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--disable-dev-shm-usage",
            "--use-gl=angle",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--window-size=1280,900",
            &profile,
        ];
        let wanted = json!({"capabilities": {"alwaysMatch": {
            "browserName": "chrome",
            "goog:chromeOptions": {"args": options},
            "goog:loggingPrefs": {"browser": "ALL"},
        }}});
        let made = call(&address, "POST", "/session", &wanted);
        let session = made["sessionId"].as_str();
        let session = session.unwrap_or_else(|| panic!("no browser: {made}"));
        Some(Self {
            session: session.to_owned(),
            address,
            _driver: driver,
        })
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> Value {
        let path = format!("/session/{}{path}", self.session);
        let answer = call(&self.address, method, &path, body);
        assert!(answer["error"].is_null(), "{method} {path}: {answer}");
        answer
    }

    /// Opens a page and waits until it is loaded.
    pub fn open(&self, url: &str) {
        self.ask("POST", "/url", &json!({"url": url}));
    }

    /// Runs the body of a function in the page, and returns its value.
    pub fn run(&self, script: &str) -> Value {
        self.ask(
            "POST",
            "/execute/sync",
            &json!({"script": script, "args": []}),
        )
    }

    /// Waits until an expression in the page is true.
    ///
    /// # Panics
    /// If it does not become true.
    pub fn until(&self, expression: &str) {
        until(expression, || {
            let seen = self.run(&format!("return Boolean({expression})"));
            (seen == true).then_some(())
        });
    }

    /// Types keys into the element with focus. `\u{e012}` to `\u{e015}` are the arrows left, up,
    /// right and down.
    pub fn press(&self, keys: &str) {
        let keys = keys.chars().flat_map(|key| {
            let key = key.to_string();
            [
                json!({"type": "keyDown", "value": key}),
                json!({"type": "keyUp", "value": key}),
            ]
        });
        let keys: Vec<Value> = keys.collect();
        let actions = json!({"actions": [{"type": "key", "id": "keys", "actions": keys}]});
        self.ask("POST", "/actions", &actions);
    }

    /// Clicks at a place of the element with this id, given as shares of its width and height.
    pub fn click(&self, id: &str, [x, y]: [f64; 2]) {
        let place = self.run(&format!(
            "const e = document.getElementById({id:?}); e.scrollIntoView({{block: 'center'}}); \
             const b = e.getBoundingClientRect(); \
             return [b.left + {x} * b.width, b.top + {y} * b.height].map(Math.floor)"
        ));
        let mouse = [
            json!({"type": "pointerMove", "duration": 0, "x": place[0], "y": place[1]}),
            json!({"type": "pointerDown", "button": 0}),
            json!({"type": "pointerUp", "button": 0}),
        ];
        let actions = json!({"actions": [{"type": "pointer", "id": "mouse", "actions": mouse}]});
        self.ask("POST", "/actions", &actions);
    }

    /// Returns the lines of the console since the last call: errors of scripts, of the network and
    /// of the policy.
    ///
    /// # Panics
    /// If the driver gives no list.
    pub fn console(&self) -> Vec<String> {
        let lines = self.ask("POST", "/se/log", &json!({"type": "browser"}));
        let lines = lines.as_array().expect("the log is a list");
        let text = |line: &Value| format!("{}: {}", line["level"], line["message"]);
        let lines = lines.iter().map(text);
        // How fast software reads its own pictures is no error of a page.
        lines
            .filter(|line| !line.contains("GL Driver Message"))
            .collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The browser ends with its session. After a failed test the driver may be gone already.
        let path = format!("/session/{}", self.session);
        let _ = exchange(&self.address, "DELETE", &path, "");
    }
}

/// Returns the value of the driver's answer.
fn call(address: &str, method: &str, path: &str, body: &Value) -> Value {
    let body = if method == "GET" {
        String::new()
    } else {
        body.to_string()
    };
    let answer = exchange(address, method, path, &body);
    let answer = answer.unwrap_or_else(|e| panic!("{method} {path}: {e}"));
    let mut answer: Value = serde_json::from_slice(&answer)
        .unwrap_or_else(|e| panic!("{method} {path}: {e}: {}", String::from_utf8_lossy(&answer)));
    answer["value"].take()
}

fn exchange(address: &str, method: &str, path: &str, body: &str) -> std::io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(Duration::from_secs(120)))?;
    write!(
        stream,
        "{method} {path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/json\r\n\
         Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    )?;
    let mut answer = Vec::new();
    let mut part = [0; 16 << 10];
    // The driver may keep the connection open, so the announced length counts.
    loop {
        let n = stream.read(&mut part)?;
        answer.extend_from_slice(&part[..n]);
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n");
        let Some(end) = end else {
            if n == 0 {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            continue;
        };
        let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
        let length = head
            .lines()
            .find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok());
        let have = answer.len() - end - 4;
        if n == 0 || length.is_some_and(|length: usize| have >= length) {
            return Ok(answer.split_off(end + 4));
        }
    }
}
