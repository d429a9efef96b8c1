//! Pictures, values and volumes of scenes.

use std::path::Path;

use picofarm_dataset::{RenderArray, write_render_group};
use serde_json::json;

use crate::{
    client::Web,
    room::{self, BINS, SIDE, h},
};

fn shown() -> (tempfile::TempDir, Web) {
    let folder = tempfile::tempdir().unwrap();
    room::write(&folder.path().join("store"));
    std::fs::write(folder.path().join("secret"), "secret").unwrap();
    let store = folder.path().join("store").display().to_string();
    let web = Web::start(vec![store]);
    (folder, web)
}

#[test]
fn the_data_sets_of_a_store_and_their_finished_scenes_are_found() {
    let (_folder, web) = shown();
    let list = web.get("/data").text();
    assert!(
        list.contains("/data?set=0%2Frooms") && list.contains("2 of 3 scenes"),
        "{list}"
    );
    let gallery = web.get("/data?set=0%2Frooms").text();
    let cards = |html: &str| html.matches("/bytes/card?").count();
    assert_eq!(cards(&gallery), 2);
    assert_eq!(cards(&web.get("/data?set=0%2Frooms&from=1").text()), 1);
    assert_eq!(cards(&web.get("/data?set=0%2Frooms&to=1&from=1").text()), 0);
    let card = web.get("/bytes/card?set=0%2Frooms&scene=2");
    assert!(card.body.starts_with(b"\x89PNG"));
}

#[test]
fn a_gallery_is_filtered_and_sorted_by_what_manifests_say() {
    let (folder, web) = shown();
    let cards = |filter: &str| -> Vec<String> {
        let html = web.get(&format!("/data?set=0%2Frooms&{filter}")).text();
        let cards = html.split("/bytes/card?").skip(1);
        let scene = |card: &str| card.split(['"', '&']).nth(1).unwrap_or_default().to_owned();
        cards
            .map(|card| scene(&card.replace("&amp;", "&")))
            .collect()
    };
    assert_eq!(cards("room=kitchen"), ["scene=0"]);
    assert_eq!(cards("mirrors=yes"), ["scene=2"]);
    assert_eq!(cards("least=5&most=20"), ["scene=2"]);
    assert_eq!(cards("sort=error"), ["scene=2", "scene=0"]);
    assert_eq!(cards("room=kitchen&sort=error&mirrors=yes"), [""; 0]);
    let manifest = folder.path().join("store/rooms/manifests/0.json");
    let text = std::fs::read_to_string(&manifest).unwrap();
    assert_eq!(cards("damaged=yes"), [""; 0]);
    std::fs::write(&manifest, text.replace("kitchen", "kitchem")).unwrap();
    // Another start has read nothing yet.
    let again = Web::start(vec![folder.path().join("store").display().to_string()]);
    let html = again.get("/data?set=0%2Frooms&damaged=yes").text();
    assert_eq!(html.matches("/bytes/card?").count(), 1, "{html}");
    for wrong in ["mirrors=maybe", "least=x", "sort=age"] {
        let reply = web.get(&format!("/data?set=0%2Frooms&{wrong}"));
        let name = wrong.split('=').next().unwrap();
        assert_eq!(reply.status, 400, "{wrong}");
        assert!(
            reply.text().contains(&format!("{name}: expected")),
            "{wrong}"
        );
    }
}

#[test]
fn places_outside_of_the_given_stores_are_not_read() {
    let (folder, web) = shown();
    let outside = folder.path().join("store/rooms").display().to_string();
    let outside = outside.trim_start_matches('/');
    for set in [
        "0/../store/rooms",
        "1/rooms",
        "0/rooms/../rooms",
        outside,
        "0//rooms",
        "0/rooms/",
    ] {
        let set: String = url::form_urlencoded::byte_serialize(set.as_bytes()).collect();
        for page in [
            "data/scene",
            "flight",
            "bytes/picture",
            "bytes/flight",
            "bytes/slab",
            "bytes/depth",
            "bytes/view",
            "bytes/physics",
            "bytes/gif",
            "bytes/figure",
            "bytes/mesh",
            "data/room",
        ] {
            let path = format!("/{page}?set={set}&scene=0&what=rgb&from=0&to=1");
            assert_eq!(web.get(&path).status, 404, "{path}");
        }
        assert_eq!(web.get(&format!("/data?set={set}")).status, 404, "{set}");
    }
    assert_eq!(web.get("/flight?set=0%2Frooms&scene=0").status, 200);
}

