//! Follows the history as it grows: `job logs --follow` and `events`.
//!
//! Sequence numbers are assigned when an event is written, but an event becomes visible when its
//! transaction ends. Events of two coordinators can therefore appear in another order. So the
//! events of the last moments are read again each time, and those already seen are skipped.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use picofarm_proto::{ids::JobId, messages::Event};

use crate::{
    client::{Client, Page},
    error::{CliError, Code, Result},
    output::{Output, describe::describe_event},
    settings::Settings,
    signals,
};

use super::hook::Hook;

/// Interval between requests to the coordinator.
const PAUSE: Duration = Duration::from_millis(500);
/// Maximum time of a transaction from assigning a number to its end.
const OVERLAP: Duration = Duration::from_secs(2);
/// Maximum number of events in an answer, limited by the coordinator.
const PAGE: u32 = 10_000;
/// Time for which a coordinator may be unreachable.
const AWAY: Duration = Duration::from_secs(60);

/// The recently seen events.
#[derive(Default)]
struct Window {
    /// All events up to this one have been seen, long enough ago that none is missing.
    after: u64,
    /// Later events, and when each was first seen.
    seen: BTreeMap<u64, Instant>,
}

impl Window {
    /// Returns the new events of a page.
    fn take(&mut self, mut page: Vec<Event>, now: Instant) -> Vec<Event> {
        page.retain(|event| {
            let new = event.sequence > self.after && !self.seen.contains_key(&event.sequence);
            if new {
                self.seen.insert(event.sequence, now);
            }
            new
        });
        page
    }

    /// Forgets events that need not be read again.
    fn advance(&mut self, now: Instant) {
        while let Some(first) = self.seen.first_entry()
            && now.duration_since(*first.get()) > OVERLAP
        {
            self.after = *first.key();
            first.remove();
        }
    }
}

/// `picofarm events`.
///
/// # Errors
/// Fails if the coordinator cannot be reached, refuses, or becomes unreachable; Ctrl-C ends it with
/// exit code 130.
pub async fn run(
    follow_on: bool,
    (last, verbose): (u32, bool),
    hook: Option<Hook>,
    settings: &Settings,
    output: Output,
) -> Result<()> {
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    let page = Page {
        job: None,
        stage: None,
        task: None,
        after: 0,
        limit: last,
        newest: true,
        logs: verbose,
    };
    if follow_on {
        return follow_with(client, page, hook, output).await;
    }
    let (events, _) = client.history(newest(page)).await?;
    output.result(&events, || events.iter().map(|e| line(e, None)).collect());
    Ok(())
}

fn newest(page: Page) -> Page {
    Page {
        // 0 would select the coordinator's own limit.
        limit: page.limit.clamp(1, PAGE),
        ..page
    }
}

fn line(event: &Event, job: Option<JobId>) -> String {
    match job {
        Some(_) => describe_event(event),
        None => format!("{} {}", event.job, describe_event(event)),
    }
}

/// Shows the last events and then each new one, until the job ends. Without a job, it never ends by
/// itself.
///
/// # Errors
/// Fails if the coordinator refuses, or is unreachable for a minute; Ctrl-C ends it with exit code
/// 130.
pub async fn follow(client: Client, page: Page, output: Output) -> Result<()> {
    follow_with(client, page, None, output).await
}

