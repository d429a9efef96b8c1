//! A scene prepared for tracing, and the conversion of its image to a result.

use picofarm_scene::{Scene, Spot};

use crate::{
    api::{
        Budget, ErrorEstimate, GroundTruth, Overflow, Plan, RenderError, Rendered, Settings, Split,
        Stop,
    },
    light::emitters::Emitters,
    paths::one_bounce,
    render::{
        frame::Frame,
        image::Image,
        plan::plan as decide,
        rounds::{FIRST_PASSES, TWO_PASSES},
        splats::Splats,
        warn,
    },
    scene::centres::Centres,
    truth::{ground_truth, photo},
};

/// The number of rows from which the rays of the ground truth are forecast.
const ROWS: usize = 128;

/// A scene prepared for tracing.
pub(crate) struct Ready<'a> {
    pub scene: &'a Scene,
    pub settings: &'a Settings,
    pub frame: Frame<'a>,
    pub centres: &'a Centres,
    pub spots: &'a [Option<Spot>],
    /// All sources, including those that `frame` omits because none of their light reaches the
    /// gate.
    pub sources: &'a Emitters,
    pub is_dark: bool,
    /// The spots as sources. They light the image unless the beams have a width.
    pub middles: &'a Emitters,
}

impl Ready<'_> {
    /// Returns whether light of three bounces and more must be sampled.
    pub fn walks(&self) -> bool {
        let walk = &self.frame.walk;
        walk.max_bounces >= 3 && !walk.emitters.list.is_empty()
    }

    /// Returns the passes of the first round, which is the only one unless an error target is set.
    pub fn first_passes(&self) -> u32 {
        match self.settings.budget {
            _ if !self.walks() => 0,
            Budget::Samples(n) => n,
            Budget::Error(_) => FIRST_PASSES,
        }
    }

    /// Returns the passes of light paths for `passes` passes of the image. Two bounces alone need
    /// some as well.
    pub fn splat_passes(&self, passes: u32) -> u32 {
        if self.walks() { passes } else { TWO_PASSES }
    }

    /// Returns the renderer's decisions for a first round of `passes`.
    pub fn plan(&self, passes: u32) -> Plan {
        let mut plan = decide(self.scene, self.settings, &self.frame, passes);
        if self.is_dark {
            plan.approximations.push(
                "no light of two bounces and more reaches the gate: none is looked for, and the overflow has one bounce alone"
                    .into(),
            );
        }
        plan
    }

    /// Returns the ground truth and the number of rays it took.
    ///
    /// # Errors
    /// Returns [`RenderError::Stopped`] if the render is stopped.
    pub fn seen(&self, stop: Stop) -> Result<(GroundTruth, u64), RenderError> {
        let walk = &self.frame.walk;
        let (beams, of) = (self.spots.len(), (walk.world, self.middles));
        let (mut truth, rays) =
            ground_truth::ground_truth(self.scene, of, self.centres, beams, stop)?;
        let (rgb, photo_rays) = photo::photo(walk.world, self.settings.seed, stop)?;
        truth.rgb = rgb;
        Ok((truth, self.centres.rays + rays + photo_rays))
    }

    /// Returns the approximate number of rays of the ground truth, from some rows of a large image.
    pub fn seen_rays(&self) -> u64 {
        let walk = &self.frame.walk;
        let step = (self.frame.height as usize / ROWS).max(1);
        let truth = ground_truth::rays(walk.world, self.middles, self.centres, step);
        self.centres.rays + truth + photo::rays(walk.world, self.settings.seed, step)
    }

    /// Returns warnings about the scene or gate that are certain before rendering.
    pub fn foreseen(&self) -> Vec<String> {
        let walk = &self.frame.walk;
        let mut warnings = warn::beams(self.spots);
        let any = warn::arrivals(walk.world, self.middles, self.centres, |_, _| true);
        if any.is_none() && !self.middles.list.is_empty() {
            warnings.push("the camera sees no surface".into());
        }
        warnings.extend(warn::before_light(&self.settings.gate, any));
        warnings
    }

    /// Returns the reason if a finished image has no light. `inside` is its energy, and `outside`
    /// is whether light arrives outside the gate.
    pub fn dark(&self, truth: &GroundTruth, inside: f64, outside: bool) -> Option<String> {
        if inside > 0.0 {
            return None;
        }
        let walk = &self.frame.walk;
        let pixels = self.centres.hits.len();
        let seen = |beam: usize, pixel: usize| truth.visibility[beam * pixels + pixel] != 0;
        let lit = warn::arrivals(walk.world, self.middles, self.centres, seen);
        let any = warn::arrivals(walk.world, self.middles, self.centres, |_, _| true);
        let gate = &self.settings.gate;
        Some(warn::empty(gate, self.spots, (lit, any), outside))
    }

    /// Returns the result: the image with the light paths' contributions and with the one-bounce
    /// peaks.
    ///
    /// # Errors
    /// Returns [`RenderError::Stopped`] if the render is stopped.
    pub fn finish(
        &self,
        (mut image, splats): (Image, Option<Splats>),
        (truth, seen): (GroundTruth, u64),
        (error, mut rays): (ErrorEstimate, u64),
        (plan, stop): (Plan, Stop),
    ) -> Result<Rendered, RenderError> {
        let (frame, settings) = (&self.frame, self.settings);
        let (walk, film) = (&frame.walk, frame.film);
        if let Some(splats) = &splats {
            splats.join(frame, &mut image, stop)?;
        }
        let mut overflow = Overflow {
            energy: image.overflow,
            share: 0.0,
        };
        if settings.one_bounce && walk.max_bounces >= 1 {
            let mut stack = walk.world.bvh.stack();
            let peaks = one_bounce::peaks(walk.world, &mut stack, self.sources);
            for peak in &peaks {
                let gate = &settings.gate;
                if !one_bounce::add(peak, gate, &mut image.transient) {
                    overflow.energy += f64::from(peak.value);
                }
                for &channel in &film.of_spot[peak.spot] {
                    one_bounce::add(peak, gate, &mut image.groups[usize::from(channel) - 1]);
                }
            }
            rays += stack.rays;
        }
        let inside: f64 = image.transient.iter().map(|&v| f64::from(v)).sum();
        overflow.share = if overflow.energy > 0.0 {
            overflow.energy / (overflow.energy + inside)
        } else {
            0.0
        };
        let outside = self.is_dark || overflow.energy > 0.0;
        let dark = self.dark(&truth, inside, outside);
        let mut warnings = warn::beams(self.spots);
        warnings.extend(dark.clone());
        warnings.extend(warn::tails(&error));
        Ok(Rendered {
            dark,
            warnings,
            width: frame.width,
            height: frame.height,
            gate: settings.gate,
            transient: image.transient,
            split: image.split.map(|s| Split {
                two: s.two,
                two_se: s.two_se,
                two_noise: s.two_noise,
                multi: s.multi,
                multi_se: s.multi_se,
                multi_noise: s.multi_noise,
            }),
            groups: image.groups,
            truth,
            spots: self.spots.to_vec(),
            overflow,
            error,
            plan,
            rays: rays + seen,
        })
    }
}
