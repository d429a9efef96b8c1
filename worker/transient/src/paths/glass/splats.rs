//! The passes of light and camera paths by glass.

use crate::{
    film::{splat::Splat, technique::Technique},
    light::{
        light_vertices::LightVertex,
        splat::splat,
        splat_source::{CHUNK, SplatPass, SplatSource, joined},
    },
    numeric::{
        low_discrepancy::place,
        rng::{Rng, Stream},
    },
    paths::glass::{
        buffers::Buffers, camera::CameraView, photons::Photons, technique::GlassTechnique,
    },
};

/// The contributions of light paths to the image, and the photons that the paths leave.
type Ends = (Vec<Splat>, Vec<LightVertex>);

impl SplatSource for GlassTechnique<'_> {
    fn splats(&self, pass: &SplatPass<'_>, out: &mut Vec<Splat>) -> u64 {
        let (photons, traced) = self.light_paths(pass, out);
        traced + self.camera_paths(pass, &photons, out)
    }

    fn describe(&self, strategies: &mut Vec<String>, approximations: &mut Vec<String>) {
        strategies.push("glass: light and camera paths by what it reflects and refracts".into());
        approximations.push(
            "what the camera sees in glass by light that comes from a spot by glass, and spots seen in bodies of glass or by several panes, are blurred over about a pixel"
                .into(),
        );
    }
}

impl GlassTechnique<'_> {
    /// Makes a pass of light paths. Returns the photons that they leave and the number of rays
    /// traced.
    fn light_paths(&self, pass: &SplatPass<'_>, out: &mut Vec<Splat>) -> (Photons, u64) {
        let tracer = &self.tracer;
        let image = (tracer.world, pass.film);
        let count = pass.light_paths(self.tuning.paths);
        let chunk = |buffers: &mut Buffers, chunk: u32, (ends, photons): &mut Ends| {
            let number = u64::from(pass.pass);
            let mut rng = Rng::new(pass.seed, Stream::Glass, u64::from(chunk), number);
            let mut seen = vec![];
            for l in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                let each = |z, turned| seen.push((z, turned));
                self.trace(tracer, (l, count), &mut rng, buffers, each);
                for (z, turned) in seen.drain(..) {
                    ends.extend(splat(image, (&z, Technique::Glass), buffers.stack()));
                    photons.extend(turned.then_some(z));
                }
            }
        };
        let (mut photons, mut rays) = (vec![], 0);
        let chunks = self.with_buffers(pass, count.div_ceil(CHUNK), chunk);
        for ((ends, of_chunk), traced) in chunks {
            out.extend(ends);
            photons.extend(of_chunk);
            rays += traced;
        }
        let photons = Photons::new(tracer.world, tracer.emitters, photons, self.tuning);
        (photons, rays)
    }

    /// Makes a pass of camera paths. Returns the number of rays traced.
    fn camera_paths(&self, pass: &SplatPass<'_>, photons: &Photons, out: &mut Vec<Splat>) -> u64 {
        let (tracer, width) = (&self.tracer, pass.width);
        out.extend_from_slice(self.seen());
        let pixels = width * pass.height;
        let chunk = |buffers: &mut Buffers, chunk: u32, found: &mut Vec<Splat>| {
            let number = u64::from(pass.pass);
            let mut rng = Rng::new(pass.seed, Stream::ByGlass, u64::from(chunk), number);
            let own = chunk * CHUNK..pixels.min((chunk + 1) * CHUNK);
            let mut own = own.filter(|p| pass.fraction.holds((p / width, p % width)));
            let Some(first) = own.next() else { return };
            self.lay(tracer, self.tuning.stream_paths, &mut rng, buffers);
            for pixel in std::iter::once(first).chain(own) {
                let place = place(pass.seed, Stream::GlassPlace, u64::from(pixel), number);
                let view = CameraView {
                    film: pass.film,
                    pixel,
                    ray: tracer
                        .world
                        .camera_ray((pixel / width, pixel % width), place),
                };
                self.look(&view, photons, &mut rng, buffers, found);
            }
        };
        joined(self.with_buffers(pass, pixels.div_ceil(CHUNK), chunk), out)
    }

    /// Runs `count` pieces of a pass. Returns the results in order, each with the number of rays
    /// traced.
    fn with_buffers<T: Default + Send>(
        &self,
        pass: &SplatPass<'_>,
        count: u32,
        piece: impl Fn(&mut Buffers, u32, &mut T) + Sync,
    ) -> Vec<(T, u64)> {
        let piece = |buffers: &mut Buffers, k, found: &mut T| {
            let before = buffers.stack().rays;
            piece(buffers, k, found);
            buffers.stack().rays - before
        };
        pass.pieces(count, || Buffers::new(&self.tracer), piece)
    }
}