#[test]
fn a_scene_is_shown_with_all_images_also_next_to_another() {
    let (_folder, web) = shown();
    let one = web.get("/data/scene?set=0%2Frooms&scene=0").text();
    for what in [
        "rgb",
        "intensity",
        "depth",
        "normal",
        "label",
        "instance",
        "mirror",
        "lit&amp;spot=0",
    ] {
        let link = format!("&amp;what={what}\"");
        let at = one.find(&link).unwrap_or_else(|| panic!("{what}"));
        let start = one[..at].rfind("src=\"").unwrap() + 5;
        let path = one[start..at + link.len() - 1].replace("&amp;", "&");
        let picture = web.get(&path);
        assert!(picture.body.starts_with(b"\x89PNG"), "{path}");
    }
    assert!(
        one.contains("<dt>task key</dt><dd><code>task</code>"),
        "{one}"
    );
    let two = web.get("/data/scene?set=0%2Frooms&scene=0&scene2=2").text();
    assert_eq!(two.matches("class=\"column\"").count(), 2, "{two}");
    assert_eq!(web.get("/data/scene?set=0%2Frooms&scene=1").status, 404);
    assert_eq!(
        web.get("/data/scene?set=0%2Frooms&scene=0&spot=9").status,
        400
    );
}

#[test]
fn values_are_those_of_the_pixel() {
    let (_folder, web) = shown();
    let at = |row: usize, column: usize| {
        let path = format!("/bytes/value?set=0%2Frooms&scene=0&row={row}&column={column}");
        web.get(&path)
    };
    let upper = at(0, 3).json();
    assert_eq!(upper["depth_m"], 2.0);
    assert_eq!(upper["label_name"], "<b>wall</b>");
    assert_eq!(upper["lit_by"], json!([0, 1]));
    assert_eq!(at(SIDE - 1, 3).json()["lit_by"], json!([0]));
    let outside = at(SIDE, 0);
    assert_eq!(outside.status, 400);
    assert!(outside.text().contains("row: expected a number below 20"));
}

#[test]
fn a_volume_arrives_in_slabs_and_its_codes_are_the_stored_values() {
    let (_folder, web) = shown();
    let query = "set=0%2Frooms&scene=2";
    let facts = web.get(&format!("/bytes/flight?{query}")).json();
    let volume = &facts["volume"];
    assert_eq!(
        (&volume["bins"], &volume["width"]),
        (&json!(BINS), &json!(SIDE))
    );
    let factor = volume["factor"].as_f64().unwrap();
    for (light, spots) in [("all", &[0, 1][..]), ("spot-1", &[1])] {
        let mut codes = Vec::new();
        for from in (0..BINS).step_by(32) {
            let to = BINS.min(from + 32);
            let path = format!("/bytes/slab?{query}&light={light}&from={from}&to={to}");
            codes.extend(web.get(&path).body);
        }
        assert_eq!(codes.len(), 2 * SIDE * SIDE * BINS);
        for (i, code) in codes.chunks_exact(2).enumerate() {
            let (bin, pixel) = (i / (SIDE * SIDE), i % (SIDE * SIDE));
            let found = (f64::from(u16::from_le_bytes([code[0], code[1]])) / factor).powi(2);
            let exact: f32 = spots.iter().map(|s| h(*s, pixel, bin)).sum();
            assert!(
                (found - f64::from(exact)).abs() < 0.02,
                "{pixel} {bin} {found} {exact}"
            );
        }
    }
    let small = web.get(&format!("/bytes/coarse?{query}"));
    assert_eq!(small.body.len(), 2 * SIDE * SIDE * BINS);
    for light in ["spot-2", "two", "25"] {
        let reply = web.get(&format!("/bytes/flight?{query}&light={light}"));
        assert_eq!(reply.status, 404, "{light}");
        assert!(reply.text().contains("<p>light: "), "{}", reply.text());
        // The player shows all light in its place, and says so.
        let page = web.get(&format!("/flight?{query}&light={light}")).text();
        assert!(page.contains("data-light=\"all\""), "{page}");
        assert!(page.contains("all light is shown"), "{page}");
        assert!(page.contains("<option value=\"all\" selected>"), "{page}");
    }
    let page = web.get(&format!("/flight?{query}&light=spot-1")).text();
    assert!(page.contains("data-light=\"spot-1\"") && !page.contains("all light is shown"));
}

