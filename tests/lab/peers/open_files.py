"""Renders each scene file of folders: open_files.py PICOFARM FOLDER... [--validator DIR] [--compare].

Prints each file that does not render with the reason, and a table: how many glTF, OBJ, PLY, STL and Mitsuba files
render without an option, and the reasons by count. Equal files count once. With --validator, glTF files with errors by
Khronos' validator (npm package gltf-validator in DIR/node_modules) are counted apart. With --compare, distances along
the rays of the camera are compared: of .xml files with Mitsuba's, of others with Embree's through trimesh, which reads
neither skins nor instances, masks and hidden nodes. A file agrees if 98 % of its pixels are within 2 mm and 0.2 %.
Needs zarr; --compare needs mitsuba, trimesh and embreex.
"""

import argparse
import collections
import hashlib
import json
import pathlib
import re
import subprocess
import tempfile

import numpy
import zarr

SUFFIXES = {".glb", ".gltf", ".obj", ".ply", ".stl", ".xml"}
SIDE = 40
VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs"), path = require("path");
const read = (file) => new Uint8Array(fs.readFileSync(file));
(async () => {
  for (const file of fs.readFileSync(0, "utf8").split("\\n").filter(Boolean)) {
    const open = (uri) => new Promise((done, failed) => {
      try { done(read(path.resolve(path.dirname(file), decodeURIComponent(uri)))); } catch (e) { failed(String(e)); }
    });
    try {
      const report = await validator.validateBytes(read(file), { uri: file, externalResourceFunction: open });
      if (report.issues.numErrors === 0) console.log(file);
    } catch (e) { /* No glTF at all. */ }
  }
})();
"""


def is_scene(path):
    if path.suffix != ".xml":
        return path.suffix in SUFFIXES
    return re.search(rb"<scene\s+version", path.read_bytes()[:4096]) is not None


def scene_files(folders):
    """All scene files, equal ones once."""
    seen, files = set(), []
    for path in sorted(p for folder in folders for p in folder.rglob("*") if p.is_file() and is_scene(p)):
        key = path.name, hashlib.sha256(path.read_bytes()).hexdigest()
        if key not in seen:
            seen.add(key)
            files.append(path)
    return files


def valid_files(folder, files):
    """The glTF files in which Khronos' validator finds no error."""
    text = "\n".join(str(p.resolve()) for p in files if p.suffix in {".glb", ".gltf"})
    run = subprocess.run(["node", "-e", VALIDATE], input=text, capture_output=True, text=True, cwd=folder, check=True)
    return set(run.stdout.splitlines())


def render(program, path, out):
    """The first line of the error, or an empty text."""
    command = [program, "scene", "render", path, "--out", out, "--resolution", str(SIDE), "--samples", "2"]
    try:
        made = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=300)
    except subprocess.TimeoutExpired:
        return "takes more than 300 s"
    lines = [line for line in made.stderr.splitlines() if line.startswith("error")]
    return "" if made.returncode == 0 else (lines or [f"exit status {made.returncode}"])[0]


def reason(error):
    """An error without its file, names and numbers."""
    return re.sub(r"\d+", "N", re.sub(r'"[^"]*"', "…", error.split(": ", 2)[-1]))[:120]


def mitsuba_distances(path, shape):
    """Distances of Mitsuba's first hits from its camera, infinite for none; None if it does not load the file."""
    import mitsuba

    for variant in "scalar_rgb", "scalar_spectral_polarized":
        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        try:
            scene = mitsuba.load_file(str(path))
            sensor = scene.sensors()[0]
        except Exception:  # Whatever Mitsuba refuses.
            continue
        centre = numpy.array(mitsuba.traverse(sensor)["to_world"].matrix).reshape(4, 4)[:3, 3]
        far = numpy.full(shape, numpy.inf)
        for row, column in numpy.ndindex(shape):
            film = mitsuba.Point2f((column + 0.5) / shape[1], (row + 0.5) / shape[0])
            ray, _ = sensor.sample_ray(0.0, 0.5, film, mitsuba.Point2f(0.5, 0.5))
            hit = scene.ray_intersect(ray)
            if hit.is_valid():
                far[row, column] = numpy.linalg.norm(numpy.array(hit.p).ravel() - centre)
        return far
    return None


