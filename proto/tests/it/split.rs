//! Splits: exact when they are made, stable when data sets grow.

use std::collections::BTreeSet;

use picofarm_proto::split::{Parts, Rank, SIDES, SplitRecord, SplitSettings};
use proptest::prelude::*;

fn settings(seed: u64, parts: Parts) -> SplitSettings {
    SplitSettings {
        name: "default".into(),
        seed,
        parts,
    }
}

fn first(n: u64) -> BTreeSet<u64> {
    (0..n).collect()
}

/// Returns three counts with sum n.
fn counts(n: u64) -> impl Strategy<Value = [u64; 3]> {
    (0..=n, 0..=n).prop_map(move |(a, b)| {
        let (low, high) = (a.min(b), a.max(b));
        [low, high - low, n - high]
    })
}

#[test]
fn the_paper_s_split_is_exact_and_the_same_every_time() {
    let asked = settings(0, Parts::Counts([87_688, 3_744, 6_000]));
    let record = SplitRecord::first(&asked, &first(97_432)).unwrap();
    assert_eq!(record.counts, [87_688, 3_744, 6_000]);
    assert_eq!(record.sides.len(), 97_432);
    let again = SplitRecord::first(&asked, &first(97_432)).unwrap();
    assert_eq!(record.to_bytes(), again.to_bytes());
    assert_eq!(SplitRecord::parse(&record.to_bytes()).unwrap(), record);
    // Without new scenes nothing changes. After growth, old scenes keep their sides and the cuts
    // decide for new ones.
    assert_eq!(record.extended(&asked, &first(97_432)).unwrap(), None);
    let grown = record.extended(&asked, &first(120_000)).unwrap().unwrap();
    assert!(grown.sides.starts_with(&record.sides));
    assert_eq!((grown.version, grown.made_of), (2, 97_432));
    // These numbers must never change, because they assign every scene in all existing data sets.
    assert_eq!(Rank::of(0, 0).hash, RANK_0);
    assert_eq!(&record.sides[..40], SIDES_40);
}

const RANK_0: u64 = 0x9eb41a004ebb264c;
const SIDES_40: &str = "0000000220000000000100000000001000000000";

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn counts_are_exact_where_the_split_is_made(
        (n, counts) in (1u64..400).prop_flat_map(|n| (Just(n), counts(n))), seed: u64,
    ) {
        let record = SplitRecord::first(&settings(seed, Parts::Counts(counts)), &first(n)).unwrap();
        prop_assert_eq!(record.counts, counts);
        for (side, count) in SIDES.iter().zip(counts) {
            prop_assert_eq!(record.scenes(side).len() as u64, count);
        }
    }

    #[test]
    fn no_scene_ever_changes_sides_however_the_data_set_grows(
        (n, counts) in (1u64..200).prop_flat_map(|n| (Just(n), counts(n))), seed: u64,
        batches in prop::collection::vec(prop::collection::btree_set(0u64..1000, 0..80), 1..4),
    ) {
        let asked = settings(seed, Parts::Counts(counts));
        let one = SplitRecord::first(&asked, &first(n)).unwrap();
        let mut last = one.clone();
        for batch in &batches {
            let Some(next) = last.extended(&asked, batch).unwrap() else { continue };
            prop_assert_eq!(next.version, last.version + 1);
            for side in SIDES {
                let (before, after) = (last.scenes(side), next.scenes(side));
                prop_assert!(before.iter().all(|s| after.contains(s)));
            }
            last = next;
        }
        // The result does not depend on how the scenes are divided into batches.
        let all: BTreeSet<u64> = batches.iter().flatten().copied().collect();
        let at_once = one.extended(&asked, &all).unwrap().unwrap_or(one);
        prop_assert_eq!(at_once.sides, last.sides);
        // An empty side stays empty.
        for (asked, found) in counts.iter().zip(last.counts) {
            prop_assert!(*asked > 0 || found == 0);
        }
    }

    #[test]
    fn later_scenes_keep_the_shares_within_what_chance_allows(seed: u64, n in 500u64..1500) {
        let shares = [0.9, 0.04, 0.06];
        let asked = settings(seed, Parts::Fractions(shares));
        let one = SplitRecord::first(&asked, &first(n)).unwrap();
        let m = 6000;
        let grown = one.extended(&asked, &first(n + m)).unwrap().unwrap();
        for (side, p) in shares.into_iter().enumerate() {
            let new = (grown.counts[side] - one.counts[side]) as f64 / m as f64;
            let sigma = (p * (1.0 - p) * (1.0 / m as f64 + 1.0 / n as f64)).sqrt();
            prop_assert!((new - p).abs() < 6.0 * sigma + 1.0 / n as f64, "{new} is not {p}");
        }
    }

    #[test]
    fn fractions_are_rounded_to_whole_scenes(
        n in 1u64..100_000, a in 0.0f64..1.0, b in 0.0f64..1.0,
    ) {
        let (low, high) = (a.min(b), a.max(b));
        let shares = [low, high - low, 1.0 - high];
        let counts = Parts::Fractions(shares).counts(n).unwrap();
        prop_assert_eq!(counts.iter().sum::<u64>(), n);
        for (count, share) in counts.iter().zip(shares) {
            prop_assert!((*count as f64 - share * n as f64).abs() < 1.0 + 1e-6);
        }
    }
}

#[test]
fn what_cannot_be_split_so_is_named() {
    let complaint = |parts: Parts, n: u64| {
        let error = SplitRecord::first(&settings(0, parts), &first(n)).unwrap_err();
        (error.field, error.what)
    };
    let (field, what) = complaint(Parts::Counts([8, 1, 2]), 10);
    assert!(
        field == "split.counts" && what.contains("11") && what.contains("10 scenes"),
        "{what}"
    );
    assert_eq!(
        complaint(Parts::Fractions([0.9, 0.2, 0.0]), 10).0,
        "split.fractions"
    );
    assert_eq!(
        complaint(Parts::Fractions([1.1, -0.1, 0.0]), 10).0,
        "split.fractions"
    );
    assert_eq!(complaint(Parts::Fractions([1.0, 0.0, 0.0]), 0).0, "split");
    let (field, what) = complaint(Parts::Fractions([0.9, 0.04, 0.06]), 8);
    assert!(
        field == "split.fractions" && what.contains("validation"),
        "{what}"
    );
    let made = SplitRecord::first(&settings(0, Parts::Counts([8, 1, 1])), &first(10)).unwrap();
    for (other, field) in [
        (settings(1, Parts::Counts([8, 1, 1])), "split.seed"),
        (settings(0, Parts::Counts([7, 2, 1])), "split.parts"),
        (
            settings(0, Parts::Fractions([0.8, 0.1, 0.1])),
            "split.parts",
        ),
    ] {
        let error = made.extended(&other, &first(10)).unwrap_err();
        assert_eq!(error.field, field);
        assert!(error.what.contains("was made with"), "{}", error.what);
    }
    let bad = SplitSettings {
        name: "a/b".into(),
        ..settings(0, Parts::Counts([1, 0, 0]))
    };
    assert_eq!(bad.check().unwrap_err().field, "split.name");
    let mut torn = made.clone();
    torn.counts[0] += 1;
    assert!(
        SplitRecord::parse(&torn.to_bytes())
            .unwrap_err()
            .contains("counts")
    );
}
