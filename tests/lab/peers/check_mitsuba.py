"""Compares the depth of a scene as Mitsuba 3 sees its export with picofarm's own.

usage: check_mitsuba.py PICOFARM SCENE [SEED]

PICOFARM is the program; SCENE a scene file, or `furnished` or `primitive` to generate one from SEED. Needs mitsuba,
numpy and zarr. Each pixel's centre is traced by Mitsuba (scalar_rgb) through the exported XML, or through SCENE itself
where that is a Mitsuba scene; depths must agree within 1 mm on 99.9 % of the pixels. The export must also come back
with the same number of triangles.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import mitsuba as mi
import numpy as np
import zarr

TOLERANCE_M, SHARE = 1e-3, 0.999


def main(picofarm, scene, seed="7"):
    folder = pathlib.Path(tempfile.mkdtemp(prefix="check-mitsuba-"))

    def run(*args):
        done = subprocess.run([picofarm, "--json", "scene", *map(str, args)], check=True, capture_output=True, text=True)
        return json.loads(done.stdout.splitlines()[-1])

    if scene in ("furnished", "primitive"):
        run("generate", "--kind", scene, "--seed", seed, "--out", folder / "scene.glb")
        scene = folder / "scene.glb"
    run("export", scene, "--out", folder / "export", "--format", "mitsuba")
    exported = folder / "export" / "scene.xml"
    here, there = run("show", scene), run("show", exported)
    assert here["triangles"] == there["triangles"], (here["triangles"], there["triangles"])
    render = ("--samples", "1", "--max-bounces", "1", "--bins", "8", "--bin-width-m", "4")
    run("render", scene, "--out", folder / "ours", *render)
    ours = zarr.open_group(folder / "ours", mode="r")["depth"][:]

    mi.set_variant("scalar_rgb")
    theirs = mi.load_file(str(scene if str(scene).endswith(".xml") else exported))
    sensor = theirs.sensors()[0]
    pose = np.array(sensor.world_transform().matrix)
    origin, forward = pose[:3, 3], pose[:3, 2]
    height, width = ours.shape
    depth = np.full(ours.shape, np.nan)
    for v in range(height):
        for u in range(width):
            ray, _ = sensor.sample_ray(0, 0, [(u + 0.5) / width, (v + 0.5) / height], [0, 0])
            hit = theirs.ray_intersect(ray)
            if hit.is_valid():
                depth[v, u] = (np.array(hit.p) - origin) @ forward
    off = ~(np.abs(depth - ours) <= TOLERANCE_M) & ~(np.isnan(depth) & ~(ours > 0))
    share = 1 - off.mean()
    print(f"{here['triangles']} triangles; {100 * share:.3f} % of {ours.size} pixels within {1000 * TOLERANCE_M} mm, "
          f"median difference {np.nanmedian(np.abs(depth - ours)):.2e} m")
    return 0 if share >= SHARE else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
