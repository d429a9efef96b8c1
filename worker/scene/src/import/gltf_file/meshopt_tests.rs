//! The decoders against meshoptimizer's own encoders.

use meshopt::encoding::{
    encode_filter_exp, encode_filter_oct, encode_filter_quat, encode_index_buffer,
    encode_index_sequence, encode_vertex_buffer_level,
};
use proptest::prelude::*;

use super::*;

/// Returns vertices of `SIZE` bytes: smooth, constant, rough or mixed by lane.
fn made<const SIZE: usize>(count: usize, seed: u32) -> Vec<[u8; SIZE]> {
    let mut state = seed | 1;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    let vertex = |k: usize, noise: [u8; SIZE]| -> [u8; SIZE] {
        std::array::from_fn(|lane| match (lane + seed as usize) % 5 {
            0 => 7,
            1 => (k / 3) as u8,
            2 => noise[lane],
            3 => (k as u8).wrapping_mul(11) ^ (noise[lane] >> 6),
            _ => noise[lane] >> 4,
        })
    };
    (0..count)
        .map(|k| vertex(k, std::array::from_fn(|_| random())))
        .collect()
}

fn same<const SIZE: usize>(count: usize, seed: u32) {
    let made = made::<SIZE>(count, seed);
    for (version, level) in [(0, 2), (1, 0), (1, 1), (1, 2), (1, 3)] {
        let coded = encode_vertex_buffer_level(&made, level, Some(version)).unwrap();
        let decoded = vertices(&coded, count, SIZE).unwrap();
        assert_eq!(
            decoded,
            made.as_flattened(),
            "{SIZE} {count} {version} {level}"
        );
        let _ = vertices(&coded[..coded.len() - 1], count, SIZE).unwrap_err();
        let _ = vertices(&coded, count + 300, SIZE).unwrap_err();
    }
}

/// Returns triangles of a grid, in rows.
fn grid(side: u32) -> Vec<u32> {
    let at = |x: u32, y: u32| y * (side + 1) + x;
    let cells = (0..side * side).map(|k| (k % side, k / side));
    let two = |(x, y)| {
        [
            at(x, y),
            at(x + 1, y),
            at(x, y + 1),
            at(x + 1, y),
            at(x + 1, y + 1),
            at(x, y + 1),
        ]
    };
    cells.flat_map(two).collect()
}

#[test]
fn vertices_are_what_the_reference_encoder_wrote() {
    for seed in 0..5 {
        for count in [1, 15, 16, 17, 255, 256, 257, 1000] {
            same::<4>(count, seed);
            same::<12>(count, seed);
            same::<20>(count, seed);
            same::<64>(count, seed);
            same::<256>(count, seed);
        }
    }
}

#[test]
fn triangles_and_indices_are_what_the_reference_encoder_wrote() {
    let mut scattered = grid(9);
    scattered
        .iter_mut()
        .for_each(|i| *i = i.wrapping_mul(2_654_435_761) >> 8);
    for corners in [
        grid(1),
        grid(30),
        scattered,
        vec![0, 1, 2, 2, 1, 0, 5, 5, 5],
    ] {
        let most = corners.iter().max().map_or(0, |m| *m as usize + 1);
        let coded = encode_index_buffer(&corners, most).unwrap();
        let decoded = triangles(&coded, corners.len()).unwrap();
        // The encoder may turn triangles.
        let turned = |t: &[u32]| {
            let first = (0..3).min_by_key(|k| t[*k]).unwrap();
            [t[first], t[(first + 1) % 3], t[(first + 2) % 3]]
        };
        let all = |corners: &[u32]| corners.chunks(3).map(turned).collect::<Vec<_>>();
        assert_eq!(all(&decoded), all(&corners));
        let _ = triangles(&coded[..coded.len() - 1], corners.len()).unwrap_err();
        let coded = encode_index_sequence(&corners, most).unwrap();
        assert_eq!(indices(&coded, corners.len()).unwrap(), corners);
        let _ = indices(&coded, corners.len() + 1).unwrap_err();
    }
}

#[test]
fn filters_are_undone_as_by_the_reference() {
    let unit = |k: u32| {
        let a = k as f32 * 0.37;
        let (s, c) = a.sin_cos();
        let w = (a * 0.1).cos();
        let rest = (1.0 - w * w).max(0.0).sqrt();
        [rest * s, rest * c, w, 0.0]
    };
    let units: Vec<[f32; 4]> = (0..200).map(unit).collect();
    let eight: Vec<[i8; 4]> = encode_filter_oct(&units, 8);
    let mut ours: Vec<u8> = eight.iter().flatten().map(|x| *x as u8).collect();
    let mut theirs = eight;
    meshopt::encoding::decode_filter_oct(&mut theirs);
    octahedral(&mut ours, 4);
    // The reference's vector code rounds some halves to the other side.
    for (ours, theirs) in ours.iter().zip(theirs.iter().flatten()) {
        assert!((i32::from(*ours as i8) - i32::from(*theirs)).abs() <= 1);
    }
    let bytes = |all: &[[i16; 4]]| {
        all.iter()
            .flatten()
            .flat_map(|x| x.to_le_bytes())
            .collect::<Vec<u8>>()
    };
    let near = |ours: &[u8], theirs: &[[i16; 4]]| {
        let ours = ours
            .as_chunks::<2>()
            .0
            .iter()
            .map(|x| i16::from_le_bytes(*x));
        for (ours, theirs) in ours.zip(theirs.iter().flatten()) {
            assert!((i32::from(ours) - i32::from(*theirs)).abs() <= 1);
        }
    };
    let sixteen: Vec<[i16; 4]> = encode_filter_oct(&units, 12);
    let mut ours = bytes(&sixteen);
    let mut theirs = sixteen;
    meshopt::encoding::decode_filter_oct(&mut theirs);
    octahedral(&mut ours, 8);
    near(&ours, &theirs);
    let turns = encode_filter_quat(&units, 12);
    let mut ours = bytes(&turns);
    let mut theirs = turns;
    meshopt::encoding::decode_filter_quat(&mut theirs);
    quaternions(&mut ours);
    near(&ours, &theirs);
    let floats: Vec<[f32; 3]> = units
        .iter()
        .map(|u| [u[0] * 1e3, u[1] * 1e-3, u[2]])
        .collect();
    let coded = encode_filter_exp(&floats, 15, meshopt::encoding::EncodeExpMode::Separate);
    let mut ours: Vec<u8> = coded
        .iter()
        .flatten()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    let mut theirs = coded;
    meshopt::encoding::decode_filter_exp(&mut theirs);
    exponential(&mut ours);
    assert_eq!(
        ours,
        theirs
            .iter()
            .flatten()
            .flat_map(|x| x.to_le_bytes())
            .collect::<Vec<u8>>()
    );
}

proptest! {
    #[test]
    fn any_bytes_are_decoded_or_refused(
        mut bytes in proptest::collection::vec(any::<u8>(), 0..400),
        head in proptest::sample::select(vec![0xa0, 0xa1, 0xe0, 0xe1, 0xd0]),
        count in 0usize..600,
        size in 1usize..=64,
    ) {
        if let Some(first) = bytes.first_mut() {
            *first = head;
        }
        if let Ok(all) = vertices(&bytes, count, 4 * size) {
            prop_assert_eq!(all.len(), count * 4 * size);
        }
        if let Ok(all) = triangles(&bytes, count - count % 3) {
            prop_assert_eq!(all.len(), count - count % 3);
        }
        if let Ok(all) = indices(&bytes, count) {
            prop_assert_eq!(all.len(), count);
        }
    }
}
