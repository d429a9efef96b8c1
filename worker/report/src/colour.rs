//! Colours of values.

/// Red, green, blue.
pub(super) type Rgb = [u8; 3];

/// The colour of pixels without a finite value.
pub(super) const UNKNOWN: Rgb = [255, 0, 255];

/// Viridis at nine places, from dark to light.
pub(super) const VIRIDIS: [Rgb; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];

/// Inferno at seven places, for errors.
pub(super) const INFERNO: [Rgb; 7] = [
    [0, 0, 4],
    [51, 10, 95],
    [120, 28, 109],
    [187, 55, 84],
    [237, 105, 37],
    [252, 181, 25],
    [252, 255, 164],
];

/// Grey.
pub(super) const GREY: [Rgb; 2] = [[0, 0, 0], [255, 255, 255]];

/// The colours of two masks' overlap: neither, both, only predicted, only true.
pub(super) const OVERLAP: [Rgb; 4] = [[38, 38, 42], [228, 228, 228], [230, 97, 1], [65, 105, 225]];

/// Returns the colour of a value between 0 and 1.
pub(super) fn colour(map: &[Rgb], value: f64) -> Rgb {
    if !value.is_finite() {
        return UNKNOWN;
    }
    let at = value.clamp(0.0, 1.0) * (map.len() - 1) as f64;
    let below = (at as usize).min(map.len().saturating_sub(2));
    let share = at - below as f64;
    let (a, b) = (map[below], map[(below + 1).min(map.len() - 1)]);
    std::array::from_fn(|k| {
        let (a, b) = (f64::from(a[k]), f64::from(b[k]));
        (a + (b - a) * share).round() as u8
    })
}

/// Returns a colour in CSS notation.
pub(super) fn css([r, g, b]: Rgb) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Returns a colour map from its low end to its high end, as a CSS gradient to the right.
pub(super) fn gradient(map: &[Rgb]) -> String {
    let stops: Vec<String> = map.iter().map(|c| css(*c)).collect();
    format!("linear-gradient(to right,{})", stops.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_begins_and_ends_with_its_colours_and_says_where_there_is_no_number() {
        for (value, is) in [
            (0.0, VIRIDIS[0]),
            (1.0, VIRIDIS[8]),
            (7.0, VIRIDIS[8]),
            (-1.0, VIRIDIS[0]),
            (0.5, VIRIDIS[4]),
        ] {
            assert_eq!(colour(&VIRIDIS, value), is);
        }
        assert_eq!(colour(&GREY, 0.5), [128, 128, 128]);
        assert_eq!(colour(&GREY, f64::NAN), UNKNOWN);
    }
}
