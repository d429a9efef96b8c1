//! Server-sent events: a page's content, sent again whenever it changes. The event `away` has the
//! reason why the coordinator gave none. All viewers of a page share its content, so the
//! coordinator is asked as often for fifty of them as for one.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bytes::Bytes;
use http::StatusCode;
use tokio::sync::{Notify, mpsc, watch};

use crate::{
    App,
    answer::{Answer, Problem, stream},
    pages,
    query::Query,
};

/// Most viewers that follow pages at a time.
pub const MOST: usize = 160;
/// Interval at which the coordinator is asked for a page, where few pages are followed.
const PERIOD: Duration = Duration::from_secs(1);
/// Number of different pages that are asked for in a period. With more, each has longer intervals.
const PAGES: usize = 4;
/// A page whose content takes long is asked for again after so many times that.
const PAUSE: u32 = 10;
/// The longest interval.
const LONGEST: Duration = Duration::from_secs(15);
/// A comment is sent after so long without change, so that a vanished browser is noticed.
const QUIET: Duration = Duration::from_secs(15);

/// The last event of a page; empty until there is one.
type Feed = watch::Sender<Bytes>;

/// The followed pages, by path and query, and the number of acts of users.
#[derive(Default)]
pub struct Feeds {
    pages: Mutex<HashMap<String, Arc<Feed>>>,
    acts: AtomicU64,
    acted: Notify,
}

impl Feeds {
    /// Forgets all content, because a user has changed a job, and asks for it again at once.
    pub fn renew(&self) {
        self.acts.fetch_add(1, Ordering::SeqCst);
        for feed in self.pages.lock().expect("no holder panics").values() {
            feed.send_replace(Bytes::new());
        }
        self.acted.notify_waiters();
    }

    /// Returns the events of a page, which a task makes as long as somebody follows them.
    fn follow(app: &Arc<App>, to: &str) -> watch::Receiver<Bytes> {
        let mut feeds = app.feeds.pages.lock().expect("no holder panics");
        if let Some(feed) = feeds.get(to) {
            return feed.subscribe();
        }
        let (feed, events) = watch::channel(Bytes::new());
        let feed = Arc::new(feed);
        feeds.insert(to.to_owned(), Arc::clone(&feed));
        tokio::spawn(ask(Arc::clone(app), to.to_owned(), feed));
        events
    }

    fn len(&self) -> usize {
        self.pages.lock().expect("no holder panics").len()
    }

    /// Ends a feed that nobody follows; returns whether it has ended.
    fn end_unfollowed(&self, to: &str, feed: &Feed) -> bool {
        let mut feeds = self.pages.lock().expect("no holder panics");
        let ended = feed.receiver_count() == 0;
        if ended {
            feeds.remove(to);
        }
        ended
    }
}

/// Asks for a page's content again and again, until nobody follows it.
async fn ask(app: Arc<App>, to: String, feed: Arc<Feed>) {
    let (path, rest) = to.split_once('?').unwrap_or((&to, ""));
    let query = Query::parse(rest);
    while !app.feeds.end_unfollowed(&to, &feed) {
        let start = Instant::now();
        let acts = app.feeds.acts.load(Ordering::SeqCst);
        let acted = app.feeds.acted.notified();
        let event = match pages::content(&app, path, &query).await {
            Ok(page) => event("message", &page.content.into_string()),
            // The page keeps its content.
            Err(problem) if problem.is_away() => event("away", &problem.message),
            Err(problem) => event("message", &pages::problem(&problem).content.into_string()),
        };
        let event = Bytes::from(event);
        feed.send_if_modified(|last| {
            // The content may be from before the act.
            if app.feeds.acts.load(Ordering::SeqCst) != acts {
                return false;
            }
            let changed = *last != event;
            *last = event;
            changed
        });
        tokio::select! {
            () = tokio::time::sleep(interval(app.feeds.len(), start.elapsed())) => {}
            () = acted => {}
            () = feed.closed() => {}
            () = app.stop.cancelled() => return,
        }
    }
}

/// Returns the time until a page is asked for again, from the number of followed pages and the time
/// that its content took.
fn interval(pages: usize, took: Duration) -> Duration {
    let share = PERIOD.mul_f64((pages as f64 / PAGES as f64).max(1.0));
    share.max(took * PAUSE).min(LONGEST)
}

/// Follows the page at `to`, a path with its query.
///
/// # Errors
/// Fails if too many pages are followed.
pub fn follow(app: &Arc<App>, to: &str) -> Result<Answer, Problem> {
    let Ok(place) = Arc::clone(&app.limits.live).try_acquire_owned() else {
        let what = format!("{MOST} pages are followed already, which is the limit");
        return Err(Problem {
            hint: Some("close pages that are not needed".into()),
            ..Problem::new(StatusCode::SERVICE_UNAVAILABLE, what)
        });
    };
    let (sender, parts) = mpsc::channel(2);
    let mut events = Feeds::follow(app, to);
    let stop = app.stop.clone();
    tokio::spawn(async move {
        let _place = place;
        let mut part = events.borrow_and_update().clone();
        loop {
            if !part.is_empty() && sender.send(part).await.is_err() {
                return;
            }
            part = tokio::select! {
                changed = events.changed() => match changed {
                    Ok(()) => events.borrow_and_update().clone(),
                    Err(_) => return,
                },
                () = tokio::time::sleep(QUIET) => Bytes::from_static(b": still here\n\n"),
                () = sender.closed() => return,
                () = stop.cancelled() => return,
            };
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
    use super::*;

    #[test]
    fn no_line_of_a_text_begins_a_field_of_its_own() {
        let text = event("message", "<pre>a\nevent: x\r\ndata: y</pre>");
        let rest = text.strip_prefix("event: message\n").unwrap();
        for line in rest.lines().filter(|line| !line.is_empty()) {
            assert!(line.starts_with("data: "), "{line}");
        }
        assert!(text.ends_with("\n\n") && !text.trim_end().contains("\n\n"));
    }

    #[test]
    fn many_pages_and_slow_pages_are_asked_for_less_often() {
        let fast = Duration::from_millis(10);
        assert_eq!(interval(1, fast), PERIOD);
        assert_eq!(interval(PAGES, fast), PERIOD);
        assert_eq!(interval(10 * PAGES, fast), 10 * PERIOD);
        assert_eq!(interval(1, Duration::from_millis(300)), 3 * PERIOD);
        assert_eq!(interval(1000, Duration::from_secs(9)), LONGEST);
    }
}
