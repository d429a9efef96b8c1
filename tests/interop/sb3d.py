"""Reads a scene exported in the paper's layout with OpenEXR and numpy, as the paper's loader does, and writes it anew.

usage: sb3d.py SCENE H.BIN ANEW

H.BIN holds the histograms as raw 32-bit floats. ANEW gets the scene with its histograms in DWAA compression;
beside it, `decoded.bin` is what OpenEXR decodes of them. Exits non-zero at the first difference.
"""

import json
import pathlib
import shutil
import sys

import numpy as np
import OpenEXR


def main(scene, raw, anew):
    scene, anew = pathlib.Path(scene), pathlib.Path(anew)
    about = json.loads((scene / "picofarm.json").read_text())
    shadows = np.load(scene / "shadows_v1.npz")["shadows"]
    lights = np.load(scene / "lights_camera_frame.npy")
    spots, rows, columns = shadows.shape
    assert lights.shape == (spots, 3) and set(np.unique(shadows)) <= {0.0, 1.0}
    part = OpenEXR.File(str(scene / "lidar_100.exr"), separate_channels=True)
    assert part.header()["compression"] == OpenEXR.ZIP_COMPRESSION
    lidar = part.channels()["Y"].pixels
    assert lidar.dtype == np.float16 and lidar.shape == (rows * columns, about["gate"]["bins"]), lidar.shape
    expected = np.fromfile(raw, dtype="<f4").reshape(lidar.shape)
    scaled = (expected * np.float32(about["factor"])).astype(np.float16)
    assert (lidar == scaled).all(), "the halves are not the histogram's"
    depth = OpenEXR.File(str(scene / "depth.exr"), separate_channels=True).channels()["Y"].pixels
    assert depth.dtype == np.float32 and depth.shape == (rows, columns)
    print(f"{lidar.shape} halves equal, factor {about['factor']}")

    anew.mkdir(parents=True)
    for name in ["depth.exr", "specular_mask.png", "shadows_v1.npz", "lights_camera_frame.npy"]:
        shutil.copy(scene / name, anew / name)
    for n in [4, 25, 100]:
        lidar = OpenEXR.File(str(scene / f"lidar_{n}.exr"), separate_channels=True).channels()["Y"].pixels
        # The release's values are small: a bin seldom exceeds 1.
        lidar = (lidar.astype(np.float32) / 65536).astype(np.float16)
        header = {"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": OpenEXR.Channel(np.ascontiguousarray(lidar))}).write(str(anew / f"lidar_{n}.exr"))
    again = OpenEXR.File(str(anew / "lidar_100.exr"), separate_channels=True).channels()["Y"].pixels
    again.astype("<f4").tofile(anew.parent / "decoded.bin")
    print(f"written anew with DWAA, {(anew / 'lidar_100.exr').stat().st_size} bytes")


main(*sys.argv[1:])
