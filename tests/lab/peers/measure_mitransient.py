#!/usr/bin/env python3
"""Measures mitransient on a reference scene: CPU seconds against error, into a file for `just lab render --peer`.

    measure_mitransient.py SCENE.json --truth DIR --out FILE.json [--mode MODE]... [--ladder spp,...] [--resolution 64]

SCENE.json is a scene with exact meshes, materials, camera and laser spots (see worker/scene/src/import/reference.rs).
DIR is a converged render of the same scene, written by
`picofarm scene render SCENE.json --split --resolution 64 --samples N --out DIR`: the arrays `render/two` and `render/multi` are what
the error is measured against (one-bounce peaks are left out), its standard errors are taken off in quadrature.

A delta beam lights a point. mitransient has no light that is a point of a surface, so a spot becomes, by `--mode`:

  area        a disk of 2 mm radius, 0.1 mm above the surface, that emits as a Lambertian spot of 1 W reflects
              (`transient_path`, its ordinary path tracer). Diffuse spots only. One render a spot: the film's start
              moves by the spot's distance from the laser, which a film has only one of.
  laser       a projector at the laser with a beam of 0.2 degrees, `transient_nlos_path` with `nlos_laser_sampling`
              (each vertex is joined to the point where the beam lands, and that to the laser; the result is scaled to a
              beam of 1 W). Any material. One render a spot: the integrator allows one emitter.
  exhaustive  all spots in one render: the same integrator's `exhaustive` capture with our spots in place of its own
              grid, summed in one film. As released, each spot's visibility test also darkens all later spots (a mask is
              changed in place); repaired here by handing over a copy.

Without --mode: the fastest that applies of `area` and `laser`, and `exhaustive` where there is more than one spot.

Times are CPU seconds, user and system, over all threads (getrusage), around render calls only: loading, kernel
compilation and a first render of every kernel come before. A sample is one camera path a pixel and render.
"""

import argparse
import json
import os
import resource
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant(os.environ.get("MITSUBA_VARIANT", "llvm_ad_mono"))

import drjit as dr  # noqa: E402  (needs the variant)
import mitransient  # noqa: E402,F401  (registers its plugins)
from mitransient.integrators import transientnlospath  # noqa: E402

DISK_RADIUS = 2e-3
DISK_LIFT = 1e-4
MAX_DEPTH = 64
# Paths a pixel in one launch: bounds the memory of a wavefront.
LAUNCH = 1024


class AllSpots(transientnlospath.TransientNLOSPath):
    """`exhaustive` capture over given points of given power, with the shared mask repaired."""

    def aim(self, points, powers):
        self.points, self.powers = points, powers

    def prepare(self, scene, sensor, seed, spp, aovs):
        found = super().prepare(scene, sensor, seed, spp, aovs)
        self.laser_targets = mi.Point3f(*(mi.Float(c) for c in self.points.T))
        self.laser_resolution = mi.ScalarVector2u(len(self.points), 1)
        return found

    def emitter_laser_targets_sample(self, *, active_e, β, laser_x, **rest):
        power = dr.gather(mi.Float, mi.Float(self.powers), laser_x)
        return super().emitter_laser_targets_sample(active_e=mi.Bool(active_e), β=β * power, laser_x=laser_x, **rest)


mi.register_integrator("all_spots", lambda props: AllSpots(props))


def spectrum(value):
    return {"type": "spectrum", "value": float(value)}


def bsdf(b):
    if b["type"] == "diffuse":
        return {"type": "diffuse", "reflectance": spectrum(b["reflectance"])}
    conductor = {"type": "roughconductor", "distribution": b["distribution"], "alpha": b["alpha"], "material": "none",
                 "specular_reflectance": spectrum(b.get("fresnel", 1))}
    if b["type"] == "mixed":
        lambertian = {"type": "diffuse", "reflectance": spectrum(b["reflectance"])}
        return {"type": "blendbsdf", "weight": b["weight"], "first": lambertian, "second": conductor}
    return conductor


