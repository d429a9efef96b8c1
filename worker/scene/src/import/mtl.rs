//! Material files of OBJ, made safe for tobj.

use super::quoted;

/// Returns the lines of a material file with three numbers for each colour, because tobj panics
/// otherwise. In MTL, a single number is a grey. The error is the fault with its line.
pub(crate) fn complete_colours(text: &str) -> Result<String, String> {
    let mut complete = String::with_capacity(text.len());
    for (k, line) in text.lines().enumerate() {
        let line = line.trim();
        let mut words = line.split_whitespace();
        if let Some(key @ ("Ka" | "Kd" | "Ks" | "Ke")) = words.next() {
            let values: Vec<&str> = words.take_while(|w| !w.starts_with('#')).collect();
            let rgb = match values[..] {
                [grey] => [grey; 3],
                [r, g, b, ..] => [r, g, b],
                _ => ["", "", ""],
            };
            if rgb.iter().any(|v| v.parse::<f32>().is_err()) {
                let found = quoted(&values.join(" "));
                return Err(format!(
                    "line {}: {key}: expected a colour of one or three numbers, found {found}",
                    k + 1
                ));
            }
            complete += &format!("{key} {}", rgb.join(" "));
        } else {
            complete += line;
        }
        complete.push('\n');
    }
    Ok(complete)
}

#[cfg(test)]
mod tests {
    use super::complete_colours;

    #[test]
    fn one_number_is_a_grey_and_an_incomplete_colour_is_named_by_its_line() {
        let text = "newmtl a\r\n  Kd 0.5 # grey\nKs 1 0 0 9\nNs 10\n";
        let complete = complete_colours(text).unwrap();
        assert_eq!(complete, "newmtl a\nKd 0.5 0.5 0.5\nKs 1 0 0\nNs 10\n");
        for wrong in ["Kd", "Kd 1 0", "Kd spectral file.rfl", "Kd a b c"] {
            let refusal = complete_colours(&format!("newmtl a\n{wrong}\n")).unwrap_err();
            assert!(refusal.starts_with("line 2: Kd: expected"), "{refusal}");
        }
    }
}
