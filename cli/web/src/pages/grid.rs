//! A picture of a stage's tasks: one cell for each task, or for several where there are many.

use maud::{Markup, html};
use picofarm_proto::{
    ids::JobId,
    messages::{Event, EventKind, JobStatus, StageStatus},
};

use super::parts::{rest_state, safe};
use crate::{App, Events, answer::Problem};

/// Most cells of a picture.
const CELLS: u64 = 1200;
/// Cells in a row.
const ROW: u64 = 60;
/// Most events that are read of a job: the state of tasks from before is not known.
const EVENTS: usize = 20_000;

/// The state of a task in the picture, from least to most notable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Cell {
    Reused,
    Done,
    /// Neither done nor dead, and not running.
    Pending,
    Unknown,
    Running,
    Dead,
}

impl Cell {
    fn class(self) -> &'static str {
        match self {
            Self::Reused => "reused",
            Self::Done => "done",
            Self::Pending => "pending",
            Self::Unknown => "unknown",
            Self::Running => "run",
            Self::Dead => "bad",
        }
    }

    fn word(self, job: &JobStatus) -> &'static str {
        match self {
            Self::Reused => "reused",
            Self::Done => "done",
            Self::Pending => rest_state(job),
            Self::Unknown => "unknown",
            Self::Running => "running",
            Self::Dead => "dead",
        }
    }
}

/// Reads the history of a job from its beginning.
pub async fn history(app: &App, job: JobId) -> Result<Vec<Event>, Problem> {
    let mut all: Vec<Event> = Vec::new();
    loop {
        let page = app.farm.events(Events {
            job: Some(job),
            after: all.last().map_or(0, |event| event.sequence),
            limit: 1000,
            ..Events::default()
        });
        let page = page.await?;
        let more = page.len() == 1000;
        all.extend(page);
        if !more || all.len() >= EVENTS {
            return Ok(all);
        }
    }
}

/// Returns the meaning of the colours.
pub fn legend(job: &JobStatus) -> Markup {
    let cells = [
        Cell::Done,
        Cell::Reused,
        Cell::Running,
        Cell::Pending,
        Cell::Dead,
    ];
    html! {
        p.legend { @for cell in cells {
            span { svg viewBox="0 0 10 10" aria-hidden="true" { rect.(cell.class()) width="10" height="10" {} } (cell.word(job)) }
        } }
    }
}

/// Returns the picture of a stage.
pub fn draw(job: &JobStatus, position: u32, stage: &StageStatus, history: &[Event]) -> Markup {
    let total = stage.tasks.total;
    if total == 0 {
        return html! {};
    }
    let each = total.div_ceil(CELLS).max(1);
    let cells = cells(job, position, stage, history);
    let cells: Vec<Cell> = cells
        .chunks(each as usize)
        .map(|part| part.iter().copied().max().unwrap_or(Cell::Unknown))
        .collect();
    let (columns, rows) = (
        ROW.min(cells.len() as u64),
        (cells.len() as u64).div_ceil(ROW),
    );
    let label = format!(
        "{}: {} of {total} tasks done, {} running, {} {}, {} dead; arrow keys move between tasks",
        stage.name,
        stage.tasks.done,
        stage.tasks.leased,
        stage.tasks.pending,
        rest_state(job),
        stage.tasks.dead
    );
    let size = columns * 12;
    html! {
        figure.grid {
            figcaption {
                (safe(&stage.name))
                @if each > 1 { " · a cell is " (each) " tasks and shows the most notable" }
            }
            svg viewBox={ "0 0 " (size) " " (rows * 12) } width=(size) height=(rows * 12) role="group" aria-label=(label) data-row=(ROW) {
                @for (i, cell) in cells.iter().enumerate() {
                    @let i = i as u64;
                    a href={ "/jobs/" (job.id) "/tasks/" (position) "/" (i * each) } tabindex=(if i == 0 { "0" } else { "-1" }) {
                        title { "task " (i * each) ": " (cell.word(job)) }
                        rect.(cell.class()) x=(i % ROW * 12) y=(i / ROW * 12) width="10" height="10" rx="1.5" {}
                    }
                }
            }
        }
    }
}

/// The state of each task.
fn cells(job: &JobStatus, position: u32, stage: &StageStatus, history: &[Event]) -> Vec<Cell> {
    let counts = &stage.tasks;
    // Where all tasks are in one state, no history is needed.
    let all = [
        (counts.reused, Cell::Reused),
        (counts.done, Cell::Done),
        (counts.pending, Cell::Pending),
        (counts.dead, Cell::Dead),
    ];
    if let Some((_, cell)) = all.into_iter().find(|(n, _)| *n == counts.total) {
        return vec![cell; counts.total as usize];
    }
    let first = match history.len() >= EVENTS {
        true => Cell::Unknown,
        false => Cell::Pending,
    };
    let mut cells = vec![first; counts.total as usize];
    for event in history.iter().filter(|e| e.stage == Some(position)) {
        let cell = match event.kind {
            EventKind::Committed => Cell::Done,
            EventKind::Reused => Cell::Reused,
            EventKind::Dead => Cell::Dead,
            EventKind::Retried => Cell::Pending,
            _ => continue,
        };
        let (lo, hi) = match (event.task, event.lo, event.hi) {
            (Some(task), _, _) => (task, task + 1),
            (None, Some(lo), Some(hi)) => (lo, hi),
            _ => continue,
        };
        for task in cells.iter_mut().take(hi as usize).skip(lo as usize) {
            // Of a range of tasks that are tried again, only the dead ones change.
            if event.kind != EventKind::Retried || *task == Cell::Dead {
                *task = cell;
            }
        }
    }
    for task in job.running.iter().filter(|task| task.stage == position) {
        if let Some(cell) = cells.get_mut(task.index as usize) {
            *cell = Cell::Running;
        }
    }
    cells
}
