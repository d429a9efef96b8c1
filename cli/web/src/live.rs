//! Server-sent events: a page's content, sent again whenever it changes. The event `away` has the
//! reason why the coordinator gave none.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use http::StatusCode;
use tokio::sync::mpsc;

use crate::{
    App,
    answer::{Answer, Problem, stream},
    pages,
    query::Query,
};

/// Most pages that are followed at a time.
pub const MOST: usize = 48;
/// Interval at which the coordinator is asked.
const PERIOD: Duration = Duration::from_secs(1);
/// A comment is sent after so many unchanged periods, so that a vanished browser is noticed.
const QUIET: u32 = 15;

/// Follows the page at `path`.
///
/// # Errors
/// Fails if too many pages are followed.
pub fn follow(app: &Arc<App>, path: String, query: Query) -> Result<Answer, Problem> {
    let Ok(place) = Arc::clone(&app.limits.live).try_acquire_owned() else {
        let what = format!("{MOST} pages are followed already, which is the limit");
        return Err(Problem {
            hint: Some("close pages that are not needed".into()),
            ..Problem::new(StatusCode::SERVICE_UNAVAILABLE, what)
        });
    };
    let (sender, parts) = mpsc::channel(2);
    let app = Arc::clone(app);
    tokio::spawn(async move {
        let _place = place;
        let (mut last, mut quiet) = (String::new(), 0);
        while !app.stop.is_cancelled() {
            let event = match pages::content(&app, &path, &query).await {
                Ok(page) => event("message", &page.content.into_string()),
                // The page keeps its content.
                Err(problem) if problem.is_away() => event("away", &problem.message),
                Err(problem) => event("message", &pages::problem(&problem).content.into_string()),
            };
            quiet += 1;
            let part = match event == last {
                true if quiet < QUIET => None,
                true => Some(": still here\n\n".to_owned()),
                false => Some(event.clone()),
            };
            if let Some(part) = part {
                quiet = 0;
                if sender.send(Bytes::from(part)).await.is_err() {
                    return;
                }
            }
            last = event;
            tokio::select! {
                () = tokio::time::sleep(PERIOD) => {}
                () = sender.closed() => return,
                () = app.stop.cancelled() => return,
            }
        }
    });
    Ok(stream("text/event-stream", parts))
}

/// A text as one event of a type; each of its lines needs a prefix.
fn event(kind: &str, text: &str) -> String {
    let lines = text.split(['\n', '\r']).map(|l| format!("data: {l}\n"));
    format!("event: {kind}\n{}\n", lines.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::event;

    #[test]
    fn no_line_of_a_text_begins_a_field_of_its_own() {
        let text = event("message", "<pre>a\nevent: x\r\ndata: y</pre>");
        let rest = text.strip_prefix("event: message\n").unwrap();
        for line in rest.lines().filter(|line| !line.is_empty()) {
            assert!(line.starts_with("data: "), "{line}");
        }
        assert!(text.ends_with("\n\n") && !text.trim_end().contains("\n\n"));
    }
}
