//! Geometry of cameras and pixels.

use picofarm_scene::{Camera, Intrinsics, Vec3};

/// Returns the distance along a pixel's ray per metre of z-depth.
pub fn slant(camera: &Camera, pixel: usize) -> f32 {
    let i = &camera.intrinsics;
    let (u, v) = (
        (pixel % i.width as usize) as f32 + 0.5,
        (pixel / i.width as usize) as f32 + 0.5,
    );
    let (x, y) = ((u - i.cx) / i.fx, (v - i.cy) / i.fy);
    (x * x + y * y + 1.0).sqrt()
}

/// A row-major camera-to-world matrix.
pub(crate) struct Frame<'a>(pub &'a [f32]);

impl Frame<'_> {
    fn axis(&self, column: usize) -> Vec3 {
        Vec3::new(self.0[column], self.0[4 + column], self.0[8 + column])
    }

    pub fn point(&self, p: [f32; 3]) -> Vec3 {
        self.axis(3) + self.axis(0) * p[0] + self.axis(1) * p[1] + self.axis(2) * p[2]
    }

    pub fn camera(&self, intrinsics: Intrinsics) -> Camera {
        Camera {
            intrinsics,
            origin: self.axis(3),
            right: self.axis(0),
            down: self.axis(1),
            forward: self.axis(2),
        }
    }
}
