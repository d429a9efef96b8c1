"""Makes captures in the format of bounce-flash lidar from the geometry and pulse of its real data.

For each scene of `scenes.py`, picofarm renders a histogram for each laser spot. Each is blurred by
the measured pulse, scaled to photons, gets a background, and is drawn from a Poisson distribution.
OUT/SCENE/NOISE has the laboratory's files: spot_1.mat to spot_16.mat and detector_scan_*.mat. OUT/SCENE
also has the scene (scene.xml), and the renderer's truth (truth, a Zarr group).

    python simulate.py --data FOLDER --program picofarm --out OUT

FOLDER holds the files of co24401/BounceFlashLidar. They state no licence, so they are not part of
this repository. Needs numpy, scipy and zarr.
"""

import argparse
import json
import math
import os
import pathlib
import subprocess
import sys

import numpy as np
import scipy.io
import scipy.signal
import zarr

import scenes

LIGHT_M_S = 299_792_458.0
BIN_S = 8e-12
T0_S = 14.2428e-9
WIDTH_M = BIN_S * LIGHT_M_S
ZERO_M = T0_S * LIGHT_M_S
# Degrees of the beam for a volt at the laser's galvo: a mirror of 0.5 V per degree turns the beam by
# twice its own angle. The laser's own calibration and zero are not published.
DEGREES_PER_VOLT = 4.0
PULSE = "Replica_Collection_and_Bias_Lookup_Table--replica.mat"
SCAN = "TCI_large_scene_16pts--detector_scan_200x200.mat"
# Bins of the measured pulse before and after its peak.
BEFORE, AFTER = 80, 400
# Photons in the brightest two-bounce bin of the median lit pixel, and background photons for each bin.
NOISE = {"noisy": (40.0, 0.1), "clean": (4_000.0, 0.0)}


# Folders with only some of the noisy captures, by number.
FEW = {"four": (1, 5, 11, 15), "one": (11,)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=pathlib.Path, default=os.environ.get("PICOFARM_BF_LIDAR"))
    parser.add_argument("--program", default="picofarm")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--scene", choices=[*scenes.SCENES], action="append")
    parser.add_argument("--size", type=int, default=96, help="pixels of a side; the published scan has 200")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()
    if args.data is None or not (pathlib.Path(args.data) / SCAN).is_file():
        sys.exit(
            f"skipped: {args.data or 'no folder'} has no {SCAN}; name the folder with the files of "
            "co24401/BounceFlashLidar with --data or PICOFARM_BF_LIDAR"
        )
    for name in args.scene or scenes.SCENES:
        simulate(scenes.SCENES[name], pathlib.Path(args.data), args)


def view(scene, data):
    """Returns the limits of the view in the plane z = 1: from the scene, or from the detector's scan."""
    if scene.view is not None:
        return scene.view
    scan = scipy.io.loadmat(data / SCAN)
    theta, phi = scan["thetaMap"].ravel(), scan["phiMap"].ravel()
    forward = np.cos(phi) * np.sin(theta)
    u, v = np.cos(theta) / forward, np.sin(phi) * np.sin(theta) / forward
    return ((u.min(), u.max()), (v.min(), v.max()))


def pulse(data):
    """Returns the measured pulse around its peak, with a sum of 1, and the index of the peak."""
    whole = scipy.io.loadmat(data / PULSE)["replica"].ravel()
    peak = int(whole.argmax())
    part = whole[peak - BEFORE : peak + AFTER]
    return part / part.sum(), BEFORE


def beams(scene, data):
    """Returns the slopes of the beams at the laser, [spot, 3]."""
    volts = scipy.io.loadmat(data / scene.laser_scan)["V_UV"]
    slopes = np.tan(np.radians(DEGREES_PER_VOLT * volts)) * scene.spread
    slopes[:, 0] -= scenes.BASELINE_M / scene.aim_m
    return np.column_stack([slopes, np.ones(len(slopes))])


