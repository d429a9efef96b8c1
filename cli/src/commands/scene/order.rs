//! A scene file and its render settings, as `scene render` and `scene plan` read them.

use picofarm_proto::{show, spec::RenderSettings};
use picofarm_scene::Scene;
use picofarm_settings::Resolution;
use picofarm_tasks::SceneSize;
use picofarm_transient::{Budget, Settings};

use super::gate;
use crate::{
    args::{
        ImageSize, RenderArgs,
        groups::{self, Wanted},
        strategy,
    },
    error::{CliError, Code, Result},
};

/// A scene and its render settings.
pub struct Order {
    pub scene: Scene,
    pub settings: Settings,
    /// The subsets of beams with histograms of their own.
    pub wanted: Vec<Wanted>,
    pub threads: usize,
}

impl Order {
    /// Reads the scene and checks the arguments against it.
    pub fn new(args: &RenderArgs, split: bool) -> Result<Self> {
        let size = args.resolution.and_then(ImageSize::whole);
        let mut scene = args.input.read_sized(&args.file, size)?;
        if let Some(ImageSize {
            width,
            height: None,
        }) = args.resolution
        {
            let i = &mut scene.camera.intrinsics;
            let height = f64::from(width) * f64::from(i.height) / f64::from(i.width);
            let height = height
                .round()
                .clamp(1.0, f64::from(RenderSettings::MAX_SIDE)) as u32;
            *i = i.resized(width, height);
        }
        let gate = gate::choose(args, &mut scene);
        let samples = args.samples.unwrap_or(64);
        let asked = RenderSettings {
            resolution: Resolution {
                width: scene.camera.intrinsics.width.min(RenderSettings::MAX_SIDE),
                height: scene.camera.intrinsics.height.min(RenderSettings::MAX_SIDE),
            },
            gate_start_m: gate.gate_start_m,
            bin_width_m: gate.bin_width_m,
            bins: gate.bins,
            budget: match args.error {
                Some(e) => Budget::Error(e),
                None => Budget::Samples(samples),
            },
            max_bounces: args.max_bounces.unwrap_or(0),
            strategy: strategy::together(&args.strategy)?,
            optics: args.optics.optics()?,
            ..RenderSettings::default()
        };
        // Checked as in a job, so that the ranges are defined in one place.
        asked.check().map_err(|e| {
            let option = e.field.trim_start_matches("render.");
            let option = option.replace(['_', '.'], "-");
            CliError::input(format!("--{option}: {}", e.what))
        })?;
        let wanted = groups::wanted(&args.groups, &args.group, scene.laser.beams.len())?;
        let settings = Settings {
            seed: args.seed,
            split,
            groups: wanted.iter().flat_map(|w| w.groups.clone()).collect(),
            ..picofarm_tasks::renderer_settings(&asked)
        };
        Ok(Self {
            scene,
            settings,
            wanted,
            threads: args.threads.unwrap_or_else(picofarm_tasks::cores).max(1),
        })
    }

    /// Starts the threads of the render.
    pub fn pool(&self) -> Result<rayon::ThreadPool> {
        let threads = self.threads;
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|e| {
                let what = format!("cannot start {threads} threads: {e}");
                CliError::new(Code::Resource, what)
            })
    }

    /// Returns the numbers of pixels, spots and bins that the memory depends on.
    pub fn size(&self) -> SceneSize {
        picofarm_tasks::scene_size(&self.scene)
    }

    /// Returns the maximum memory of the render, in bytes.
    pub fn memory(&self) -> u64 {
        picofarm_tasks::render_bytes(&self.settings, self.size(), self.threads)
    }

    /// Checks that this memory is available.
    pub fn fits(&self) -> Result<(), String> {
        picofarm_tasks::check_memory(&self.settings, self.size(), self.threads)
    }
}

/// Formats the renderer's decisions, one per line.
pub fn decisions(plan: &picofarm_transient::Plan) -> String {
    let strategies = plan.strategies.iter().map(|line| format!("  {line}\n"));
    let approximations = plan.approximations.iter();
    strategies
        .chain(approximations.map(|line| format!("  approximated: {line}\n")))
        .collect()
}

/// Returns a line for each choice, change or omission made while the scene was read.
pub fn notes(scene: &Scene) -> String {
    let line = |text: String| show::line(&text).to_string() + "\n";
    let notes = &scene.provenance.notes;
    let chosen = notes.iter().filter_map(|(key, note)| {
        let key = key.strip_prefix("chosen.")?;
        Some(line(format!("{key}: {note}")))
    });
    let read = notes.iter().filter_map(|(key, note)| {
        let key = key.strip_prefix("import.")?;
        Some(line(format!("note: {key}: {note}")))
    });
    chosen.chain(read).collect()
}

/// Formats the renderer's warnings, one per line.
pub fn warnings(warnings: &[String]) -> String {
    let lines = warnings.iter().map(|line| format!("warning: {line}\n"));
    lines.collect()
}