#[test]
fn a_histogram_has_the_times_of_one_and_two_bounces() {
    let (_folder, web) = shown();
    // Spot 0 is half a metre left of the middle, at column 10 - 0.5·10/2 = 7.5, row 10.
    let path =
        |row, column| format!("/bytes/pixel?set=0%2Frooms&scene=0&row={row}&column={column}");
    let own = web.get(&path(10, 7)).json();
    let distance = 0.5f64.hypot(2.0);
    assert!(
        (own["one"]["path_m"].as_f64().unwrap() - 2.0 * distance).abs() < 1e-6,
        "{own}"
    );
    let other = web.get(&path(15, 10)).json();
    assert_eq!(other["one"], json!(null));
    // The pixel's middle sees x = 0.1, y = 1.1 on the wall.
    let (x, y, z) = (0.1f64, 1.1f64, 2.0f64);
    let two = distance + ((x + 0.5).powi(2) + y * y).sqrt() + (x * x + y * y + z * z).sqrt();
    assert!(
        (other["two"][0]["path_m"].as_f64().unwrap() - two).abs() < 1e-6,
        "{other}"
    );
    assert_eq!(other["two"][0]["lit"], true);
    assert_eq!(other["two"][1]["lit"], false);
    let pixel = 15 * SIDE + 10;
    for (bin, found) in other["h"].as_array().unwrap().iter().enumerate() {
        let exact = h(0, pixel, bin) + h(1, pixel, bin);
        assert!((found.as_f64().unwrap() - f64::from(exact)).abs() < 0.02);
    }
}

#[test]
fn a_histogram_of_selected_light_has_no_parts_and_only_the_times_of_its_spot() {
    let (folder, web) = shown();
    let values = vec![0.25f32; SIDE * SIDE * BINS];
    let shape = [SIDE, SIDE, BINS].map(|n| n as u64);
    let arrays = ["two", "multi"].map(|name| RenderArray {
        name,
        shape: &shape,
        dimension_names: &["row", "column", "bin"],
        data: &values,
    });
    let render = folder.path().join("store/rooms/render");
    write_render_group(&render, &arrays, &serde_json::Map::new()).unwrap();
    let pixel = |light: &str| {
        let query = format!("set=0%2Frooms&scene=0&row=10&column=7&light={light}");
        web.get(&format!("/bytes/pixel?{query}")).json()
    };
    let all = pixel("all");
    assert_eq!(all["whole"], true);
    assert_eq!(all["parts"].as_array().unwrap().len(), 2);
    assert_eq!(all["two"].as_array().unwrap().len(), 2);
    assert_eq!(all["one"]["spot"], 0);
    for light in ["two", "more", "spot-0", "spot-1"] {
        let found = pixel(light);
        assert_eq!(
            (&found["whole"], &found["parts"]),
            (&json!(false), &json!(null))
        );
        if let Some(spot) = light.strip_prefix("spot-") {
            let spot: u64 = spot.parse().unwrap();
            assert_eq!(found["two"].as_array().unwrap().len(), 1, "{light}");
            assert_eq!(found["two"][0]["spot"], spot);
            assert_eq!(found["one"].is_null(), spot != 0, "{light}");
        }
    }
}

