//! A room with histograms known in closed form: a floor, a back wall, and a block that casts
//! shadows. Two-bounce light arrives at its time of flight; light of more bounces is a tail.

use crate::common::Lcg;

pub struct Room {
    pub width: usize,
    pub height: usize,
    pub bins: usize,
    pub gate: [f64; 2],
    /// z-depth, metres.
    pub depth: Vec<f32>,
    /// `[spot][3]`, x right, y down, z forward.
    pub lights: Vec<[f32; 3]>,
    /// `[spot][row][column]`.
    pub lit: Vec<u8>,
    pub specular: Vec<u8>,
}

impl Room {
    /// Returns a room with `spots` of a 10×10 grid on the back wall, seen with a field of view of
    /// 90°.
    pub fn new(side: usize, bins: usize) -> Self {
        let (width, height) = (side, side);
        let half = side as f64 / 2.0;
        let ray = |pixel: usize| {
            let (row, column) = (pixel / width, pixel % width);
            [
                (column as f64 + 0.5 - half) / half,
                (row as f64 + 0.5 - half) / half,
            ]
        };
        // Back wall at z = 3, floor at y = 1, a tilted panel in front on the left.
        let depth_of = |[x, y]: [f64; 2]| {
            let mut z = 3.0f64;
            if y > 0.0 {
                z = z.min(1.0 / y);
            }
            if (-0.7..-0.2).contains(&x) && (-0.1..0.4).contains(&y) {
                z = z.min(1.6 + 0.3 * x);
            }
            z
        };
        let depth: Vec<f32> = (0..width * height)
            .map(|p| depth_of(ray(p)) as f32)
            .collect();
        let mut lights = Vec::new();
        for i in 0..100 {
            let (row, column) = (i / 10, i % 10);
            let d = [
                0.85 * (column as f64 - 4.3) / 5.0,
                0.7 * (row as f64 - 5.6) / 5.0,
            ];
            let z = depth_of(d);
            lights.push([(d[0] * z) as f32, (d[1] * z) as f32, z as f32]);
        }
        let mut lit = Vec::new();
        for (index, light) in lights.iter().enumerate() {
            // Made-up shadows: half a plane through the image for each spot.
            let angle = index as f32 * 0.7;
            for p in 0..width * height {
                let [x, y] = ray(p).map(|v| v as f32);
                lit.push(u8::from(
                    x * angle.cos() + y * angle.sin() < 0.35 + 0.1 * light[0],
                ));
            }
        }
        let specular = (0..width * height)
            .map(|p| u8::from(p % width > width - width / 8))
            .collect();
        Self {
            width,
            height,
            bins,
            gate: [1.0, 0.0384 * 637.0 / bins as f64],
            depth,
            lights,
            lit,
            specular,
        }
    }

    pub fn point(&self, pixel: usize) -> [f64; 3] {
        let half = self.width as f64 / 2.0;
        let z = f64::from(self.depth[pixel]);
        let (row, column) = (pixel / self.width, pixel % self.width);
        [
            (column as f64 + 0.5 - half) / half * z,
            (row as f64 + 0.5 - half) / half * z,
            z,
        ]
    }

    /// Returns the path length of two-bounce light.
    pub fn path(&self, spot: usize, pixel: usize) -> f64 {
        let norm = |a: [f64; 3]| a.iter().map(|x| x * x).sum::<f64>().sqrt();
        let (l, x) = (self.lights[spot].map(f64::from), self.point(pixel));
        norm(l) + norm([x[0] - l[0], x[1] - l[1], x[2] - l[2]]) + norm(x)
    }

    /// Returns h of some of the spots: `[row][column][bin]`.
    pub fn transient(&self, spots: &[u32]) -> Vec<f32> {
        let pixels = self.width * self.height;
        let mut h = vec![0.0f32; pixels * self.bins];
        let mut random = Lcg(5);
        for (pixel, h) in h.chunks_exact_mut(self.bins).enumerate() {
            let albedo = 0.2 + 0.6 * random.next();
            for spot in spots.iter().map(|s| *s as usize) {
                let bin = ((self.path(spot, pixel) - self.gate[0]) / self.gate[1]).floor() as usize;
                if self.specular[pixel] == 1 || bin >= self.bins {
                    continue;
                }
                if self.lit[spot * pixels + pixel] == 1 {
                    h[bin] += albedo * 0.01;
                }
                let reach = (self.bins - bin).min(self.bins / 12);
                for x in &mut h[bin..bin + reach] {
                    *x += albedo * 0.004 / reach as f32 * random.next();
                }
            }
        }
        h
    }
}
