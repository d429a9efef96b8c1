//! Checks the settings of a render.

use crate::{
    api::{Budget, RenderError, Settings},
    render::rounds::MAX_PASSES,
};

pub(crate) fn check(settings: &Settings) -> Result<(), RenderError> {
    let bad = |field: &str, what: String| {
        Err(RenderError::Invalid {
            field: field.into(),
            what,
        })
    };
    let g = &settings.gate;
    if !(g.bin_width_m.is_finite() && g.bin_width_m > 0.0) {
        return bad(
            "gate.bin_width_m",
            format!("is {}, expected a positive length in metres", g.bin_width_m),
        );
    }
    if !(g.start_m.is_finite() && g.start_m >= 0.0) {
        return bad(
            "gate.start_m",
            format!("is {}, expected a path length of 0 m or more", g.start_m),
        );
    }
    if let Err((field, what)) = settings.optics.check() {
        return bad(&field, what);
    }
    if g.bins == 0 || g.bins > 1 << 20 {
        return bad("gate.bins", format!("is {}, expected 1 to 1048576", g.bins));
    }
    if settings
        .strategy
        .path_reuse
        .is_some_and(|s| !(1..=32).contains(&s))
    {
        return bad(
            "strategy.path_reuse",
            "expected a tile of 1 to 32 pixels a side".into(),
        );
    }
    if settings.groups.len() > 1024 {
        return bad(
            "groups",
            format!("has {}, expected at most 1024", settings.groups.len()),
        );
    }
    match settings.budget {
        Budget::Samples(n) if n > MAX_PASSES * 16 => bad(
            "budget.samples",
            format!(
                "is {n}, expected at most {} paths per pixel",
                MAX_PASSES * 16
            ),
        ),
        Budget::Error(e) if !(e > 0.0 && e.is_finite()) => bad(
            "budget.error",
            format!("is {e}, expected a positive share such as 0.1"),
        ),
        _ => match settings.max_bounces {
            Some(0) => bad("max_bounces", "is 0, expected 1 or more".into()),
            _ => Ok(()),
        },
    }
}
