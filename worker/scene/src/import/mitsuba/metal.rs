//! Mitsuba's names of conductors.

/// The normal-incidence reflectance (linear RGB) of conductors. Ag, Al, Au, Cr and Cu are the
/// usual display colours; the others are Fresnel's formula at 611, 549 and 464 nm with the optical
/// constants of Palik's handbook.
const METALS: [(&str, [f32; 3]); 36] = [
    ("a-C", [0.212, 0.212, 0.203]),
    ("Ag", [0.972, 0.960, 0.915]),
    ("Al", [0.913, 0.922, 0.924]),
    ("AlAs", [0.269, 0.281, 0.313]),
    ("AlSb", [0.361, 0.385, 0.456]),
    ("Au", [1.000, 0.766, 0.336]),
    ("Be", [0.539, 0.538, 0.537]),
    ("Cr", [0.550, 0.556, 0.554]),
    ("CsI", [0.079, 0.081, 0.084]),
    ("Cu", [0.955, 0.638, 0.538]),
    ("Cu2O", [0.250, 0.264, 0.272]),
    ("CuO", [0.220, 0.216, 0.216]),
    ("d-C", [0.172, 0.173, 0.176]),
    ("Hg", [0.781, 0.779, 0.779]),
    ("HgTe", [0.400, 0.383, 0.389]),
    ("Ir", [0.698, 0.693, 0.667]),
    ("K", [0.946, 0.938, 0.926]),
    ("Li", [0.907, 0.891, 0.831]),
    ("MgO", [0.072, 0.073, 0.074]),
    ("Mo", [0.569, 0.572, 0.576]),
    ("Na", [0.972, 0.962, 0.942]),
    ("Nb", [0.505, 0.505, 0.510]),
    ("Ni", [0.644, 0.611, 0.546]),
    ("Rh", [0.786, 0.768, 0.743]),
    ("Se", [0.306, 0.275, 0.269]),
    ("SiC", [0.203, 0.206, 0.212]),
    ("Ta", [0.376, 0.360, 0.402]),
    ("Te", [0.579, 0.590, 0.587]),
    ("ThF4", [0.043, 0.043, 0.043]),
    ("TiC", [0.479, 0.461, 0.447]),
    ("TiN", [0.569, 0.471, 0.278]),
    ("TiO2", [0.236, 0.245, 0.265]),
    ("V", [0.516, 0.526, 0.558]),
    ("VC", [0.459, 0.439, 0.418]),
    ("VN", [0.452, 0.414, 0.359]),
    ("W", [0.510, 0.494, 0.475]),
];

/// Returns the reflectance of a conductor, or `None` if the name is unknown. Mitsuba's suffix
/// `_palik`, which names the source of the constants, may be left out.
pub(super) fn reflectance(name: &str) -> Option<[f32; 3]> {
    let name = name.strip_suffix("_palik").unwrap_or(name);
    METALS.iter().find(|m| m.0 == name).map(|m| m.1)
}

/// Returns all names.
pub(super) fn names() -> Vec<&'static str> {
    METALS.iter().map(|m| m.0).collect()
}

/// Returns the reflectance at normal incidence of a complex index of refraction `n` + i `k`.
pub(super) fn fresnel(n: f32, k: f32) -> f32 {
    ((n - 1.0) * (n - 1.0) + k * k) / ((n + 1.0) * (n + 1.0) + k * k)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metals_are_known_by_both_of_mitsubas_names() {
        assert_eq!(reflectance("W"), reflectance("W_palik"));
        assert_eq!(reflectance("Unobtainium"), None);
    }

    #[test]
    fn reflectances_are_shares() {
        for (name, rgb) in METALS {
            assert!(rgb.iter().all(|r| (0.0..=1.0).contains(r)), "{name}");
        }
        // Gold at 549 nm: n = 0.35, k = 2.7.
        assert!((fresnel(0.35, 2.7) - 0.85).abs() < 0.01);
    }
}
