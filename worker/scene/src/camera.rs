//! Pinhole cameras in the convention of the measurement contract.

use serde::{Deserialize, Serialize};

use crate::Vec3;

/// Pinhole intrinsics in pixels; the centre of pixel (u, v) is at (u+0.5, v+0.5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// The focal length along columns, pixels.
    pub fx: f32,
    /// The focal length along rows, pixels.
    pub fy: f32,
    /// The principal point, columns.
    pub cx: f32,
    /// The principal point, rows.
    pub cy: f32,
    /// The image width in pixels.
    pub width: u32,
    /// The image height in pixels.
    pub height: u32,
}

impl Intrinsics {
    /// Returns intrinsics with square pixels, a centred principal point and a horizontal field of
    /// view in degrees. 90° at 256×256 gives fx = fy = cx = cy = 128.
    ///
    /// # Examples
    /// ```
    /// use picofarm_scene::Intrinsics;
    ///
    /// let wide = Intrinsics::from_fov(90.0, 8, 8);
    /// assert!((wide.fx - 4.0).abs() < 1e-5);
    /// assert_eq!(wide.cx, 4.0);
    /// ```
    pub fn from_fov(fov_x_deg: f32, width: u32, height: u32) -> Self {
        let fx = if fov_x_deg == 90.0 {
            width as f32 * 0.5
        } else {
            (f64::from(width) * 0.5 / libm::tan(f64::from(fov_x_deg).to_radians() * 0.5)) as f32
        };
        Self {
            fx,
            fy: fx,
            cx: width as f32 * 0.5,
            cy: height as f32 * 0.5,
            width,
            height,
        }
    }

    /// Returns an image of another size and shape with the same width of the view and square
    /// pixels.
    pub fn reshaped(&self, width: u32, height: u32) -> Self {
        let scale = width as f32 / self.width as f32;
        let (cx, cy) = (self.cx / self.width as f32, self.cy / self.height as f32);
        Self {
            fx: self.fx * scale,
            fy: self.fx * scale,
            cx: cx * width as f32,
            cy: cy * height as f32,
            width,
            height,
        }
    }

    /// Returns the same field of view at another resolution.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (
            width as f32 / self.width as f32,
            height as f32 / self.height as f32,
        );
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            width,
            height,
        }
    }
}

/// A pinhole camera: intrinsics and pose. The axes are orthonormal world-space directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// The intrinsics.
    pub intrinsics: Intrinsics,
    /// The pinhole centre x_c in world space, metres.
    pub origin: Vec3,
    /// The image's +x axis (to the right) in world space.
    pub right: Vec3,
    /// The image's +y axis (downwards) in world space.
    pub down: Vec3,
    /// The viewing direction, camera +z, in world space.
    pub forward: Vec3,
}

impl Camera {
    /// Returns a camera at `origin` looking at `target`, with world +y up in the image.
    ///
    /// # Examples
    /// ```
    /// use picofarm_scene::{Camera, Intrinsics, Vec3};
    ///
    /// let target = Vec3::new(0.0, 0.0, 3.0);
    /// let camera = Camera::look_at(Vec3::ZERO, target, Intrinsics::from_fov(60.0, 8, 8));
    /// assert_eq!(camera.to_camera(target), target);
    /// ```
    pub fn look_at(origin: Vec3, target: Vec3, intrinsics: Intrinsics) -> Self {
        let forward = (target - origin).normalized();
        let right = forward.cross(Vec3::new(0.0, 1.0, 0.0)).normalized();
        let down = forward.cross(right);
        Self {
            intrinsics,
            origin,
            right,
            down,
            forward,
        }
    }

    /// Returns the unnormalised ray direction through film position (x, y) in pixels. Its
    /// z-component is 1 in the camera frame, so a hit at parameter t has z-depth t.
    #[inline]
    pub fn ray(&self, x: f32, y: f32) -> Vec3 {
        let i = &self.intrinsics;
        self.right * ((x - i.cx) / i.fx) + self.down * ((y - i.cy) / i.fy) + self.forward
    }

    /// Converts a world point to the camera frame (x right, y down, z forward).
    pub fn to_camera(&self, p: Vec3) -> Vec3 {
        self.direction_to_camera(p - self.origin)
    }

    /// Converts a world direction to the camera frame.
    pub fn direction_to_camera(&self, d: Vec3) -> Vec3 {
        Vec3::new(self.right.dot(d), self.down.dot(d), self.forward.dot(d))
    }

    /// Checks that the camera is finite, orthonormal and of a positive size. The error is (field,
    /// fault).
    pub(crate) fn check(&self) -> Result<(), (String, String)> {
        let i = &self.intrinsics;
        if i.width == 0 || i.height == 0 {
            return Err(("camera.intrinsics".into(), "the image has no pixels".into()));
        }
        let focal = [i.fx, i.fy].iter().all(|f| f.is_finite() && *f > 0.0);
        if !focal || !i.cx.is_finite() || !i.cy.is_finite() {
            return Err((
                "camera.intrinsics".into(),
                "focal lengths must be positive and finite".into(),
            ));
        }
        // A plane of pixels always spans less than half a turn; close to that, the outermost pixels
        // take nearly all of the view.
        for (side, pixels, focal) in [("wide", i.width, i.fx), ("high", i.height, i.fy)] {
            let half = libm::atan2(f64::from(pixels) * 0.5, f64::from(focal));
            let degrees = 2.0 * half.to_degrees();
            if degrees > 179.0 {
                let what = format!("the view is {degrees:.1} degrees {side}; expected at most 179");
                return Err(("camera.intrinsics".into(), what));
            }
        }
        let (r, d, f) = (self.right, self.down, self.forward);
        let ortho = [r.dot(d), r.dot(f), d.dot(f)]
            .iter()
            .all(|x| x.abs() < 1e-4);
        let unit = [r, d, f].iter().all(|v| (v.length() - 1.0).abs() < 1e-4);
        if !(self.origin.is_finite() && ortho && unit) {
            return Err((
                "camera pose".into(),
                "right, down and forward must be orthonormal and finite".into(),
            ));
        }
        Ok(())
    }
}

/// Checks the limits of a generated view. The error is (field, expected values).
pub(crate) fn check_view(
    width: u32,
    height: u32,
    fov_deg: f32,
) -> Result<(), (&'static str, String)> {
    if !(1..=4096).contains(&width) || !(1..=4096).contains(&height) {
        return Err((
            "width and height",
            format!("{width}x{height}: choose 1 to 4096 pixels each"),
        ));
    }
    if !(20.0..=120.0).contains(&fov_deg) {
        return Err(("fov_deg", format!("{fov_deg}: choose 20 to 120 degrees")));
    }
    Ok(())
}
