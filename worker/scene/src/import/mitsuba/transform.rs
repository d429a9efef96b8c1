//! Mitsuba's 4×4 transforms, in f64 until an object is placed.

use crate::{Affine, Vec3};

/// A 4×4 matrix by rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::import) struct Matrix(pub(in crate::import) [[f64; 4]; 4]);

impl Matrix {
    pub(in crate::import) const IDENTITY: Matrix = Matrix([
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]);

    /// Returns the map that applies `inner`, and then `self`.
    pub(in crate::import) fn after(&self, inner: &Matrix) -> Matrix {
        if *inner == Self::IDENTITY {
            return *self;
        }
        Matrix(std::array::from_fn(|r| {
            std::array::from_fn(|c| (0..4).map(|k| self.0[r][k] * inner.0[k][c]).sum())
        }))
    }

    pub(in crate::import) fn translation([x, y, z]: [f64; 3]) -> Matrix {
        let mut m = Self::IDENTITY;
        (m.0[0][3], m.0[1][3], m.0[2][3]) = (x, y, z);
        m
    }

    pub(in crate::import) fn scale([x, y, z]: [f64; 3]) -> Matrix {
        let mut m = Self::IDENTITY;
        (m.0[0][0], m.0[1][1], m.0[2][2]) = (x, y, z);
        m
    }

    /// Returns a rotation by `degrees` about an axis (Rodrigues). As in Mitsuba, the axis is not
    /// normalised: if its length is not 1, the map shears.
    pub(in crate::import) fn rotation([x, y, z]: [f64; 3], degrees: f64) -> Result<Matrix, String> {
        if [x, y, z] == [0.0; 3] {
            return Err("rotate: the axis has no direction; set x, y or z".into());
        }
        let (s, c) = libm::sincos(degrees.to_radians());
        let t = 1.0 - c;
        Ok(Matrix([
            [t * x * x + c, t * x * y - s * z, t * x * z + s * y, 0.0],
            [t * x * y + s * z, t * y * y + c, t * y * z - s * x, 0.0],
            [t * x * z - s * y, t * y * z + s * x, t * z * z + c, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]))
    }

    /// Returns the pose with +z along target − origin, and +y towards `up`.
    pub(in crate::import) fn look_at(
        origin: [f64; 3],
        target: [f64; 3],
        up: [f64; 3],
    ) -> Result<Matrix, String> {
        let towards = std::array::from_fn(|k| target[k] - origin[k]);
        let forward = unit(towards).ok_or("lookat: origin and target are the same point")?;
        let left = unit(cross(up, forward)).ok_or("lookat: up points along the view")?;
        let up = cross(forward, left);
        let mut m = Self::IDENTITY;
        for k in 0..3 {
            m.0[k] = [left[k], up[k], forward[k], origin[k]];
        }
        Ok(m)
    }

    /// Parses 16 numbers by rows, or the 9 of the linear part.
    pub(in crate::import) fn from_numbers(n: &[f64]) -> Result<Matrix, String> {
        let mut m = Self::IDENTITY;
        match n.len() {
            16 => {
                for (k, x) in n.iter().enumerate() {
                    m.0[k / 4][k % 4] = *x;
                }
            }
            9 => {
                for (k, x) in n.iter().enumerate() {
                    m.0[k / 3][k % 3] = *x;
                }
            }
            other => return Err(format!("matrix: expected 16 or 9 numbers, found {other}")),
        }
        if m.0[3] != [0.0, 0.0, 0.0, 1.0] {
            return Err("matrix: the last row must be 0 0 0 1".into());
        }
        Ok(m)
    }

    /// Returns the position of the origin.
    pub(in crate::import) fn origin(&self) -> [f64; 3] {
        [0, 1, 2].map(|r| self.0[r][3])
    }

    pub(in crate::import) fn affine(&self) -> Affine {
        let row = |r: usize| {
            let [x, y, z, _] = self.0[r].map(|x| x as f32);
            Vec3::new(x, y, z)
        };
        Affine {
            linear: [row(0), row(1), row(2)],
            translation: Vec3::from(self.origin().map(|x| x as f32)),
        }
    }

    /// Returns column `k` of the linear part, of unit length.
    pub(in crate::import) fn axis(&self, k: usize) -> Option<Vec3> {
        unit([self.0[0][k], self.0[1][k], self.0[2][k]]).map(|v| Vec3::from(v.map(|x| x as f32)))
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length > 0.0 && length.is_finite()).then(|| v.map(|x| x / length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_are_mitsubas_also_about_axes_of_other_lengths() {
        // Mitsuba 3.9.1: <rotate x="1" y="0.3" angle="-20"/>
        let expected = [
            [1.0, 0.0180922, -0.102606],
            [0.0180922, 0.94512, 0.34202],
            [0.102606, -0.34202, 0.939693],
        ];
        let found = Matrix::rotation([1.0, 0.3, 0.0], -20.0).unwrap();
        for (r, row) in expected.iter().enumerate() {
            for (c, x) in row.iter().enumerate() {
                assert!((found.0[r][c] - x).abs() < 2e-6, "{found:?}");
            }
        }
        assert!(Matrix::rotation([0.0; 3], 1.0).is_err());
    }
}
