//! One measured render: CPU seconds over all threads, wall seconds, and the render itself.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use picofarm_scene::Scene;
use picofarm_transient::{Budget, Progress, RenderError, Rendered, Settings};
use rustix::time::{ClockId, clock_gettime};
use tokio_util::sync::CancellationToken;

use crate::args::Render as RenderArgs;
use picofarm_cli::{
    error::{CliError, Code, Result},
    output::{Meter, Output},
    signals,
};

/// Time and result of a render.
pub struct Measured {
    /// CPU seconds of this process, user and system, over all threads.
    pub cpu_s: f64,
    pub wall_s: f64,
    pub rendered: Rendered,
}

/// Returns the CPU time that this process has used.
pub fn cpu_time() -> Duration {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(
        now.tv_sec.unsigned_abs(),
        u32::try_from(now.tv_nsec).unwrap_or(0),
    )
}

/// Returns the settings of a benchmark's renders: without one-bounce peaks, which are analytic.
pub fn settings(args: &RenderArgs, budget: Budget, seed: u64) -> Settings {
    Settings {
        seed,
        ..Settings::new(args.gate.gate(), budget)
    }
}

/// Renders and measures, with a thread pool of its own.
pub struct Bench<'a> {
    pool: rayon::ThreadPool,
    output: Output,
    stop: &'a CancellationToken,
}

impl<'a> Bench<'a> {
    /// Creates a bench with `threads` threads; `None` = all cores.
    ///
    /// # Errors
    /// Fails if the threads cannot be started.
    pub fn new(
        threads: Option<usize>,
        output: Output,
        stop: &'a CancellationToken,
    ) -> Result<Self> {
        let threads = threads.unwrap_or_else(picofarm_tasks::cores).max(1);
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|e| {
                let what = format!("cannot start {threads} threads: {e}");
                CliError::new(Code::Resource, what)
            })?;
        Ok(Self { pool, output, stop })
    }

    /// Renders `scene`. Displays `what` meanwhile.
    ///
    /// # Errors
    /// Fails if the renderer rejects the scene, or on an interruption.
    pub fn render(&self, scene: &Scene, settings: &Settings, what: &str) -> Result<Measured> {
        let watch = Watch {
            meter: Mutex::new(Meter::new(self.output)),
            what,
            stop: self.stop,
        };
        let (cpu, wall) = (cpu_time(), Instant::now());
        let rendered = self
            .pool
            .install(|| picofarm_transient::render(scene, settings, &watch));
        let (cpu_s, wall_s) = (
            cpu_time().saturating_sub(cpu).as_secs_f64(),
            wall.elapsed().as_secs_f64(),
        );
        if let Ok(meter) = watch.meter.into_inner() {
            meter.finish();
        }
        let rendered = rendered.map_err(|e| match e {
            RenderError::Stopped => signals::interrupted("what was measured so far is lost"),
            e => CliError::input(e),
        })?;
        Ok(Measured {
            cpu_s,
            wall_s,
            rendered,
        })
    }
}

struct Watch<'a> {
    meter: Mutex<Meter>,
    what: &'a str,
    stop: &'a CancellationToken,
}

impl Progress for Watch<'_> {
    fn at(&self, done: f32) -> bool {
        if let Ok(mut meter) = self.meter.try_lock() {
            meter.update(f64::from(done), self.what.to_owned());
        }
        !self.stop.is_cancelled()
    }
}