def simulate(scene, data, args):
    out, size = args.out / scene.name, args.size
    out.mkdir(parents=True, exist_ok=True)
    (left, right), (low, high) = view(scene, data)[0][::-1], view(scene, data)[1]
    # Pixel (row, column) looks at u[column], v[row]; the first column is at the left, where u is greatest.
    u, v = np.linspace(left, right, size), np.linspace(high, low, size)
    step = ((left - right) / (size - 1), (high - low) / (size - 1))
    if not math.isclose(*step, rel_tol=1e-3):
        sys.exit(f"{scene.name}: pixels of {step[0]} by {step[1]} are not square")
    centre = (0.5 + left / step[0], 0.5 + high / step[1])
    focal = 1 / (step[0] * size)
    text = scenes.mitsuba(
        scene, focal, (0.5 - centre[0] / size, 0.5 - centre[1] / size), size, beams(scene, data)
    )
    (out / "scene.xml").write_text(text)
    first = round((scene.gate[0] + ZERO_M) / WIDTH_M - 0.5)
    bins = round((scene.gate[1] - scene.gate[0]) / WIDTH_M)
    start_m = (first + 0.5) * WIDTH_M - ZERO_M
    if not (out / "truth").exists():
        command = [args.program, "scene", "render", out / "scene.xml", "--out", out / "truth", "--groups", "per-spot"]
        command += ["--resolution", size, "--samples", args.samples, "--threads", args.threads]
        command += ["--gate-start-m", start_m, "--bin-width-m", WIDTH_M, "--bins", bins]
        subprocess.run([str(word) for word in command], check=True)
    truth = zarr.open_group(out / "truth", mode="r")
    seen = np.asarray(truth["intrinsics"][0])
    expected = np.array([1 / step[0], 1 / step[1], *centre])
    if not np.allclose(seen, expected, atol=0.02):
        sys.exit(f"{scene.name}: the renderer's camera is {seen}, expected {expected}")
    if np.isnan(np.asarray(truth["spots"][0])[:, :3]).any():
        sys.exit(f"{scene.name}: a beam meets nothing")
    light = histograms(truth["transient_spots"])
    shape, peak = pulse(data)
    blurred = np.empty_like(light)
    for k, each in enumerate(light):
        whole = scipy.signal.fftconvolve(each, shape[None, None, :].astype(np.float32), axes=2)
        blurred[k] = np.maximum(whole[..., peak : peak + bins], 0)
    # Eight spots share a byte.
    lit = np.unpackbits(np.asarray(truth["visibility"][0]), axis=0, bitorder="little")[: len(light)] == 1
    unit = np.median(blurred.max(axis=-1)[lit])
    for noise, (photons, background) in NOISE.items():
        folder = out / noise
        folder.mkdir(exist_ok=True)
        scan(folder, u, v)
        # What the files do not say, for `picofarm capture import`.
        described = {
            "gate": {"t0_ps": T0_S * 1e12, "bin_width_ps": BIN_S * 1e12, "keep_m": scene.gate, "bins": bins},
            "frame": ["left", "up", "forward"],
            "laser_m": [scenes.BASELINE_M, 0.0, 0.0],
        }
        (folder / "capture.json").write_text(json.dumps(described, indent=2) + "\n")
        for k, each in enumerate(blurred):
            rate = each * np.float32(photons / unit) + np.float32(background)
            rng = np.random.default_rng([7, k])
            counts = np.rint(rate) if noise == "clean" else rng.poisson(rate)
            write(folder / f"spot_{k + 1}.mat", counts, first, background, rng)
        if noise == "noisy":
            for name, spots in FEW.items():
                fewer(folder, out / name, spots)
        print(f"{folder}: {len(light)} captures of {size}x{size} pixels, {bins} bins from {start_m:.4f} m")


def fewer(folder, out, spots):
    """Writes a folder with only some captures of another one."""
    out.mkdir(exist_ok=True)
    for file in [*folder.glob("*.json"), *folder.glob("detector_scan*"), *(folder / f"spot_{k}.mat" for k in spots)]:
        (out / file.name).unlink(missing_ok=True)
        os.link(file, out / file.name)


def histograms(array):
    """Returns the histograms of scene 0 as [spot, row, column, bin], whatever the order on disk."""
    names = array.metadata.dimension_names[1:]
    order = [names.index(name) for name in ("spot", "row", "column", "bin")]
    return np.ascontiguousarray(np.asarray(array[0]).transpose(order))


def write(file, counts, first, background, rng):
    """Writes one capture, with the bins before the gate that a timer also records."""
    size, bins = counts.shape[0], counts.shape[-1]
    # The one-bounce return may have more than 65535 photons.
    kind = np.uint16 if counts.max() < 2**16 else np.uint32
    cube = np.empty((size * size, first + bins), dtype=kind, order="F")
    cube[:, :first] = rng.poisson(background, (size * size, first))
    cube[:, first:] = counts.reshape(size * size, bins)
    scipy.io.savemat(file, {"dataCube": cube}, do_compression=True)


def scan(folder, u, v):
    """Writes the detector's scan: a ray (cos θ, sin φ sin θ, cos φ sin θ) for each pixel."""
    across, down = np.meshgrid(u, v)
    long = np.sqrt(across**2 + down**2 + 1)
    theta = np.arccos(across / long)
    phi = np.arctan(down)
    size = len(u)
    content = {
        "num_u": size,
        "num_v": len(v),
        "thetaMap": theta.reshape(-1, 1),
        "phiMap": phi.reshape(-1, 1),
    }
    scipy.io.savemat(folder / f"detector_scan_{size}x{len(v)}.mat", content)


if __name__ == "__main__":
    main()
