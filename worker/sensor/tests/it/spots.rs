//! Sums over spots.

use picofarm_sensor::{SPOTS_4_OF_100, SPOTS_25_OF_100, multiplex};

#[test]
fn spots_add_up_and_the_grids_subsets_are_those_of_the_method() {
    assert_eq!(SPOTS_25_OF_100[..6], [1, 3, 5, 7, 9, 21]);
    assert_eq!(SPOTS_25_OF_100[24], 89);
    assert_eq!(SPOTS_4_OF_100, [22, 27, 72, 77]);
    for i in SPOTS_25_OF_100 {
        assert!((i / 10) % 2 == 0 && (i % 10) % 2 == 1);
    }
    let per_spot: Vec<f32> = (0..100 * 6).map(|i| (i / 6) as f32 + 0.1).collect();
    let four = multiplex(&per_spot, 100, &SPOTS_4_OF_100).unwrap();
    assert_eq!(four, [198.4; 6]);
    let all: Vec<usize> = (0..100).collect();
    assert!((multiplex(&per_spot, 100, &all).unwrap()[3] - 4960.0).abs() < 1e-2);
    let error = multiplex(&per_spot, 100, &[3, 100])
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("chosen[1]: expected one of the spots 0 to 99"),
        "{error}"
    );
    assert!(multiplex(&per_spot, 7, &[0]).is_err());
}
