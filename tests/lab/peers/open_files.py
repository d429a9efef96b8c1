"""Renders each scene file of folders: open_files.py PICOFARM FOLDER... [--compare].

Prints how many glTF, OBJ, PLY, STL and Mitsuba files render without an option, and the reason of each other. With
--compare, Mitsuba's own distances along the rays of its camera are compared for the .xml files that it loads; a file
agrees if 98 % of its pixels are within 2 mm and 0.2 %. Needs zarr; --compare needs mitsuba.
"""

import argparse
import collections
import pathlib
import re
import subprocess
import tempfile

import numpy
import zarr

SUFFIXES = {".glb", ".gltf", ".obj", ".ply", ".stl", ".xml"}
SIDE = 40


def is_scene(path):
    if path.suffix != ".xml":
        return path.suffix in SUFFIXES
    return re.search(rb"<scene\s+version", path.read_bytes()[:4096]) is not None


def render(program, path, out):
    """The first line of the error, or an empty text."""
    command = [program, "scene", "render", path, "--out", out, "--resolution", str(SIDE), "--samples", "2"]
    try:
        made = subprocess.run(command, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        return "takes more than 300 s"
    lines = [line for line in made.stderr.splitlines() if line.startswith("error")]
    return "" if made.returncode == 0 else (lines or [f"exit status {made.returncode}"])[0]


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


def agreement(path, out):
    """The share of pixels that agree with Mitsuba; None if Mitsuba does not load the file."""
    ours = numpy.asarray(zarr.open_group(out, mode="r")["range"][:]).reshape(-1, SIDE)
    theirs = mitsuba_distances(path, ours.shape)
    if theirs is None:
        return None
    with numpy.errstate(invalid="ignore"):
        near = numpy.abs(theirs - ours) < 2e-3 + 2e-3 * ours
    return float((near | (numpy.isinf(theirs) & ~(ours > 0))).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program")
    parser.add_argument("folders", nargs="+", type=pathlib.Path)
    parser.add_argument("--compare", action="store_true")
    args = parser.parse_args()
    files = sorted(p for folder in args.folders for p in folder.rglob("*") if p.is_file() and is_scene(p))
    counts, compared = collections.Counter(), []
    for path in files:
        with tempfile.TemporaryDirectory() as folder:
            out = f"{folder}/render"
            error = render(args.program, path, out)
            counts[path.suffix, not error] += 1
            if error:
                print(f"{path}: {error}")
            elif args.compare and path.suffix == ".xml" and (share := agreement(path, out)) is not None:
                compared.append(share)
                if share < 0.98:
                    print(f"{path}: {share:.1%} of the pixels agree with Mitsuba")
    for suffix in sorted({suffix for suffix, _ in counts}):
        total = counts[suffix, True] + counts[suffix, False]
        print(f"{suffix}: {counts[suffix, True]} of {total} render")
    if compared:
        print(f"Mitsuba: {sum(share >= 0.98 for share in compared)} of {len(compared)} agree")


if __name__ == "__main__":
    main()
