//! Formats numbers for people.

/// Formats with about `count` significant digits, without an exponent between 0.0001 and 999,999.
pub fn digits(value: f64, count: i32) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let power = libm::floor(libm::log10(value.abs())) as i32;
    if !(-4..6).contains(&power) {
        let scaled = value / libm::pow(10.0, f64::from(power));
        return format!("{scaled:.*}e{power}", (count - 1).max(0) as usize);
    }
    format!("{value:.*}", (count - 1 - power).clamp(0, 9) as usize)
}

/// Formats without insignificant zeros.
pub fn short(value: f64) -> String {
    let text = digits(value, 6);
    let (number, exponent) = text
        .split_once('e')
        .map_or((&*text, None), |(n, e)| (n, Some(e)));
    let number = match number.contains('.') {
        true => number.trim_end_matches('0').trim_end_matches('.'),
        false => number,
    };
    exponent.map_or_else(|| number.to_owned(), |e| format!("{number}e{e}"))
}

/// Formats with an SI prefix: 356.4 M.
pub fn prefixed(value: f64) -> String {
    let prefixes = [
        (1e15, " P"),
        (1e12, " T"),
        (1e9, " G"),
        (1e6, " M"),
        (1e3, " k"),
    ];
    for (unit, prefix) in prefixes {
        if value.abs() >= unit {
            return digits(value / unit, 3) + prefix;
        }
    }
    short((value * 100.0).round() / 100.0)
}

/// Like [`prefixed`], without insignificant zeros: 20 M.
pub fn prefixed_short(value: f64) -> String {
    let text = prefixed(value);
    match text.split_once(' ') {
        Some((number, prefix)) if number.contains('.') => {
            let number = number.trim_end_matches('0').trim_end_matches('.');
            format!("{number} {prefix}")
        }
        _ => text,
    }
}

/// Formats seconds as hours and minutes.
pub fn duration(seconds: f64) -> String {
    if !(seconds.is_finite() && seconds >= 0.0) {
        return "–".to_owned();
    }
    if seconds < 60.0 {
        return format!("{} s", digits(seconds, 3));
    }
    let minutes = (seconds / 60.0).round() as u64;
    match minutes {
        0..60 => format!("{minutes} min"),
        60..2880 => format!("{} h {:02} min", minutes / 60, minutes % 60),
        _ => format!("{} d {} h", minutes / 1440, minutes % 1440 / 60),
    }
}

/// Formats a whole number with separated thousands.
pub fn thousands(value: u64) -> String {
    let text = value.to_string();
    let mut out = String::new();
    for (i, c) in text.chars().enumerate() {
        if i > 0 && (text.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}

/// Formats metres with three significant digits.
pub fn metres(value: f64) -> String {
    digits(value, 3)
}

/// Formats a share such as IoU with four decimal places.
pub fn share(value: f64) -> String {
    if value.is_finite() {
        format!("{value:.4}")
    } else {
        "–".to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_digits_that_count() {
        let said = [
            0.0,
            0.022_84,
            0.174,
            1.5,
            12.345,
            123_456.0,
            1.5e9,
            2e-7,
            f64::NAN,
        ];
        let said = said.map(|v| digits(v, 3));
        assert_eq!(
            said,
            [
                "0", "0.0228", "0.174", "1.50", "12.3", "123456", "1.50e9", "2.00e-7", "–"
            ]
        );
        assert_eq!(
            [0.5, 20.0, 1e7, 2e-7].map(short),
            ["0.5", "20", "1e7", "2e-7"]
        );
        let said = [950.0, 1_234.0, 356_404_556.0, 1.283e12].map(prefixed);
        assert_eq!(said, ["950", "1.23 k", "356 M", "1.28 T"]);
        let said = [2.0, 130.0, 7_500.0, 300_000.0].map(duration);
        assert_eq!(said, ["2.00 s", "2 min", "2 h 05 min", "3 d 11 h"]);
        assert_eq!(
            [2e7, 1.5e3, 20.0].map(prefixed_short),
            ["20 M", "1.5 k", "20"]
        );
        assert_eq!(thousands(87_688), "87,688");
    }
}
