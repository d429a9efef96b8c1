//! A picture of a stage's tasks: one cell for each task, or for several where there are many.

use maud::{Markup, html};
use picofarm_figures::number::thousands;
use picofarm_proto::messages::{JobStatus, StageStatus};

use super::parts::{rest_state, safe};
use crate::history::{History, Known};

/// Most cells of a picture.
const CELLS: u64 = 1200;
/// Cells in a row.
const ROW: u64 = 60;
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

/// Returns the meaning of the colours.
pub fn legend(job: &JobStatus, history: &History) -> Markup {
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
        @if !history.whole {
            p.hint { "The history is being read: " (thousands(history.events)) " events so far. "
                "Tasks without events in them are grey." }
        }
    }
}

/// Returns the picture of a stage.
pub fn draw(job: &JobStatus, position: u32, stage: &StageStatus, history: &History) -> Markup {
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
fn cells(job: &JobStatus, position: u32, stage: &StageStatus, history: &History) -> Vec<Cell> {
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
    // What was not read may be about any task.
    let open = match history.whole {
        true => Cell::Pending,
        false => Cell::Unknown,
    };
    let known = history.stage(position).iter().map(|known| match known {
        Known::Open => open,
        Known::Done => Cell::Done,
        Known::Reused => Cell::Reused,
        Known::Dead => Cell::Dead,
    });
    let rest = std::iter::repeat(open);
    let mut cells: Vec<Cell> = known.chain(rest).take(counts.total as usize).collect();
    for task in job.running.iter().filter(|task| task.stage == position) {
        if let Some(cell) = cells.get_mut(task.index as usize) {
            *cell = Cell::Running;
        }
    }
    cells
}
