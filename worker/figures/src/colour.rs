//! Colour maps: polynomial fits of matplotlib's inferno and viridis (CC0, van der Walt and Smith).

const INFERNO: [[f32; 3]; 7] = [
    [0.000_218_94, 0.001_651, -0.019_480_9],
    [0.106_513_42, 0.563_956_4, 3.932_712_4],
    [11.602_493, -3.972_854, -15.942_394],
    [-41.703_996, 17.436_4, 44.354_145],
    [77.162_94, -33.402_36, -81.807_31],
    [-71.319_43, 32.626_064, 73.209_52],
    [25.131_126, -12.242_669, -23.070_325],
];

const VIRIDIS: [[f32; 3]; 7] = [
    [0.277_727_33, 0.005_407_344_5, 0.334_099_8],
    [0.105_093_04, 1.404_613_5, 1.384_590_2],
    [-0.330_861_83, 0.214_847_56, 0.095_095_16],
    [-4.634_230_5, -5.799_101, -19.332_441],
    [6.228_27, 14.179_933, 56.690_55],
    [4.776_385, -13.745_145, -65.353_03],
    [-5.435_456, 4.645_852_6, 26.312_435],
];

fn polynomial(c: &[[f32; 3]; 7], t: f32) -> [u8; 3] {
    let t = t.clamp(0.0, 1.0);
    std::array::from_fn(|k| {
        let v = c.iter().rev().fold(0.0, |sum, row| sum * t + row[k]);
        (v.clamp(0.0, 1.0) * 255.0).round() as u8
    })
}

/// Returns a colour from black through purple and orange to pale yellow.
pub fn inferno(t: f32) -> [u8; 3] {
    polynomial(&INFERNO, t)
}

/// Returns a colour from violet through green to yellow.
pub fn viridis(t: f32) -> [u8; 3] {
    polynomial(&VIRIDIS, t)
}
