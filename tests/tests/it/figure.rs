//! Figures for papers: files, sizes, limits of colour bars, and refusals.

use std::{path::Path, sync::Arc};

use picofarm_tests::{Cli, Scratch};
use zarrs::{array::Array, filesystem::FilesystemStore};

/// Renders a small room into `room`, with its parts.
fn rendered(cli: &Cli) {
    let generate = ["scene", "generate", "--kind", "primitive", "--seed", "3"];
    let size = ["--spots", "4", "--resolution", "24", "--out", "room.glb"];
    cli.run(&[&generate[..], &size].concat()).ok();
    let render = ["scene", "render", "room.glb", "--samples", "4", "--split"];
    cli.run(&[&render[..], &["--out", "room"]].concat()).ok();
}

fn depth(room: &Path) -> Vec<f32> {
    let store = Arc::new(FilesystemStore::new(room).unwrap());
    let array = Array::open(store, "/depth").unwrap();
    array.retrieve_array_subset(&array.subset_all()).unwrap()
}

#[test]
fn a_figure_is_an_svg_a_pdf_of_one_page_and_a_png_of_the_stated_size() {
    let scratch = Scratch::new("figure");
    let cli = Cli::new(scratch.path());
    rendered(&cli);
    let panels =
        "image,depth,range,normals,labels,masks,mask:3,mirrors,error,light,transient,histogram";
    let figure = ["figure", "room", "--panels", panels, "--width", "120mm"];
    let said = cli.json(&[&figure[..], &["--output", "all"]].concat());
    assert_eq!(said["panels"], 14, "three times of light: {said}");
    let height_mm = said["height_mm"].as_f64().unwrap();
    let read = |name: &str| std::fs::read(scratch.join(name)).unwrap();

    let svg = String::from_utf8(read("all.svg")).unwrap();
    assert!(svg.starts_with("<svg ") && svg.contains("width=\"120mm\""));
    // The ends of the bar of depth are the least and the largest depth.
    let depth = depth(&scratch.join("room"));
    let known = || depth.iter().copied().filter(|d| *d > 0.0);
    for limit in [
        known().fold(f32::MAX, f32::min),
        known().fold(0.0, f32::max),
    ] {
        // Three digits.
        let decimals = if limit < 1.0 { 3 } else { 2 };
        let text = format!("{limit:.decimals$}");
        let text = text.trim_end_matches('0').trim_end_matches('.');
        assert!(svg.contains(&format!(">{text}</text>")), "{text}");
    }

    let pdf = read("all.pdf");
    assert!(pdf.starts_with(b"%PDF-"));
    let text = String::from_utf8_lossy(&pdf);
    assert_eq!(text.matches("/Type /Page\n").count(), 1);
    let (_, page) = text.split_once("/MediaBox [").expect("a page's size");
    let (page, _) = page.split_once(']').unwrap();
    let sides: Vec<f64> = page.split(' ').map(|n| n.parse().unwrap()).collect();
    for (side, mm) in [(sides[2], 120.0), (sides[3], height_mm)] {
        assert!(
            (side / 72.0 * 25.4 - mm).abs() < 0.1,
            "{side} points, {mm} mm"
        );
    }

    let png = read("all.png");
    assert!(png.starts_with(b"\x89PNG"));
    let side = |at: usize| u32::from_be_bytes(png[at..at + 4].try_into().unwrap());
    let pixels = |mm: f64| (mm / 25.4 * 300.0).round() as u32;
    assert_eq!([side(16), side(20)], [pixels(120.0), pixels(height_mm)]);

    // The same command writes the same bytes, and only where it is told to.
    cli.run(&[&figure[..], &["--output", "all"]].concat())
        .fails(3, &["--output all.svg", "exists", "--overwrite"]);
    let again = ["--output", "all", "--overwrite"];
    cli.run(&[&figure[..], &again].concat()).ok();
    assert!(read("all.pdf") == pdf && read("all.png") == png);

    let gif = ["figure", "room", "--animate", "flight.gif"];
    cli.run(&gif).ok();
    assert!(read("flight.gif").starts_with(b"GIF89a"));
}

#[test]
fn what_a_figure_cannot_show_is_refused_by_its_option() {
    let scratch = Scratch::new("figure-refused");
    let cli = Cli::new(scratch.path());
    rendered(&cli);
    let refused = |args: &[&str], code: i32, parts: &[&str]| {
        cli.run(&[&["figure"], args].concat()).fails(code, parts);
    };
    let out = ["--output", "f.svg"];
    let with = |more: &[&'static str]| [&["room"], more, &out].concat();
    refused(
        &["room.glb", "--output", "f.svg"],
        3,
        &["room.glb", "scene render"],
    );
    refused(
        &["absent", "--output", "f.svg"],
        3,
        &["absent", "scene render"],
    );
    refused(&["room"], 2, &["--output"]);
    refused(
        &["room", "--output", "f.jpg"],
        3,
        &["--output f.jpg", ".svg, .pdf or .png"],
    );
    refused(
        &["room", "--output", "no/f.svg"],
        3,
        &["--output no/f.svg", "no folder"],
    );
    refused(
        &["room", "--animate", "f.mp4"],
        3,
        &["--animate f.mp4", ".gif"],
    );
    refused(&with(&["--scene", "3"]), 3, &["--scene 3", "0 to 0"]);
    refused(&with(&["--panels", "deep"]), 2, &["--panels", "depth"]);
    refused(&with(&["--panels", "mask:4"]), 3, &["mask:4", "4 spots"]);
    refused(&with(&["--times", "500ns"]), 3, &["--times 500ns", "ns"]);
    refused(&with(&["--times", "8"]), 2, &["--times", "8ns"]);
    refused(&with(&["--pixel", "24,0"]), 3, &["--pixel 24,0", "24x24"]);
    refused(
        &with(&["--width", "60mm", "--columns", "4"]),
        3,
        &["--width 60 mm", "--columns"],
    );
    let plain = [
        "scene",
        "render",
        "room.glb",
        "--samples",
        "4",
        "--out",
        "plain",
    ];
    cli.run(&plain).ok();
    refused(
        &["plain", "--panels", "error", "--output", "f.svg"],
        3,
        &["--panels error", "--split"],
    );
    assert!(!scratch.join("f.svg").exists(), "nothing is left behind");
}
