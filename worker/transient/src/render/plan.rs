//! The renderer's decisions for a scene, in words, for the scene's metadata.

use std::collections::BTreeSet;

use picofarm_scene::Scene;

use crate::{
    api::{Plan, Settings},
    render::frame::Frame,
};

/// Returns the plan that `render` follows.
pub(crate) fn plan(scene: &Scene, settings: &Settings, frame: &Frame, paths: u32) -> Plan {
    let (mut strategies, mut approximations) = (vec![], vec![]);
    let (tracer, sampling) = (&frame.tracer, frame.sampling);
    let longest = settings.max_bounces.unwrap_or(u32::MAX);
    if settings.one_bounce {
        strategies.push("one bounce: analytic".into());
    }
    if let Some(width) = &settings.optics.beam {
        strategies.push(format!(
            "wide beams: {} rays for each, {} mm and {} mrad",
            width.points, width.diameter_mm, width.divergence_mrad
        ));
        approximations.push(
            "spots of wide beams are as many points as rays; depth, masks and two-bounce times are those of the beams' middles"
                .into(),
        );
    }
    if let Some(nm) = settings.optics.wavelengths_nm.nm() {
        strategies.push(format!("wavelengths: {nm} nm, in one pass"));
        let (coloured, materials) = colours(scene);
        if coloured > 0 {
            approximations.push(format!(
                "{coloured} of {materials} materials state no spectrum: their colour stands for it from 400 to 700 nm, elsewhere they reflect as at the laser's own wavelength"
            ));
        }
        if tracer.world.has_glass() {
            approximations.push("glass lets every wavelength through alike".into());
        }
    }
    if settings.optics.fill_factor != 1.0 {
        strategies.push(format!(
            "pixels: {} of their area is sensitive",
            settings.optics.fill_factor
        ));
    }
    if longest >= 2 {
        let (side, fine) = sampling.sides(paths);
        let refined = sampling.refined.iter().filter(|&&r| r).count();
        strategies.push(format!(
            "two bounces: {side}x{side} strata a pixel, every spot"
        ));
        if refined > 0 {
            strategies.push(format!(
                "two bounces: {fine}x{fine} strata in {refined} pixels with narrow lobes"
            ));
        }
    }
    if let Some(contacts) = tracer.contacts {
        strategies.push(format!(
            "light paths: {} spots close beside other surfaces",
            contacts.spots()
        ));
    }
    if longest >= 3 {
        strategies.push(
            "three and more: camera paths, connected to spots and to light vertices by contribution"
                .into(),
        );
        let mirrors = tracer.mirrors;
        let planes = mirrors.list.len();
        if planes > 0 {
            strategies.push(format!("mirror images: {planes} planar mirrors"));
        }
        let curved = mirrors.curved_share > 0.01;
        if tracer.caustics.is_some() {
            strategies.push(
                "light paths: caustics from curved near-mirrors and from several in a row".into(),
            );
            approximations.push(
                "light by several near-mirrors alone, and caustics seen in a much smoother one, are unbiased but noisy"
                    .into(),
            );
        } else if curved {
            approximations.push(format!(
                "light reflected by curved near-mirrors ({:.0} % of the mirror area) is unbiased but noisy",
                100.0 * mirrors.curved_share
            ));
        }
        if planes > 1 && tracer.caustics.is_none() {
            approximations.push(
                "light that meets two near-mirrors in a row on its way from a spot is unbiased but noisy"
                    .into(),
            );
        }
    }
    if longest >= 2 {
        for source in frame.sources {
            source.describe(&mut strategies, &mut approximations);
        }
    }
    if tracer.world.has_bodies() && settings.one_bounce {
        approximations.push("one bounce: spots seen through bodies of glass are left out".into());
    }
    if tracer.window.is_some() {
        if longest >= 3 {
            strategies.push("narrow gate: ellipsoidal connections".into());
        }
        approximations.push(
            "light outside the narrow gate is not looked for: the overflow is a lower bound".into(),
        );
    }
    Plan {
        strategies,
        approximations,
    }
}

/// Returns the number of a scene's materials, by name, without a spectrum, and the number of all
/// its materials. Glass is excluded.
fn colours(scene: &Scene) -> (usize, usize) {
    let each = scene.objects.iter().flat_map(|o| &o.mesh.materials);
    let all: BTreeSet<(bool, &str)> = each
        .filter(|m| !m.is_glass())
        .map(|m| (m.spectrum.is_empty(), m.name.as_str()))
        .collect();
    (all.iter().filter(|(none, _)| *none).count(), all.len())
}
