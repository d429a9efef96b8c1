//! Albedo textures: 8-bit sRGB texels with bilinear interpolation in linear light.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

/// The texels outside `[0, 1)` of texture space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wrap {
    /// The image is repeated.
    #[default]
    Repeat,
    /// The image is repeated, and mirrored every second time.
    Mirror,
    /// The nearest texel of the border is used.
    Clamp,
}

/// An image that scales a material's albedo from point to point.
///
/// Texels are stored by rows from the top, sRGB-encoded as in the source file. Texture space
/// follows glTF: (0, 0) is the outer corner of the first texel, u runs along the row, v **down**.
#[derive(Clone, PartialEq, Eq)]
pub struct Texture {
    name: String,
    width: u32,
    height: u32,
    wrap: Wrap,
    texels: Vec<[u8; 3]>,
}

impl std::fmt::Debug for Texture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            name,
            width,
            height,
            wrap,
            ..
        } = self;
        write!(f, "Texture({name:?}, {width}x{height}, {wrap:?})")
    }
}

/// The linear light of every sRGB byte (IEC 61966-2-1).
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let s = i as f64 / 255.0;
        let l = if s <= 0.04045 {
            s / 12.92
        } else {
            libm::pow((s + 0.055) / 1.055, 2.4)
        };
        l as f32
    })
});

impl Texture {
    /// The greatest number of texels along one side.
    pub const MAX_SIDE: u32 = 16_384;
    /// The greatest number of texels of one texture (201 MB).
    pub const MAX_TEXELS: u64 = 1 << 26;

    /// Creates a texture of `width` × `height` sRGB texels, rows from the top.
    ///
    /// # Errors
    /// A message with the allowed values, if a side is 0 or too long, or if the number of texels is
    /// not the product of the sides.
    pub fn new(
        name: impl Into<String>,
        width: u32,
        height: u32,
        texels: Vec<[u8; 3]>,
        wrap: Wrap,
    ) -> Result<Self, String> {
        Self::check_size(width, height)?;
        let count = u64::from(width) * u64::from(height);
        if count != texels.len() as u64 {
            return Err(format!(
                "{} texels are not {width}x{height}; the image is damaged",
                texels.len()
            ));
        }
        Ok(Self {
            name: name.into(),
            width,
            height,
            wrap,
            texels,
        })
    }

    /// Refuses sizes beyond the limits, before anything is decoded.
    pub(crate) fn check_size(width: u32, height: u32) -> Result<(), String> {
        let side = 1..=Self::MAX_SIDE;
        let count = u64::from(width) * u64::from(height);
        if side.contains(&width) && side.contains(&height) && count <= Self::MAX_TEXELS {
            return Ok(());
        }
        Err(format!(
            "texture of {width}x{height} texels: sides must be 1 to {} and no more than {} in all; scale the image down",
            Self::MAX_SIDE,
            Self::MAX_TEXELS
        ))
    }

    /// Returns the name, for people; it is also the stem of the exported file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the number of texels a row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Returns the number of rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Returns the treatment of points outside the image.
    pub fn wrap(&self) -> Wrap {
        self.wrap
    }

    /// Returns the sRGB texels, by rows from the top.
    pub fn texels(&self) -> &[[u8; 3]] {
        &self.texels
    }

    /// Returns the linear RGB at a point of texture space, bilinear between the centres of texels.
    pub fn at(&self, uv: [f32; 2]) -> [f32; 3] {
        let (x0, x1, fx) = self.wrap.neighbours(uv[0], self.width);
        let (y0, y1, fy) = self.wrap.neighbours(uv[1], self.height);
        let table = &*LINEAR;
        let texel = |x: u32, y: u32| {
            let k = y as usize * self.width as usize + x as usize;
            self.texels[k].map(|c| table[usize::from(c)])
        };
        let (a, b, c, d) = (texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1));
        std::array::from_fn(|k| {
            let top = a[k] + (b[k] - a[k]) * fx;
            let bottom = c[k] + (d[k] - c[k]) * fx;
            top + (bottom - top) * fy
        })
    }

    /// Returns the mean linear RGB over all texels.
    pub fn mean(&self) -> [f32; 3] {
        let mut sum = [0.0f64; 3];
        for t in &self.texels {
            for (s, &c) in sum.iter_mut().zip(t) {
                *s += f64::from(LINEAR[usize::from(c)]);
            }
        }
        sum.map(|s| (s / self.texels.len() as f64) as f32)
    }
}

