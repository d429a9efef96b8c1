"""Times Embree on the rays of `just lab rays`, turn by turn with our own tree.

usage: embree_rays.py LAB [--rounds N] [--robust]

LAB is the program of tests/lab. It writes meshes and rays to a temporary folder; then both sides take
turns on one thread, and of each the fastest round counts, in CPU time. Needs the package `embreex`
(whose Embree 4 library is used directly) and a C compiler. `rays.sh` sets all of that up.
"""

import argparse
import ctypes
import glob
import importlib.util
import math
import os
import pathlib
import subprocess
import tempfile

import numpy as np


def library(folder: pathlib.Path) -> ctypes.CDLL:
    """The C loops, compiled against the Embree that embreex brings."""
    package = pathlib.Path(importlib.util.find_spec("embreex").origin).parent
    (embree,) = glob.glob(str(package.parent / "embreex.libs" / "libembree4*"))
    libs = os.path.dirname(embree)
    source = pathlib.Path(__file__).with_name("embree_rays.c")
    out = folder / "embree_rays.so"
    subprocess.run(
        ["cc", "-O2", "-march=native", "-shared", "-fPIC", "-Wl,--allow-shlib-undefined", f"-Wl,-rpath,{libs}"]
        + ["-o", str(out), str(source), embree],
        check=True,
    )
    # Embree's own dependency (TBB) lies beside it.
    for tbb in glob.glob(f"{libs}/libtbb*"):
        ctypes.CDLL(tbb, mode=ctypes.RTLD_GLOBAL)
    c = ctypes.CDLL(str(out))
    c.make_scene.restype = ctypes.c_void_p
    c.make_scene.argtypes = [ctypes.c_void_p, ctypes.c_uint, ctypes.c_int]
    c.trace.restype = ctypes.c_double
    c.trace.argtypes = [ctypes.c_void_p, ctypes.c_void_p] + [ctypes.c_uint, ctypes.c_int, ctypes.c_int, ctypes.c_void_p]
    return c


def ours(lab: str, extra: list[str]) -> dict[tuple[str, str], float]:
    """One run of the benchmark: (mesh, rays) -> M rays per CPU-second."""
    text = subprocess.run([lab, "rays", *extra], check=True, capture_output=True, text=True).stdout
    rows = [line.split() for line in text.splitlines()[1:]]
    return {(mesh, name): float(rate) for mesh, name, _, rate in rows}


class Peer:
    """Embree with one mesh and its rays."""

    def __init__(self, c, folder: pathlib.Path, mesh: str, robust: bool):
        self.c = c
        t = np.fromfile(folder / f"{mesh}.triangles", np.float32)
        self.scene = c.make_scene(t.ctypes.data, len(t) // 9, int(robust))
        self.sets = {}
        for path in sorted(folder.glob(f"{mesh}.*.*")):
            _, name, kind = path.name.split(".")
            self.sets[name] = (kind == "any", np.fromfile(path, np.float32))

    def seconds(self, name: str, packets: bool) -> float:
        any_hit, rays = self.sets[name]
        blocked = ctypes.c_uint()
        args = [self.scene, rays.ctypes.data, len(rays) // 7, int(any_hit), int(packets)]
        return min(self.c.trace(*args, ctypes.byref(blocked)) for _ in range(2))

    def count(self, name: str) -> int:
        return len(self.sets[name][1]) // 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lab")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--robust", action="store_true", help="Embree's robust mode; ours is watertight always")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        c = library(folder)
        best = ours(options.lab, ["--rounds", "1", "--export", str(folder)])
        meshes = [p.name.split(".")[0] for p in folder.glob("*.triangles")]
        meshes.sort(key=lambda m: int(m.rstrip("k")))
        peers = {m: Peer(c, folder, m, options.robust) for m in meshes}
        theirs: dict[tuple[str, str, bool], float] = {}
        for _ in range(options.rounds):
            for key, rate in ours(options.lab, ["--rounds", "1"]).items():
                best[key] = max(best[key], rate)
            for m, peer in peers.items():
                for s in peer.sets:
                    for packets in (False, True):
                        key = (m, s, packets)
                        theirs[key] = min(theirs.get(key, math.inf), peer.seconds(s, packets))
    mode = "robust" if options.robust else "default"
    print(f"M rays per CPU-second, one thread, best of {options.rounds} rounds in turns; Embree 4, {mode} mode")
    print(f"{'mesh':<6} {'rays':<11} {'ours':>7} {'single':>7} | {'Embree 1':>9} {'packet 16':>9} | {'ratio':>6}")
    for m, peer in peers.items():
        for s in ["primary", "spots", "primary+25", "bounce1", "bounce2", "shadow", "reuse64", "reuse16"]:
            parts = ["primary", "spots"] if s == "primary+25" else [s]
            count = sum(peer.count(p) for p in parts)
            single, packet = (count / 1e6 / sum(theirs[m, p, k] for p in parts) for k in (False, True))
            alone = f"{best[m, s + '/1']:7.2f}" if (m, s + "/1") in best else " " * 7
            ratio = best[m, s] / max(single, packet)
            print(f"{m:<6} {s:<11} {best[m, s]:7.2f} {alone} | {single:9.2f} {packet:9.2f} | {ratio:6.2f}")
    print("ratio: ours over the better of Embree's single rays and coherent packets of 16")


if __name__ == "__main__":
    main()
