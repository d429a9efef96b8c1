//! Point sources in columns, for loops over all of them.

use picofarm_scene::Vec3;

use crate::numeric::lanes::{Column, SIDE, Wide, put, widest};

/// Point sources in columns, for loops over all of them.
#[derive(Debug, Default, Clone)]
pub(crate) struct Columns {
    pub px: Column,
    pub py: Column,
    pub pz: Column,
    pub nx: Column,
    pub ny: Column,
    pub nz: Column,
    /// Lambertian strength ρ/π; 0 if the source is not Lambertian.
    pub strength: Column,
}

impl Columns {
    pub fn clear(&mut self) {
        for column in [
            &mut self.px,
            &mut self.py,
            &mut self.pz,
            &mut self.nx,
            &mut self.ny,
            &mut self.nz,
            &mut self.strength,
        ] {
            column.clear();
        }
    }

    pub fn push(&mut self, p: Vec3, n: Vec3, strength: f32) {
        self.px.push(p.x);
        self.py.push(p.y);
        self.pz.push(p.z);
        self.nx.push(n.x);
        self.ny.push(n.y);
        self.nz.push(n.z);
        self.strength.push(strength);
    }

    /// Writes strength · cos_s · cos_x / d² for a receiver at `x` with normal `n`: irradiance per
    /// unit power of each Lambertian source, unshadowed.
    #[inline]
    pub fn irradiance(&self, x: Vec3, n: Vec3, out: &mut [f32]) {
        self.irradiance_from(0, x, n, out);
    }

    /// Like [`Columns::irradiance`], for `out.len()` sources from the `first` on.
    #[inline]
    pub fn irradiance_from(&self, first: usize, x: Vec3, n: Vec3, out: &mut [f32]) {
        widest(Irradiance {
            columns: self,
            first,
            x,
            n,
            out,
        });
    }
}

/// The loop of [`Columns::irradiance_from`].
pub(crate) struct Irradiance<'a> {
    pub columns: &'a Columns,
    pub first: usize,
    pub x: Vec3,
    pub n: Vec3,
    pub out: &'a mut [f32],
}

impl<'a> Wide for Irradiance<'a> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self {
            columns: c,
            first,
            x,
            n,
            out,
        } = self;
        let count = out.len();
        let of = |column: &'a Column| &column.groups(first, count)[..count.div_ceil(SIDE)];
        let (px, py, pz) = (of(&c.px), of(&c.py), of(&c.pz));
        let (nx, ny, nz) = (of(&c.nx), of(&c.ny), of(&c.nz));
        let strength = of(&c.strength);
        for group in 0..count.div_ceil(SIDE) {
            let (px, py, pz) = (&px[group], &py[group], &pz[group]);
            let (nx, ny, nz) = (&nx[group], &ny[group], &nz[group]);
            let strength = &strength[group];
            let mut found = [0.0; SIDE];
            for i in 0..SIDE {
                let (dx, dy, dz) = (px[i] - x.x, py[i] - x.y, pz[i] - x.z);
                let d2 = dx * dx + dy * dy + dz * dz;
                let cx = n.x * dx + n.y * dy + n.z * dz;
                let cs = -(nx[i] * dx + ny[i] * dy + nz[i] * dz);
                let lit = (cx > 0.0) & (cs > 0.0);
                let value = strength[i] * cx * cs / (d2 * d2);
                found[i] = if lit { value } else { 0.0 };
            }
            put(out, group, &found);
        }
    }
}
