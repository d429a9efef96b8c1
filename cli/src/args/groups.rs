//! `--groups` and `--group`: subsets of the beams with histograms of their own.

use picofarm_dataset::Quantity;
use picofarm_sensor::{SPOTS_4_OF_100, SPOTS_25_OF_100};

use crate::error::{CliError, Result};

/// A subset with a standard name.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Group {
    Four,
    TwentyFive,
    PerSpot,
}

/// A subset given by its beams.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    name: String,
    beams: Vec<u32>,
}

/// An array to write: `[row][column][bin]` of some beams together, or `[spot][row][column][bin]` of
/// separate beams.
#[derive(Debug, Clone, PartialEq)]
pub struct Wanted {
    /// Name of the array.
    pub array: String,
    /// The renderer's groups that it contains.
    pub groups: Vec<Vec<u32>>,
    /// Whether it has a spot axis.
    pub per_spot: bool,
    /// The quantity of data sets that it is, if it is one.
    pub quantity: Option<Quantity>,
}

/// Parses `4`, `25` or `per-spot`.
///
/// # Errors
/// Fails for any other text.
pub fn parse(text: &str) -> Result<Group, String> {
    match text {
        "4" => Ok(Group::Four),
        "25" => Ok(Group::TwentyFive),
        "per-spot" => Ok(Group::PerSpot),
        _ => Err("expected 4, 25 or per-spot; other beams go into --group NAME=0,5,7".into()),
    }
}

/// Parses `left=0,5,7`.
///
/// # Errors
/// Returns a message about the missing or invalid part.
pub fn parse_named(text: &str) -> Result<Named, String> {
    let (name, list) = text
        .split_once('=')
        .ok_or("expected NAME=BEAM,BEAM,…, e.g. left=0,5,7")?;
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if name.is_empty() || !name.chars().all(plain) {
        return Err(format!(
            "{name:?}: expected a name of letters, digits, _ and -"
        ));
    }
    let beam = |b: &str| {
        let number = b.trim().parse::<u32>();
        number.map_err(|_| format!("{b:?}: expected a beam's number, counted from 0"))
    };
    let beams = list.split(',').map(beam).collect::<Result<Vec<_>, _>>()?;
    Ok(Named {
        name: name.into(),
        beams,
    })
}

/// Returns the arrays to write for a scene with a laser of `beams` beams.
///
/// # Errors
/// Fails if the laser does not have a subset, or if two arrays have the same name.
pub fn wanted(groups: &[Group], named: &[Named], beams: usize) -> Result<Vec<Wanted>> {
    let mut all: Vec<Wanted> = vec![];
    let mut add = |wanted: Wanted| {
        if all.iter().any(|w| w.array == wanted.array) {
            let what = format!("two histograms would be called {}", wanted.array);
            return Err(CliError::input(what).hint("give each --group another name"));
        }
        all.push(wanted);
        Ok(())
    };
    for group in groups {
        add(match group {
            Group::Four => of_grid("4", Quantity::Transient4, &SPOTS_4_OF_100, beams)?,
            Group::TwentyFive => of_grid("25", Quantity::Transient25, &SPOTS_25_OF_100, beams)?,
            Group::PerSpot => Wanted {
                array: "transient_spots".into(),
                groups: (0..beams as u32).map(|beam| vec![beam]).collect(),
                per_spot: true,
                quantity: Some(Quantity::TransientSpots),
            },
        })?;
    }
    for Named {
        name,
        beams: chosen,
    } in named
    {
        if let Some(beam) = chosen.iter().find(|b| **b as usize >= beams) {
            return Err(CliError::input(format!(
                "--group {name}: names beam {beam}, but the laser has {beams}, counted from 0"
            )));
        }
        add(Wanted {
            array: format!("transient_{name}"),
            groups: vec![chosen.clone()],
            per_spot: false,
            quantity: None,
        })?;
    }
    // In the order of a data set's arrays, then as stated.
    let order = |wanted: &Wanted| {
        let at = Quantity::ALL
            .iter()
            .position(|q| Some(*q) == wanted.quantity);
        at.unwrap_or(usize::MAX)
    };
    all.sort_by_key(order);
    Ok(all)
}

/// Returns a subset of the 10×10 grid.
fn of_grid(name: &str, quantity: Quantity, spots: &[usize], beams: usize) -> Result<Wanted> {
    if beams != 100 {
        return Err(CliError::input(format!(
            "--groups {name}: the {name} beams are some of the 100 of a 10x10 grid ({:?}…), but this laser has {beams}, \
             which are not such a grid",
            &spots[..spots.len().min(4)]
        ))
        .hint("render a scene with 100 spots, or name the beams: --group NAME=0,5,7"));
    }
    Ok(Wanted {
        array: format!("transient_{name}"),
        groups: vec![spots.iter().map(|&s| s as u32).collect()],
        per_spot: false,
        quantity: Some(quantity),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subsets_of_the_grid_are_those_of_the_sensor_model() {
        let groups = ["4", "25", "per-spot"].map(|t| parse(t).unwrap());
        let named = [parse_named("left=0, 5,7").unwrap()];
        let all = wanted(&groups, &named, 100).unwrap();
        let names: Vec<_> = all.iter().map(|w| w.array.as_str()).collect();
        assert_eq!(
            names,
            [
                "transient_4",
                "transient_25",
                "transient_spots",
                "transient_left"
            ]
        );
        assert_eq!(all[0].groups, [[22, 27, 72, 77]]);
        assert_eq!(all[1].groups[0][..3], [1, 3, 5]);
        assert_eq!(all[2].groups.len(), 100);
        assert!(all[2].per_spot);
        assert_eq!(all[3].groups, [[0, 5, 7]]);
    }

    #[test]
    fn what_a_laser_does_not_have_is_refused() {
        let four = wanted(&[Group::Four], &[], 25).unwrap_err();
        assert!(
            four.message.contains("10x10 grid") && four.message.contains("this laser has 25"),
            "{}",
            four.message
        );
        let named = |text| vec![parse_named(text).unwrap()];
        let beyond = wanted(&[], &named("a=0,25"), 25).unwrap_err();
        assert!(beyond.message.contains("beam 25"), "{}", beyond.message);
        let twice = wanted(&[Group::PerSpot], &named("spots=1"), 25).unwrap_err();
        assert!(twice.message.contains("transient_spots"));
        for bad in ["left", "=1", "a b=1", "left=", "left=1,x"] {
            assert!(parse_named(bad).is_err(), "{bad}");
        }
        assert!(parse("5").is_err());
    }
}
