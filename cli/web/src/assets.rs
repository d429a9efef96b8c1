//! The files of the pages, inside the binary.

/// Returns the type of media and the content of a file.
pub fn find(name: &str) -> Option<(&'static str, &'static str)> {
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    Some(match name {
        "style.css" => (
            "text/css; charset=utf-8",
            concat!(
                include_str!("assets/style.css"),
                include_str!("assets/data.css")
            ),
        ),
        "icon.svg" => ("image/svg+xml", include_str!("assets/icon.svg")),
        "live.js" => (SCRIPT, include_str!("assets/live.js")),
        "grid.js" => (SCRIPT, include_str!("assets/grid.js")),
        "scene.js" => (SCRIPT, include_str!("assets/scene.js")),
        "flight.js" => (SCRIPT, include_str!("assets/flight.js")),
        "volume.js" => (SCRIPT, include_str!("assets/volume.js")),
        "histogram.js" => (SCRIPT, include_str!("assets/histogram.js")),
        "gl.js" => (SCRIPT, include_str!("assets/gl.js")),
        "orbit.js" => (SCRIPT, include_str!("assets/orbit.js")),
        "space.js" => (SCRIPT, include_str!("assets/space.js")),
        "save.js" => (SCRIPT, include_str!("assets/save.js")),
        "room.js" => (SCRIPT, include_str!("assets/room.js")),
        "glb.js" => (SCRIPT, include_str!("assets/glb.js")),
        "mesh.js" => (SCRIPT, include_str!("assets/mesh.js")),
        "marks.js" => (SCRIPT, include_str!("assets/marks.js")),
        _ => return None,
    })
}