#[test]
fn light_at_times_that_geometry_forbids_is_found() {
    let (_folder, web) = shown();
    let found = web.get("/bytes/physics?set=0%2Frooms&scene=0").json();
    assert_eq!(found["verdict"], "does not agree", "{found}");
    assert!(found["reasons"][0].is_string(), "{found}");
    let shares: Vec<f64> = serde_json::from_value(found["shares"].clone()).unwrap();
    assert!((shares.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{found}");
    assert_eq!(found["rendered_apart"], false);
}

#[test]
fn light_in_flight_is_saved_as_an_animation_and_as_a_figure() {
    let (_folder, web) = shown();
    let query = "set=0%2Frooms&scene=0&bin=12&shutter=4&exposure=1&scale=log&map=1";
    let gif = web.get(&format!("/bytes/gif?{query}"));
    assert!(gif.body.starts_with(b"GIF89a"), "{}", gif.head);
    let named = gif.header("content-disposition");
    assert_eq!(
        named,
        Some("attachment; filename=\"light-in-flight-0.gif\"")
    );
    let dark = web.get(&format!(
        "/bytes/gif?{}",
        query.replace("=1&scale", "=-9&scale")
    ));
    assert_ne!(dark.body, gif.body, "exposure counts");
    let figure = |more: &str| web.get(&format!("/bytes/figure?{query}{more}"));
    let svg = figure("").text();
    assert!(
        svg.starts_with("<svg") && svg.contains(" ns</text>"),
        "{svg}"
    );
    assert!(!svg.contains("pixel ("));
    let svg = figure("&pixel=7,10").text();
    assert!(svg.contains("pixel (7, 10)"));
    for (more, name) in [
        ("&pixel=7", "pixel: "),
        ("&pixel=7,20", "row: "),
        ("&shutter=99", "shutter: "),
    ] {
        let refused = figure(more);
        assert_eq!(refused.status, 400, "{more}");
        assert!(refused.text().contains(&format!("<p>{name}")), "{more}");
    }
}

#[test]
fn the_depth_and_the_camera_of_a_scene_are_those_of_the_data_set() {
    let (_folder, web) = shown();
    let depth = web.get("/bytes/depth?set=0%2Frooms&scene=0").body;
    assert_eq!(depth, 2.0f32.to_le_bytes().repeat(SIDE * SIDE));
    let view = web.get("/bytes/view?set=0%2Frooms&scene=0").json();
    assert_eq!(view["intrinsics"], json!([10.0, 10.0, 10.0, 10.0]));
    assert_eq!(view["laser"], json!([0.0, 0.0, 0.0]));
    assert_eq!(view["up"], json!([0.0, 1.0, 0.0]));
    assert_eq!(view["spots"][0]["position"], json!([-0.5, 0.0, 2.0]));
}

#[test]
fn a_folder_of_a_reconstruction_is_listed_and_shown_in_3d() {
    let (folder, web) = shown();
    let room = folder.path().join("store/my-room");
    std::fs::create_dir(&room).unwrap();
    std::fs::write(room.join("mesh.glb"), "glTF").unwrap();
    let metrics = json!({"triangles": 7, "novel_views": {"all": {"l1_m": 0.25}}});
    std::fs::write(room.join("metrics.json"), metrics.to_string()).unwrap();
    let list = web.get("/data").text();
    assert!(
        list.contains("/data/room?set=0%2Fmy-room&amp;scene=0"),
        "{list}"
    );
    let page = web.get("/data/room?set=0%2Fmy-room&scene=0").text();
    assert!(page.contains("<dd>0.250 m</dd>"), "{page}");
    // No scene of the stores is known to be its source.
    assert!(!page.contains("data-source") && !page.contains("value=\"error\""));
    assert_eq!(web.get("/bytes/mesh?set=0%2Fmy-room&scene=0").body, b"glTF");
    for (set, scene) in [
        ("0%2Fmy-room", 1),
        ("0%2Frooms", 0),
        ("0%2Fnosuch", 0),
        ("0%2F..%2Fmy-room", 0),
    ] {
        for what in ["bytes/mesh", "data/room"] {
            let path = format!("/{what}?set={set}&scene={scene}");
            assert_eq!(web.get(&path).status, 404, "{path}");
        }
    }
    std::fs::write(room.join("metrics.json"), "{").unwrap();
    let broken = web.get("/data/room?set=0%2Fmy-room&scene=0");
    assert_eq!(broken.status, 500);
    assert!(broken.text().contains("not JSON"), "{}", broken.text());
}

/// Changes the bytes of all files below a folder.
fn damage(folder: &Path) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => damage(&path),
            false => std::fs::write(&path, "damaged").unwrap(),
        }
    }
}

