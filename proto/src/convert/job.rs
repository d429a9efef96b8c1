//! Jobs on the wire.

use std::collections::BTreeMap;

use super::{ConvertError, required};
use crate::{
    model::{
        Budget, Choice, JobSpec, Limits, OutputSettings, RenderSettings, SceneFile, SceneKind,
        SceneSource, SpecError,
    },
    wire,
};

impl TryFrom<wire::JobSpec> for JobSpec {
    type Error = ConvertError;

    fn try_from(w: wire::JobSpec) -> Result<Self, ConvertError> {
        let limits = required(w.limits, "limits")?;
        let output = required(w.output, "output")?;
        let spec = JobSpec {
            name: w.name,
            scenes: required(w.scenes, "scenes")?.try_into()?,
            render: required(w.render, "render")?.try_into()?,
            output: OutputSettings {
                store: output.store,
                dataset: output.dataset,
                profile: output.profile,
            },
            limits: Limits {
                max_failures: limits.max_failures,
                max_crashes: limits.max_crashes,
            },
        };
        spec.check()?;
        Ok(spec)
    }
}

impl TryFrom<wire::SceneSource> for SceneSource {
    type Error = ConvertError;

    fn try_from(w: wire::SceneSource) -> Result<Self, ConvertError> {
        use wire::scene_source::Kind;
        let kind = match required(w.kind, "scenes.kind")? {
            Kind::Furnished(f) => SceneKind::Furnished {
                assets: f.assets,
                min_specular: f.min_specular,
            },
            Kind::Primitive(_) => SceneKind::Primitive,
            Kind::Files(f) => SceneKind::Files {
                files: f
                    .files
                    .into_iter()
                    .map(|f| SceneFile {
                        path: f.path,
                        sha256: f.sha256,
                    })
                    .collect(),
            },
        };
        Ok(SceneSource {
            kind,
            count: w.count,
            seed: w.seed,
            fov_deg: w.fov_deg,
            spots: w.spots,
        })
    }
}

impl TryFrom<wire::RenderSettings> for RenderSettings {
    type Error = ConvertError;

    fn try_from(w: wire::RenderSettings) -> Result<Self, ConvertError> {
        use wire::render_settings::Budget as B;
        Ok(RenderSettings {
            resolution: w.resolution,
            gate_start_m: w.gate_start_m,
            bin_width_m: w.bin_width_m,
            bins: w.bins,
            budget: match required(w.budget, "render.budget")? {
                B::Samples(n) => Budget::Samples(n),
                B::Error(e) => Budget::Error(e),
            },
            max_bounces: w.max_bounces,
            renderer: w.renderer,
            subsets: w.subsets,
            per_spot: w.per_spot,
            strategy: strategy(w.strategy)?,
        })
    }
}

fn strategy(w: Vec<wire::StrategyChoice>) -> Result<BTreeMap<String, Choice>, ConvertError> {
    use wire::strategy_choice::Choice as C;
    let mut all = BTreeMap::new();
    for w in w {
        let choice = match required(w.choice, "render.strategy.choice")? {
            C::On(on) => Choice::On(on),
            C::Size(size) => Choice::Size(size),
        };
        if let Some((name, _)) = all.get_key_value(&w.name) {
            let what = format!("{name:?} is chosen twice");
            return Err(SpecError::new("render.strategy", what).into());
        }
        all.insert(w.name, choice);
    }
    Ok(all)
}

impl From<JobSpec> for wire::JobSpec {
    fn from(m: JobSpec) -> Self {
        wire::JobSpec {
            name: m.name,
            scenes: Some(m.scenes.into()),
            render: Some(m.render.into()),
            output: Some(wire::OutputSettings {
                store: m.output.store,
                dataset: m.output.dataset,
                profile: m.output.profile,
            }),
            limits: Some(wire::Limits {
                max_failures: m.limits.max_failures,
                max_crashes: m.limits.max_crashes,
            }),
        }
    }
}

impl From<SceneSource> for wire::SceneSource {
    fn from(m: SceneSource) -> Self {
        use wire::scene_source::Kind;
        let kind = match m.kind {
            SceneKind::Furnished {
                assets,
                min_specular,
            } => Kind::Furnished(wire::FurnishedScenes {
                assets,
                min_specular,
            }),
            SceneKind::Primitive => Kind::Primitive(wire::PrimitiveScenes {}),
            SceneKind::Files { files } => Kind::Files(wire::FileScenes {
                files: files
                    .into_iter()
                    .map(|f| wire::SceneFile {
                        path: f.path,
                        sha256: f.sha256,
                    })
                    .collect(),
            }),
        };
        wire::SceneSource {
            kind: Some(kind),
            count: m.count,
            seed: m.seed,
            fov_deg: m.fov_deg,
            spots: m.spots,
        }
    }
}

impl From<RenderSettings> for wire::RenderSettings {
    fn from(m: RenderSettings) -> Self {
        use wire::render_settings::Budget as B;
        use wire::strategy_choice::Choice as C;
        wire::RenderSettings {
            resolution: m.resolution,
            gate_start_m: m.gate_start_m,
            bin_width_m: m.bin_width_m,
            bins: m.bins,
            budget: Some(match m.budget {
                Budget::Samples(n) => B::Samples(n),
                Budget::Error(e) => B::Error(e),
            }),
            max_bounces: m.max_bounces,
            renderer: m.renderer,
            subsets: m.subsets,
            per_spot: m.per_spot,
            strategy: m
                .strategy
                .into_iter()
                .map(|(name, choice)| wire::StrategyChoice {
                    name,
                    choice: Some(match choice {
                        Choice::On(on) => C::On(on),
                        Choice::Size(size) => C::Size(size),
                    }),
                })
                .collect(),
        }
    }
}