async fn follow_with(
    mut client: Client,
    page: Page,
    hook: Option<Hook>,
    output: Output,
) -> Result<()> {
    let job = page.job;
    let shown = async {
        let mut window = Window::default();
        match hook.as_ref().map(Hook::start).transpose()?.flatten() {
            Some(handled) => {
                let latest = Page { limit: 1, ..page };
                let (latest, _) = client.history(newest(latest)).await?;
                let latest = latest.last().map_or(0, |event| event.sequence);
                window.after = handled.min(latest);
                if handled > latest {
                    output.warn(format!(
                        "warning: the cursor is at event {handled}, but the latest is {latest}: the catalog is another, or was restored; going on from {latest}"
                    ));
                }
            }
            None => {
                let (first, ended) = client.history(newest(page)).await?;
                window.after = first.first().map_or(0, |event| event.sequence - 1);
                let last = first.last().map_or(0, |event| event.sequence);
                show(&window.take(first, Instant::now()), job, output);
                if let Some(hook) = &hook {
                    hook.keep(last)?;
                }
                if ended {
                    return Ok(());
                }
            }
        }
        let mut away: Option<Instant> = None;
        loop {
            tokio::time::sleep(PAUSE).await;
            match news(&mut client, page, &mut window, hook.as_ref(), output).await {
                Ok(true) => return Ok(()),
                Ok(false) => away = None,
                Err(error) if error.code != Code::Coordinator => return Err(error),
                Err(error) => {
                    let since = away.get_or_insert_with(|| {
                        output.warn(format!("warning: {}; trying again", error.message));
                        Instant::now()
                    });
                    // A command that sends messages outlives any pause of the coordinator.
                    if hook.is_none() && since.elapsed() > AWAY {
                        return Err(error);
                    }
                    if let Ok(again) = client.reconnect().await {
                        client = again;
                    }
                }
            }
        }
    };
    tokio::select! {
        ended = shown => ended,
        signal = tokio::signal::ctrl_c() => match signal {
            Ok(()) => Err(signals::interrupted("run it again to go on: nothing was changed")),
            Err(e) => Err(CliError::new(Code::Failed, format!("cannot listen for signals: {e}"))),
        },
    }
}

/// Shows new events. Returns whether the job has ended and all its events were shown.
async fn news(
    client: &mut Client,
    of: Page,
    window: &mut Window,
    hook: Option<&Hook>,
    output: Output,
) -> Result<bool> {
    let mut after = window.after;
    loop {
        let page = Page {
            after,
            limit: PAGE,
            newest: false,
            ..of
        };
        let (events, ended) = client.history(page).await?;
        let whole = events.len() < PAGE as usize;
        after = events.last().map_or(after, |event| event.sequence);
        let events = window.take(events, Instant::now());
        show(&events, of.job, output);
        if let Some(hook) = hook {
            for event in &events {
                hook.handle(event, output)?;
            }
        }
        if whole {
            window.advance(Instant::now());
            return Ok(ended);
        }
    }
}

/// Shows one event per line.
fn show(events: &[Event], job: Option<JobId>, output: Output) {
    for event in events {
        output.result(event, || line(event, job));
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::messages::EventKind;

    use super::*;

    fn page(sequences: &[u64]) -> Vec<Event> {
        let event = |sequence: &u64| Event {
            sequence: *sequence,
            at_ms: 0,
            job: JobId::from_uuid(uuid::Uuid::from_u128(1)),
            stage: None,
            kind: EventKind::Leased,
            task: None,
            lo: None,
            hi: None,
            worker: String::new(),
            message: String::new(),
            seconds: 0.0,
        };
        sequences.iter().map(event).collect()
    }

    fn numbers(events: &[Event]) -> Vec<u64> {
        events.iter().map(|event| event.sequence).collect()
    }

    #[test]
    fn an_event_that_comes_to_light_late_is_shown_and_none_twice() {
        let mut window = Window::default();
        let start = Instant::now();
        assert_eq!(numbers(&window.take(page(&[1, 2, 4]), start)), [1, 2, 4]);
        let later = start + Duration::from_millis(500);
        window.advance(later);
        assert_eq!(window.after, 0, "what is young is read again");
        assert_eq!(numbers(&window.take(page(&[1, 2, 3, 4]), later)), [3]);
        let end = start + OVERLAP + Duration::from_millis(400);
        window.advance(end);
        assert_eq!(window.after, 2, "3 is young still");
        assert!(window.take(page(&[3, 4]), end).is_empty());
        window.advance(end + OVERLAP);
        assert_eq!((window.after, window.seen.len()), (4, 0));
    }
}
