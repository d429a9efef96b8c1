//! A scene file and its render settings, as `scene render` and `scene plan` read them.

use picofarm_agent::SceneSize;
use picofarm_proto::{model::RenderSettings, show};
use picofarm_scene::{
    Scene,
    import::{self, ImportOptions},
};
use picofarm_transient::{Budget, Settings, Wavelength};

use crate::{
    args::{
        RenderArgs,
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
        let mut scene =
            import::read_scene_with(&args.file, &ImportOptions::default(), &args.root.bounds())?;
        let samples = args.samples.unwrap_or(64);
        let asked = RenderSettings {
            resolution: args.resolution.unwrap_or(RenderSettings::MAX_SIDE),
            gate_start_m: args.gate.gate_start_m,
            bin_width_m: args.gate.bin_width_m,
            bins: args.gate.bins,
            budget: match args.error {
                Some(e) => Budget::Error(e),
                None => Budget::Samples(samples),
            },
            max_bounces: args.max_bounces.unwrap_or(0),
            beam: args.beam.width(),
            fill_factor: args.fill_factor.unwrap_or(1.0),
            wavelengths_nm: Wavelength::of(&args.wavelengths_nm)
                .map_err(|(at, what)| CliError::input(format!("--wavelengths-nm{at}: {what}")))?,
            ..RenderSettings::default()
        };
        // Checked as in a job, so that the ranges are defined in one place.
        asked.check().map_err(|e| {
            let option = e.field.trim_start_matches("render.");
            let option = option.replace(['_', '.'], "-");
            CliError::input(format!("--{option}: {}", e.what))
        })?;
        if let Some(px) = args.resolution {
            let i = &mut scene.camera.intrinsics;
            *i = i.resized(px, px);
        }
        let wanted = groups::wanted(&args.groups, &args.group, scene.laser.beams.len())?;
        let settings = Settings {
            gate: asked.gate(),
            budget: asked.budget,
            max_bounces: args.max_bounces.filter(|most| *most != 0),
            one_bounce: true,
            seed: args.seed,
            split,
            groups: wanted.iter().flat_map(|w| w.groups.clone()).collect(),
            strategy: strategy::together(&args.strategy)?,
            beam: asked.beam,
            fill_factor: asked.fill_factor,
            wavelengths_nm: asked.wavelengths_nm,
        };
        Ok(Self {
            scene,
            settings,
            wanted,
            threads: args.threads.unwrap_or_else(picofarm_agent::cores).max(1),
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
        picofarm_agent::scene_size(&self.scene)
    }

    /// Returns the maximum memory of the render, in bytes.
    pub fn memory(&self) -> u64 {
        picofarm_agent::render_bytes(&self.settings, self.size(), self.threads)
    }

    /// Checks that this memory is available.
    pub fn fits(&self) -> Result<(), String> {
        picofarm_agent::check_memory(&self.settings, self.size(), self.threads)
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

/// Returns a line for each change or omission made while the scene was read.
pub fn notes(scene: &Scene) -> String {
    let notes = scene.provenance.notes.iter();
    let read = notes.filter_map(|(key, note)| Some((key.strip_prefix("import.")?, note)));
    read.map(|(key, note)| show::line(&format!("note: {key}: {note}")).to_string() + "\n")
        .collect()
}

/// Formats the renderer's warnings, one per line.
pub fn warnings(warnings: &[String]) -> String {
    let lines = warnings.iter().map(|line| format!("warning: {line}\n"));
    lines.collect()
}