def mesh(m):
    vertices = np.array(m["vertices"], dtype=np.float32)
    faces = np.array(m["faces"], dtype=np.uint32)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf(m["bsdf"]))
    props["face_normals"] = True
    found = mi.Mesh(m["name"], len(vertices) // 3, len(faces) // 3, props=props)
    params = mi.traverse(found)
    params["vertex_positions"] = vertices
    params["faces"] = faces
    params.update()
    return found


def look(origin, target, up=(0.36, 0.48, 0.8)):
    as_list = [[float(x) for x in v] for v in (origin, target, up)]
    return mi.ScalarTransform4f().look_at(origin=as_list[0], target=as_list[1], up=as_list[2])


def load(d, pixels, start, extra):
    """The scene with a film from `start` and whatever lights it."""
    camera, gate = d["camera"], d["histogram"]
    origin = np.array(camera["origin"], dtype=float)
    parts = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": camera["fov_x_deg"],
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e3,
            "to_world": look(origin, origin + camera["forward"], camera["up"]),
            "sampler": {"type": "independent"},
            "film": {
                "type": "transient_hdr_film",
                "width": pixels,
                "height": pixels,
                "temporal_bins": gate["bins"],
                "bin_width_opl": gate["bin_width_opl"],
                "start_opl": start,
                "rfilter": {"type": "box"},
                # Read by the `exhaustive` capture; one film holds the sum (`exhaustive_scan` would keep all apart).
                "laser_scan_width": len(d["spots"]),
                "laser_scan_height": 1,
            },
        },
    }
    parts.update({f"mesh{i}": mesh(m) for i, m in enumerate(d["meshes"])})
    parts.update(extra)
    return mi.load_dict(parts)


def projector(d, spot):
    return {
        "type": "projector",
        "fov": 0.2,
        "irradiance": spectrum(1),
        "to_world": look(d["laser"]["origin"], spot["p"]),
    }


def per_watt(scene, spot):
    """1 / the power that the projector's beam stands for at a spot: the scale to 1 W."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = mi.Point3f(*(float(x) for x in spot["p"]))
    _, weight = scene.emitters()[0].sample_direction(si, mi.Point2f(0.5, 0.5))
    return float(1 / (np.array(weight).ravel()[0] * spot["cos_i"]))


def area_scenes(d, pixels):
    for s in d["spots"]:
        p, n = np.array(s["p"]), np.array(s["n"])
        radiance = s.get("power", 1.0) * s["bsdf"]["reflectance"] / np.pi / (np.pi * DISK_RADIUS**2)
        disk = {
            "type": "disk",
            "to_world": look(p + n * DISK_LIFT, p + n) @ mi.ScalarTransform4f().scale(DISK_RADIUS),
            "emitter": {"type": "area", "radiance": spectrum(radiance)},
            "bsdf": {"type": "diffuse", "reflectance": spectrum(0)},
        }
        # Light that reaches the camera straight from the disk is the one-bounce peak.
        integrator = {"type": "transient_path", "max_depth": MAX_DEPTH, "discard_direct_light": True}
        start = d["histogram"]["start_opl"] - s["laser_dist"]
        yield load(d, pixels, start, {"spot": disk, "integrator": integrator}), 1.0


def laser_integrator(kind, capture):
    return {
        "type": kind,
        "nlos_laser_sampling": True,
        "account_first_and_last_bounces": True,
        "capture_type": capture,
        "max_depth": MAX_DEPTH,
        "temporal_filter": "box",
    }


def laser_scenes(d, pixels):
    for s in d["spots"]:
        parts = {"laser": projector(d, s), "integrator": laser_integrator("transient_nlos_path", "single")}
        scene = load(d, pixels, d["histogram"]["start_opl"], parts)
        yield scene, per_watt(scene, s) * s.get("power", 1.0)


def exhaustive_scenes(d, pixels):
    parts = {"laser": projector(d, d["spots"][0]), "integrator": laser_integrator("all_spots", "exhaustive")}
    parts["integrator"]["force_equal_illumination_scanning"] = False
    scene = load(d, pixels, d["histogram"]["start_opl"], parts)
    # The projector is turned to each spot: its beam there is that of the first but for distance and angle.
    first = d["spots"][0]
    same = per_watt(scene, first) * first["cos_i"] / first["laser_dist"] ** 2
    powers = [s.get("power", 1.0) * same * s["laser_dist"] ** 2 / s["cos_i"] for s in d["spots"]]
    points = np.array([s["p"] for s in d["spots"]], dtype=np.float32)
    scene.integrator().aim(points, np.array(powers, dtype=np.float32))
    yield scene, 1.0


SCENES = {"area": area_scenes, "laser": laser_scenes, "exhaustive": exhaustive_scenes}


def cpu_seconds():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def render(scenes, spp, seed):
    """The sum over the scenes, [row, column, bin], in the truth's units."""
    total = 0.0
    for k, (scene, scale) in enumerate(scenes):
        left, launch = spp, 0
        while left > 0:
            now = min(left, LAUNCH)
            _, film = scene.integrator().render(scene, 0, seed=seed * 1_000_003 + k * 4001 + launch, spp=now)
            total = total + np.array(film)[..., 0] * np.float32(scale * now / spp)
            left, launch = left - now, launch + 1
    return total