#[test]
fn damaged_arrays_are_named_in_place_and_hide_no_other_image() {
    let (folder, web) = shown();
    let query = "set=0%2Frooms&scene=0";
    damage(&folder.path().join("store/rooms/depth/c"));
    damage(&folder.path().join("store/rooms/label/c"));
    let page = web.get(&format!("/data/scene?{query}"));
    assert_eq!(page.status, 200, "{}", page.text());
    let html = page.text();
    assert_eq!(html.matches("class=\"damaged\"").count(), 2, "{html}");
    assert!(html.contains("rooms/depth/c/"), "{html}");
    assert!(html.contains("picofarm dataset repair"), "{html}");
    for (what, status) in [
        ("rgb", 200),
        ("normal", 200),
        ("depth", 500),
        ("label", 500),
    ] {
        let picture = web.get(&format!("/bytes/picture?{query}&what={what}"));
        assert_eq!(picture.status, status, "{what}");
    }
    let value = web
        .get(&format!("/bytes/value?{query}&row=0&column=3"))
        .json();
    assert_eq!(
        (&value["depth_m"], &value["label"]),
        (&json!(null), &json!(null))
    );
    assert_eq!(
        (&value["range_m"], &value["lit_by"]),
        (&json!(2.0), &json!([0, 1]))
    );
    let card = web.get(&format!("/bytes/card?{query}"));
    assert!(card.body.starts_with(b"\x89PNG"));
}

#[test]
fn stores_and_data_sets_that_cannot_be_read_are_listed_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    room::write(&store);
    let broken = store.join("broken");
    std::fs::create_dir(&broken).unwrap();
    std::fs::write(broken.join("zarr.json"), "{").unwrap();
    let invalid = store.join("invalid");
    std::fs::create_dir(&invalid).unwrap();
    let root = std::fs::read_to_string(store.join("rooms/zarr.json")).unwrap();
    let mut root: serde_json::Value = serde_json::from_str(&root).unwrap();
    root["attributes"]["picofarm"]["spec"]["gate"]["bins"] = json!(0);
    std::fs::write(invalid.join("zarr.json"), root.to_string()).unwrap();
    let missing = folder.path().join("nosuch").display().to_string();
    let web = Web::start(vec![store.display().to_string(), missing.clone()]);
    let list = web.get("/data").text();
    for (place, why) in [
        (broken.display().to_string(), "not JSON"),
        (invalid.display().to_string(), "gate.bins"),
        (missing, "there is no such folder"),
    ] {
        let (_, rest) = list.split_once(&format!("<b>{place}</b>: ")).expect(&list);
        let reason = rest.split("</li>").next().unwrap();
        assert!(reason.contains(why), "{reason}");
    }
    assert!(list.contains("/data?set=0%2Frooms"), "{list}");
    let page = web.get("/data?set=0%2Fbroken");
    assert_eq!(page.status, 500);
    assert!(page.text().contains("not JSON"), "{}", page.text());
}
