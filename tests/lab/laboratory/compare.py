"""Compares what the job `laboratory.toml` made of simulated captures with the renderer's truth.

    python compare.py FOLDER --program picofarm

FOLDER is the one of simulate.py and the store of the job. Prints two tables in Markdown, and writes
FOLDER/tables.json. Depths are compared over pixels that see no mirror. Meshes are compared by depths
from ten views around the middle of the scene: the mean of |true − found|, and the share of the true
surface that the mesh lacks, which counts as 0.5 m. Needs numpy and zarr.
"""

import argparse
import json
import math
import pathlib
import re
import subprocess
import sys
import tempfile

import numpy as np
import zarr

METHODS = {
    "physics": "physics, one flash",
    "matched-filter": "matched filter, 16 captures",
    "likelihood": "likelihood ratio, 16 captures",
}
# Names of reconstructions, by what they are made from.
MESHES = {
    "3d-truth": "the truth",
    "3d-captures-clean": "16 captures without noise",
    "3d-captures-noisy": "16 captures",
    "3d-expected-clean": "16 captures without noise, expected light",
    "3d-expected-noisy": "16 captures, expected light",
    "3d-likelihood-noisy": "16 captures, likelihood ratio",
    "3d-captures-four": "4 captures",
    "3d-captures-one": "1 capture",
    "3d-flash-clean": "one flash without noise",
    "3d-flash-noisy": "one flash",
}
# Cosine up to which a surface and a spot count as on one plane.
LEAST_COSINE = 0.05
# Error of a ray that meets the scene but not the mesh, or differs by more, metres.
MOST_M = 0.5
SIDE = 64


def truth_of(folder):
    group = zarr.open_group(folder / "truth", mode="r")
    depth = np.asarray(group["depth"][0])
    spots = np.asarray(group["spots"][0])
    lit = np.unpackbits(np.asarray(group["visibility"][0]), axis=0, bitorder="little")[: len(spots)]
    # Pairs of pixel and spot that carry two-bounce light unless something is in between.
    fx, fy, cx, cy = np.asarray(group["intrinsics"][0])
    rows, columns = np.indices(depth.shape) + 0.5
    seen = np.stack([(columns - cx) / fx * depth, (rows - cy) / fy * depth, depth], -1)
    normals = np.asarray(group["normal"][0])
    ways = seen[None] - spots[:, None, None, :3]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True).clip(1e-9)
    cosines = np.minimum((ways * spots[:, None, None, 3:6]).sum(-1), -(ways * normals[None]).sum(-1))
    return depth, lit, np.asarray(group["specular"][0]), cosines > LEAST_COSINE


def depth_and_masks(truth, folder):
    """Returns the mean error of depth in metres, its median, the IoU of masks over all pairs of pixel
    and spot, that over pairs that can carry light, and that of "all lit" over these."""
    depth, lit, specular, carry = truth
    group = zarr.open_group(folder, mode="r")
    seen = (depth > 0) & (specular == 0)
    off = np.abs(np.asarray(group["depth"][0]) - depth)[seen]
    found = np.asarray(group["lit"][0]) >= 128
    known = np.broadcast_to(specular == 0, lit.shape)
    true = lit == 1

    def iou(found, of):
        return float((found & true & of).sum() / ((found | true) & of).sum())

    masks = [iou(found, known), iou(found, known & carry), iou(np.ones_like(found), known & carry)]
    return float(off.mean()), float(np.median(off)), *masks


def views(depth):
    """Returns origins and targets around the middle of what the camera sees: x left, y up, z forward."""
    far = float(np.quantile(depth[depth > 0], 0.9))
    middle = (0.0, -0.1 * far, 0.75 * far)
    for turn in range(5):
        for height in (-0.05, 0.12):
            angle = math.radians(-40 + 20 * turn)
            reach = 0.55 * far
            x, z = reach * math.sin(angle), middle[2] - reach * math.cos(angle)
            yield (x, height * far, z), middle


def render_depth(program, file, origin, target, out):
    """Returns z-depth of a scene file from a place; 0 where nothing is seen."""
    command = [program, "scene", "render", file, "--out", out, "--samples", 2, "--bins", 3, "--bin-width-m", 5]
    command += ["--resolution", SIDE, "--fov", 70, "--spots", 1, "--unit", "m", "--max-bounces", 2]
    command += ["--look-from", ",".join(map(str, origin)), "--look-at", ",".join(map(str, target))]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stderr}")
    return np.asarray(zarr.open_group(out, mode="r")["depth"][0])


def turned(file, out):
    """Writes a mesh (ASCII or binary PLY) with x and y reversed: right, down, forward to left, up, forward."""
    data = file.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    text = head.decode()
    count = int(re.search(r"element vertex (\d+)", text)[1])
    if "format binary_little_endian" not in text:
        sys.exit(f"{file}: expected a binary PLY file")
    part = text.split("element vertex")[1].split("element face")[0]
    names = re.findall(r"property (\w+) (\w+)", part)
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
    row = np.dtype([(name, kinds[kind]) for kind, name in names])
    vertices = np.frombuffer(body, row, count).copy()
    for axis in ("x", "y", "nx", "ny"):
        if axis in row.names:
            vertices[axis] *= -1
    out.write_bytes(head + b"end_header\n" + vertices.tobytes() + body[vertices.nbytes :])