class Truth:
    def __init__(self, folder):
        import zarr

        group = zarr.open_group(Path(folder) / "render", mode="r")
        get = lambda name: group[name][:].astype(np.float64)  # noqa: E731
        self.value = get("two") + get("multi")
        self.noise = (get("two_se") ** 2 + get("multi_se") ** 2).sum(2)
        self.norm = (self.value**2).sum(2)

    def median_noise(self):
        lit = self.norm > 0
        return float(np.median(np.sqrt(self.noise[lit] / self.norm[lit])))

    def error(self, h):
        """Median over pixels of |h - r| / |r|, the truth's own noise taken off; and the ratio of the energies."""
        lit = self.norm > 0
        distance = np.maximum(((h - self.value) ** 2).sum(2) - self.noise, 0)
        median = np.median(np.sqrt(distance[lit] / self.norm[lit]))
        return float(median), float(h.sum() / self.value.sum())


def measure(mode, d, args, truth):
    scenes = list(SCENES[mode](d, args.resolution))
    for seed in (1, 2):
        render(scenes, 1, 1000 + seed)
    rungs = []

    def climb(spp):
        before, wall = cpu_seconds(), time.monotonic()
        h = render(scenes, spp, len(rungs) + 1)
        cpu, wall = cpu_seconds() - before, time.monotonic() - wall
        error, energy = truth.error(h)
        rungs.append({"samples": spp, "cpu_seconds": cpu, "wall_seconds": wall, "error": error, "energy_ratio": energy})
        print(f"{d['name']} {mode}: {spp} spp, {cpu:.2f} CPU s, {wall:.2f} s, error {100 * error:.2f} %, "
              f"energy {energy:.4f}", file=sys.stderr, flush=True)
        return error

    for spp in args.ladder or []:
        climb(spp)
    if not args.ladder:
        # Up until the error is near the target: what little is left is extrapolated with error ~ time^-1/2.
        spp, error = args.first, climb(args.first)
        while error > 1.2 * args.target:
            more = min((error / args.target) ** 2 * 1.1, 8)
            if rungs[-1]["cpu_seconds"] * more > args.limit:
                break
            spp = int(np.ceil(spp * more))
            error = climb(spp)
    i = args.resolution
    return {"scene": d["name"], "mode": mode, "width": i, "height": i, "bins": d["histogram"]["bins"],
            "spots": len(d["spots"]), "rungs": rungs}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mode", action="append", choices=list(SCENES))
    parser.add_argument("--ladder", type=lambda t: [int(n) for n in t.split(",")],
                        help="samples a pixel and render; default: climb until close to --target")
    parser.add_argument("--first", type=int, default=64, help="first rung without --ladder")
    parser.add_argument("--target", type=float, default=0.1)
    parser.add_argument("--limit", type=float, default=150,
                        help="CPU seconds that a rung may take without --ladder; what lies beyond is extrapolated")
    parser.add_argument("--resolution", type=int, default=64)
    args = parser.parse_args()

    d = json.loads(args.scene.read_text())
    truth = Truth(args.truth)
    diffuse = all(s["bsdf"]["type"] == "diffuse" for s in d["spots"])
    modes = args.mode or ["area" if diffuse else "laser"] + ["exhaustive"] * (len(d["spots"]) > 1)
    print(f"truth {args.truth}: own noise {100 * truth.median_noise():.2f} %", file=sys.stderr)
    runs = [measure(mode, d, args, truth) for mode in modes]
    found = {"tool": f"mitransient {mitransient.__version__}", "mitsuba": mi.__version__,
             "variant": mi.variant(), "truth_noise": truth.median_noise(), "runs": runs}
    args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