/// Returns the linear light of an sRGB byte.
pub(crate) fn linear(byte: u8) -> f32 {
    LINEAR[usize::from(byte)]
}

/// Returns the sRGB byte nearest to a linear value; values outside [0, 1] are clamped.
pub(crate) fn srgb_byte(linear: f32) -> u8 {
    let table = &*LINEAR;
    let above = table.partition_point(|&l| l < linear).min(255);
    if above > 0 && linear - table[above - 1] < table[above] - linear {
        above as u8 - 1
    } else {
        above as u8
    }
}

impl Wrap {
    /// Returns the two texels around a coordinate, and the second one's weight.
    #[inline]
    fn neighbours(self, coordinate: f32, size: u32) -> (u32, u32, f32) {
        let n = size as f32;
        // Reducing to one period first preserves the fraction's precision and bounds the casts for
        // any finite coordinate.
        let inside = match self {
            Wrap::Repeat => coordinate - coordinate.floor(),
            Wrap::Mirror => {
                let two = coordinate - 2.0 * (coordinate * 0.5).floor();
                if two > 1.0 { 2.0 - two } else { two }
            }
            Wrap::Clamp => coordinate.clamp(0.0, 1.0),
        };
        let x = inside * n - 0.5;
        let low = x.floor();
        let last = size as i64 - 1;
        let wrapped = |k: i64| match self {
            Wrap::Repeat if k < 0 => last,
            Wrap::Repeat if k > last => 0,
            _ => k.clamp(0, last),
        } as u32;
        (wrapped(low as i64), wrapped(low as i64 + 1), x - low)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(wrap: Wrap) -> Texture {
        let texels = vec![[0; 3], [255; 3], [255, 0, 0], [0, 0, 255]];
        Texture::new("t", 2, 2, texels, wrap).unwrap()
    }

    #[test]
    fn centres_of_texels_are_exact_and_between_them_it_is_bilinear() {
        let t = texture(Wrap::Repeat);
        assert_eq!(t.at([0.25, 0.25]), [0.0; 3]);
        assert_eq!(t.at([0.75, 0.25]), [1.0; 3]);
        assert_eq!(t.at([0.25, 0.75]), [1.0, 0.0, 0.0]);
        assert_eq!(t.at([0.5, 0.5]), [0.5, 0.25, 0.5]);
    }

    #[test]
    fn outside_the_image_its_wrap_mode_holds() {
        for (wrap, expected) in [
            (Wrap::Repeat, [0.0, 1.0]),
            (Wrap::Mirror, [1.0, 0.0]),
            (Wrap::Clamp, [1.0, 1.0]),
        ] {
            let t = texture(wrap);
            let found = [t.at([1.25, 0.25])[1], t.at([1.75, 0.25])[1]];
            assert_eq!(found, expected, "{wrap:?}");
        }
        assert_eq!(texture(Wrap::Repeat).at([0.0, 0.25]), [0.5; 3]);
        assert_eq!(texture(Wrap::Clamp).at([-3.0, 0.25]), [0.0; 3]);
        for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
            for x in [f32::MAX, -f32::MAX, 1.0 - 1e-8, -1e-30, 1e9] {
                assert!(
                    texture(wrap)
                        .at([x, x])
                        .iter()
                        .all(|c| (0.0..=1.0).contains(c))
                );
            }
        }
    }

    #[test]
    fn srgb_bytes_come_back_from_linear_light() {
        for i in 0..=255u8 {
            assert_eq!(srgb_byte(LINEAR[usize::from(i)]), i);
        }
        assert_eq!((srgb_byte(-1.0), srgb_byte(2.0)), (0, 255));
    }

    #[test]
    fn sizes_beyond_the_limits_are_refused() {
        for (w, h) in [(0, 1), (1, 0), (20_000, 1), (16_384, 16_384), (2, 2)] {
            assert!(Texture::new("t", w, h, vec![[0; 3]], Wrap::Repeat).is_err());
        }
    }
}