def mesh_errors(program, true, mesh, temporary, kind):
    # The truth's world is that of the scene file; captures are in the camera's axes.
    file = temporary / "mesh.ply"
    if kind == "3d-truth":
        file.write_bytes(mesh.read_bytes())
    else:
        turned(mesh, file)
    errors, missing, total = [], 0, 0
    for k, (origin, target, expected) in enumerate(true):
        out = temporary / f"{kind}-{k}"
        found = render_depth(program, file, origin, target, out)
        seen = expected > 0
        off = np.where(found > 0, np.abs(found - expected), MOST_M)
        errors.append(np.minimum(off, MOST_M)[seen])
        missing += int((found == 0)[seen].sum())
        total += int(seen.sum())
    return float(np.concatenate(errors).mean()), missing / total


def picture(folder, scenes, file):
    """Draws true and found depth of the noisy captures, and the mask of one spot."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    rows, columns = 2 * len(scenes), 1 + len(METHODS)
    figure, axes = pyplot.subplots(rows, columns, figsize=(1.9 * columns, 1.9 * rows), squeeze=False)
    for k, scene in enumerate(scenes):
        depth, lit, *_ = truth_of(folder / scene)
        low, high = np.quantile(depth, [0.01, 0.99])
        # The spot whose mask has the most shadow without being dark.
        spot = int(np.argmin(np.abs(lit.mean(axis=(1, 2)) - 0.8)))
        found = [zarr.open_group(folder / f"{scene}-{m}-noisy", mode="r") for m in METHODS]
        depths = [depth, *(np.asarray(g["depth"][0]) for g in found)]
        masks = [lit[spot] == 1, *(np.asarray(g["lit"][0, spot]) >= 128 for g in found)]
        for n, (z, mask) in enumerate(zip(depths, masks)):
            axes[2 * k, n].imshow(z, vmin=low, vmax=high, cmap="viridis")
            axes[2 * k + 1, n].imshow(mask, vmin=0, vmax=1, cmap="gray")
            if k == 0:
                axes[0, n].set_title(["truth", "physics", "matched filter", "likelihood"][n], fontsize=9)
        axes[2 * k, 0].set_ylabel(f"{scene}, depth", fontsize=9)
        axes[2 * k + 1, 0].set_ylabel("lit by a spot", fontsize=9)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.tight_layout(pad=0.3)
    figure.savefig(file, dpi=90)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--program", default="picofarm")
    parser.add_argument("--no-meshes", action="store_true")
    parser.add_argument("--picture", type=pathlib.Path, help="file to draw (needs matplotlib)")
    args = parser.parse_args()
    scenes = [path.parent.name for path in sorted(args.folder.glob("*/truth"))]
    if not scenes:
        sys.exit(f"{args.folder}: has no SCENE/truth; run simulate.py with this folder as --out")
    if args.picture:
        picture(args.folder, scenes, args.picture)
    tables = {"images": {}, "meshes": {}}
    for scene in scenes:
        truth = truth_of(args.folder / scene)
        for noise in ("clean", "noisy"):
            for method in METHODS:
                folder = args.folder / f"{scene}-{method}-{noise}"
                if folder.exists():
                    tables["images"][f"{scene} {noise} {method}"] = depth_and_masks(truth, folder)
        if args.no_meshes:
            continue
        with tempfile.TemporaryDirectory() as temporary:
            temporary = pathlib.Path(temporary)
            true = []
            for k, (origin, target) in enumerate(views(truth[0])):
                out = temporary / f"truth-{k}"
                true.append((origin, target, render_depth(args.program, args.folder / scene / "scene.xml", origin, target, out)))
            for kind in MESHES:
                for mesh in sorted((args.folder / f"{scene}-{kind}").rglob("mesh.ply")):
                    tables["meshes"][f"{scene} {kind}"] = mesh_errors(args.program, true, mesh, temporary, kind)
    (args.folder / "tables.json").write_text(json.dumps(tables, indent=2) + "\n")
    print("| capture | method | depth MAE, m | median, m | shadow IoU | where light can be | all lit |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for key, (mean, median, iou, carrying, all_lit) in tables["images"].items():
        scene, noise, method = key.split()
        print(f"| {scene}, {noise} | {METHODS[method]} | {mean:.4f} | {median:.4f} | {iou:.3f} | {carrying:.3f} | {all_lit:.3f} |")
    print("\n| scene | 3D from | error, m | not met |\n| --- | --- | --- | --- |")
    for key, (mean, missing) in tables["meshes"].items():
        scene, kind = key.split()
        print(f"| {scene} | {MESHES[kind]} | {mean:.4f} | {100 * missing:.1f} % |")


if __name__ == "__main__":
    main()