def embree_distances(path, shape, render):
    """Distances of Embree's first hits from our camera, infinite for none; None if trimesh does not load the file."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    try:
        mesh = trimesh.load_scene(path, process=False).to_mesh()
        notes = render["provenance"]["notes"]
        metres = 0.001 if notes.get("chosen.unit", "").startswith("mm") else 1.0
        moved = re.match(r"moved from \[(.*?)\]", notes.get("import.origin", ""))
        origin = numpy.array(moved[1].split(","), float) if moved else 0.0
        mesh = trimesh.Trimesh((numpy.asarray(mesh.vertices) - origin) * metres, mesh.faces, process=False)
    except Exception:  # Whatever trimesh refuses.
        return None
    camera = render["camera"]
    lens = camera["intrinsics"]
    rows, columns = numpy.indices(shape) + 0.5
    right, down, forward = (numpy.array(camera[axis]) for axis in ("right", "down", "forward"))
    rays = forward + numpy.multiply.outer((columns - lens["cx"]) / lens["fx"], right)
    rays = (rays + numpy.multiply.outer((rows - lens["cy"]) / lens["fy"], down)).reshape(-1, 3)
    rays /= numpy.linalg.norm(rays, axis=1, keepdims=True)
    origins = numpy.broadcast_to(numpy.array(camera["origin"]), rays.shape)
    far = numpy.full(len(rays), numpy.inf)
    places, hits, _ = RayMeshIntersector(mesh).intersects_location(origins, rays, multiple_hits=False)
    numpy.minimum.at(far, hits, numpy.linalg.norm(places - origins[hits], axis=1))
    return far.reshape(shape)


def agreement(path, out):
    """The share of pixels that agree with another program; None if it does not load the file."""
    ours = numpy.asarray(zarr.open_group(out, mode="r")["range"][:]).reshape(-1, SIDE)
    if path.suffix == ".xml":
        theirs = mitsuba_distances(path, ours.shape)
    else:
        facts = json.loads(pathlib.Path(out, "render", "zarr.json").read_text())["attributes"]
        theirs = embree_distances(path, ours.shape, facts)
    if theirs is None:
        return None
    with numpy.errstate(invalid="ignore"):
        near = numpy.abs(theirs - ours) < 2e-3 + 2e-3 * ours
    return float((near | (numpy.isinf(theirs) & ~(ours > 0))).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program")
    parser.add_argument("folders", nargs="+", type=pathlib.Path)
    parser.add_argument("--validator", type=pathlib.Path)
    parser.add_argument("--compare", action="store_true")
    args = parser.parse_args()
    files = scene_files(args.folders)
    valid = valid_files(args.validator, files) if args.validator else None
    counts, reasons, compared = collections.Counter(), collections.Counter(), collections.Counter()
    for path in files:
        kind = path.suffix
        if valid is not None and kind in {".glb", ".gltf"} and str(path.resolve()) not in valid:
            kind += " with errors"
        with tempfile.TemporaryDirectory() as folder:
            out = f"{folder}/render"
            error = render(args.program, path, out)
            counts[kind, not error] += 1
            if error:
                reasons[kind, reason(error)] += 1
                print(f"{path}: {error}")
            elif args.compare and (share := agreement(path, out)) is not None:
                compared[kind, share >= 0.98] += 1
                if share < 0.98:
                    print(f"{path}: {share:.1%} of the pixels agree")
    for kind in sorted({kind for kind, _ in counts}):
        total = counts[kind, True] + counts[kind, False]
        both = compared[kind, True] + compared[kind, False]
        agree = f", {compared[kind, True]} of {both} agree" if both else ""
        print(f"{kind}: {counts[kind, True]} of {total} render{agree}")
        for (of, why), count in reasons.most_common():
            if of == kind:
                print(f"  {count} {why}")


if __name__ == "__main__":
    main()
