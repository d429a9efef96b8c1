//! The quantities of a scene, and the types of their values.

/// The quantities of a scene, one Zarr array each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Quantity {
    /// h(p, b): `[row][column][bin]`, u16 codes or f32.
    Transient,
    /// Σ_b h(p, b), f32 `[row][column]`, from the transient before coding.
    Intensity,
    /// z-depth in metres, f32 `[row][column]`.
    Depth,
    /// Distance along the ray in metres, f32 `[row][column]`.
    Range,
    /// Unit normals in the camera frame, i16 `[row][column][3]`, to be divided by 32767.
    Normal,
    /// Instance id, u32 `[row][column]`, 0 = nothing.
    Instance,
    /// Semantic label, u16 `[row][column]`, 0 = nothing.
    Label,
    /// 1 = mirror, u8 `[row][column]`.
    Specular,
    /// Visibility bits, u8 `[⌈spots/8⌉][row][column]`; bit s mod 8 (little order) of byte s/8, 1 =
    /// lit.
    Visibility,
    /// Measured optical path of the two-bounce light of each spot in metres, f32
    /// `[spot][row][column]`, 0 = not measured. It exists only in data sets from sources that
    /// provide it.
    TwoBouncePath,
    /// sRGB-encoded colour, u8 `[row][column][3]`.
    Rgb,
    /// f32 `[spot][7]`: position and normal in the camera frame, path from the laser in metres. NaN
    /// = no spot.
    Spots,
    /// fx, fy, cx, cy in pixels, f32.
    Intrinsics,
    /// Camera-to-world matrix, f32 `[4][4]`, points as columns.
    Camera,
    /// Laser origin in the camera frame in metres, f32 `[3]`.
    Laser,
    /// Photons per unit of h, f32; NaN if the scene is missing.
    Scale,
    /// h of the 4 of the 100 spots given by [`Self::spots_of_100`], encoded like the transient,
    /// with the same scale.
    Transient4,
    /// h of the 25 of the 100 spots given by [`Self::spots_of_100`], encoded likewise.
    Transient25,
    /// h of each single spot: `[spot][row][column][bin]`, encoded likewise.
    TransientSpots,
}

/// Rows 0, 2, 4, 6, 8 and columns 1, 3, 5, 7, 9 of the 10×10 grid.
const SPOTS_25: [u32; 25] = {
    let mut spots = [0; 25];
    let mut i = 0;
    while i < 25 {
        spots[i] = (i / 5 * 20 + i % 5 * 2 + 1) as u32;
        i += 1;
    }
    spots
};
const SPOTS_4: [u32; 4] = [22, 27, 72, 77];

/// Element type of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    F32,
    /// Unsigned bytes.
    U8,
    /// Unsigned 16-bit integers.
    U16,
    /// Signed 16-bit integers.
    I16,
    /// Unsigned 32-bit integers.
    U32,
}

impl Element {
    /// Returns its name in Zarr v3.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "float32",
            Self::U8 => "uint8",
            Self::U16 => "uint16",
            Self::I16 => "int16",
            Self::U32 => "uint32",
        }
    }

    /// Returns its size in bytes.
    pub fn size(self) -> u64 {
        match self {
            Self::U8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::F32 | Self::U32 => 4,
        }
    }
}

impl Quantity {
    /// All quantities there are, in the order of their objects in a manifest; see
    /// [`crate::DatasetSpec::quantities`].
    pub const ALL: [Self; 19] = [
        Self::Transient,
        Self::Intensity,
        Self::Depth,
        Self::Range,
        Self::Normal,
        Self::Instance,
        Self::Label,
        Self::Specular,
        Self::Visibility,
        Self::TwoBouncePath,
        Self::Rgb,
        Self::Spots,
        Self::Intrinsics,
        Self::Camera,
        Self::Laser,
        Self::Scale,
        Self::Transient4,
        Self::Transient25,
        Self::TransientSpots,
    ];

    /// Returns whether it is a transient, encoded with the data set's profile.
    pub fn is_transient(self) -> bool {
        matches!(
            self,
            Self::Transient | Self::Transient4 | Self::Transient25 | Self::TransientSpots
        )
    }

    /// Returns which of the 100 spots of a 10×10 grid (row by row) this transient includes; empty
    /// for other quantities.
    pub fn spots_of_100(self) -> &'static [u32] {
        match self {
            Self::Transient4 => &SPOTS_4,
            Self::Transient25 => &SPOTS_25,
            _ => &[],
        }
    }

    /// Returns the name of the Zarr array.
    pub fn name(self) -> &'static str {
        match self {
            Self::Transient => "transient",
            Self::Intensity => "intensity",
            Self::Depth => "depth",
            Self::Range => "range",
            Self::Normal => "normal",
            Self::Instance => "instance",
            Self::Label => "label",
            Self::Specular => "specular",
            Self::Visibility => "visibility",
            Self::TwoBouncePath => "two_bounce_path",
            Self::Rgb => "rgb",
            Self::Spots => "spots",
            Self::Intrinsics => "intrinsics",
            Self::Camera => "camera",
            Self::Laser => "laser",
            Self::Scale => "scale",
            Self::Transient4 => "transient_4",
            Self::Transient25 => "transient_25",
            Self::TransientSpots => "transient_spots",
        }
    }
}
