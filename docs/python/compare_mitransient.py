"""Renders one Mitsuba dict with picofarm and with mitransient, and compares the histograms.

    python compare_mitransient.py [--spp 4096] [--resolution 24]

Needs picofarm and mitransient (`pip install mitransient`, and LLVM for Dr.Jit).
"""

import argparse
import time

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_mono")

import mitransient  # noqa: E402, F401  (registers its plugins)

import picofarm  # noqa: E402

BINS, START_M, BIN_M = 128, 2.0, 0.08
RADIUS_M = 0.004


def room():
    """A room with a sphere, as a Mitsuba dict. Both programs read it."""
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, 0.9], target=[0, 0, 0], up=[0, 1, 0])
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 70,
            "to_world": look,
            "film": {"type": "hdrfilm", "width": 64, "height": 64},
        },
        "walls": {"type": "cube", "flip_normals": True, "bsdf": grey},
        "ball": {"type": "sphere", "center": [0.35, -0.6, -0.3], "radius": 0.4, "bsdf": grey},
    }


def with_mitransient(scene, spot, resolution, spp):
    """The laser spot as a small disk that emits what the wall reflects of a pulse of energy 1."""
    point, normal, path = spot[:3].astype(float), spot[3:6].astype(float), float(spot[6])
    radiance = 0.6 / np.pi / (np.pi * RADIUS_M**2)
    place = mi.ScalarTransform4f().look_at(
        origin=list(point + 1e-4 * normal), target=list(point + normal), up=[0.3, 0.5, 0.8]
    )
    film = {
        "type": "transient_hdr_film",
        "width": resolution,
        "height": resolution,
        "temporal_bins": BINS,
        "bin_width_opl": BIN_M,
        # The film counts from the disk, picofarm from the laser.
        "start_opl": START_M - path,
        "rfilter": {"type": "box"},
    }
    lit = {
        **scene,
        "sensor": {**scene["sensor"], "film": film, "sampler": {"type": "independent"}},
        "spot": {
            "type": "disk",
            "to_world": place @ mi.ScalarTransform4f().scale(RADIUS_M),
            "emitter": {"type": "area", "radiance": {"type": "spectrum", "value": radiance}},
            "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0}},
        },
        # The disk itself, seen by the camera, is the light of one bounce.
        "integrator": {"type": "transient_path", "max_depth": 32, "discard_direct_light": True},
    }
    loaded = mi.load_dict(lit)
    # The first render compiles the kernels.
    loaded.integrator().render(loaded, 0, seed=1, spp=1)
    start = time.process_time()
    _, film = loaded.integrator().render(loaded, 0, seed=2, spp=spp)
    h = np.array(film)[..., 0]
    return h, time.process_time() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spp", type=int, default=4096)
    parser.add_argument("--resolution", type=int, default=24)
    args = parser.parse_args()
    mitsuba_dict = room()
    scene = picofarm.Scene(mitsuba_dict, spots=[(0.3, 0.35)], unit="m")
    gate = (START_M, START_M + BINS * BIN_M)
    start = time.process_time()
    ours = scene.render(args.resolution, error=0.02, bins=BINS, gate=gate, split=True)
    seconds = time.process_time() - start
    theirs, their_seconds = with_mitransient(
        mitsuba_dict, ours.spots[0], args.resolution, args.spp
    )
    mine = ours.two + ours.multi
    apart = mine - theirs
    lit = mine.sum(axis=2) > 0
    error = np.linalg.norm(apart, axis=2)[lit] / np.linalg.norm(mine, axis=2)[lit]
    print(f"picofarm: {seconds:.1f} CPU s, error {ours.error:.1%}")
    print(f"mitransient: {their_seconds:.1f} CPU s, {args.spp} samples a pixel")
    print(f"light: {mine.sum():.6g} and {theirs.sum():.6g}, ratio {theirs.sum() / mine.sum():.4f}")
    print(f"median difference of a pixel: {np.median(error):.1%}")


if __name__ == "__main__":
    main()
