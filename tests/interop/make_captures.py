"""Writes one capture in the formats of laboratories, with the tools of these formats.

Usage: make_captures.py FOLDER. Writes FOLDER/expected.npy, photons [spot, row, column, bin], and a
folder for each format with its files and capture.json. Prints the formats that were written: some
need modules that may be absent.
"""

import json
import pathlib
import sys

import h5py
import numpy as np
import scipy.io

SPOTS, ROWS, COLUMNS, BINS = 2, 4, 5, 24
WIDTH_PS = 64.0
T0_PS = 640.0

root = pathlib.Path(sys.argv[1])
rng = np.random.default_rng(11)
counts = rng.integers(0, 4, (SPOTS, ROWS, COLUMNS, BINS)).astype(np.float32)
np.save(root / "expected.npy", counts)
written = []


def begin(name, spots=SPOTS, **fields):
    """Makes a format's folder with its description, and returns it."""
    folder = root / name
    folder.mkdir()
    description = {
        "pixels": [ROWS, COLUMNS],
        "gate": {"t0_ps": T0_PS, "bin_width_ps": WIDTH_PS},
        "camera": {"fov_deg": 60},
        "laser_m": [0, 0, 0],
        "directions": [[0.1 * k, 0, 1] for k in range(spots)],
    }
    description |= fields
    (folder / "capture.json").write_text(json.dumps(description))
    written.append(name)
    return folder


# A photon of each count: spot, row, column, bin, in random order.
places = np.argwhere(counts > 0)
photons = np.repeat(places, counts[tuple(places.T)].astype(int), axis=0)
rng.shuffle(photons)

folder = begin("npz")
np.savez_compressed(folder / "a.npz", counts=counts.astype(np.uint16))

folder = begin("matlab5", array="cube", axes=["pixel", "bin", "spot"])
cube = counts.reshape(SPOTS, -1, BINS).transpose(1, 2, 0)
scipy.io.savemat(folder / "a.mat", {"cube": cube, "note": np.zeros(3)}, do_compression=True)

folder = begin("matlab73", array="cube", axes=["pixel", "bin", "spot"])
with h5py.File(folder / "a.mat", "w", userblock_size=512) as file:
    # MATLAB's axes are in the reverse order in HDF5.
    file.create_dataset("cube", data=cube.T.astype(float), chunks=True, compression="gzip")
with open(folder / "a.mat", "r+b") as file:
    file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")

folder = begin("hdf5", array="lab/cube", axes=["bin", "row", "column", "spot"])
with h5py.File(folder / "a.h5", "w") as file:
    file["lab/cube"] = counts.transpose(3, 1, 2, 0)

folder = begin(
    "table",
    gate={"t0_ps": T0_PS, "bin_width_ps": WIDTH_PS, "bins": BINS},
    events={"time": "dtime", "time_ps": 16.0, "pixel": "pixel", "spot": "spot", "spots": SPOTS},
)
lines = ["pixel,spot,dtime"]
for spot, row, column, bin_ in photons:
    channel = int(bin_ * WIDTH_PS / 16) + rng.integers(4)
    lines.append(f"{row * COLUMNS + column},{spot},{channel}")
(folder / "a.csv").write_text("\n".join(lines) + "\n")

folder = begin("photon-hdf5", gate={"t0_ps": T0_PS}, spots=1)
mine = photons[photons[:, 0] == 0]
with h5py.File(folder / "a.hdf5", "w") as file:
    file.attrs["format_name"], file.attrs["format_version"] = "Photon-HDF5", "0.5"
    file["photon_data/timestamps"] = np.arange(len(mine), dtype=np.int64)
    file["photon_data/timestamps_specs/timestamps_unit"] = 1e-7
    file["photon_data/detectors"] = (mine[:, 1] * COLUMNS + mine[:, 2]).astype(np.uint8)
    file["photon_data/nanotimes"] = mine[:, 3].astype(np.uint16)
    file["photon_data/nanotimes_specs/tcspc_unit"] = WIDTH_PS * 1e-12
    file["photon_data/nanotimes_specs/tcspc_num_bins"] = BINS

# mitransient's film: row, column, time, channel.
folder = begin("mitransient", axes=["row", "column", "bin", "channel"], spots=1)
np.save(folder / "a.npy", np.repeat(counts[0][..., None], 3, axis=-1))

# Relay walls. The grid is at a right angle to z, 2 m in front of the sensor.
x, y = np.meshgrid(np.linspace(-1, 1, COLUMNS), np.linspace(-0.6, 0.6, ROWS), indexing="ij")
wall = np.stack([x, y, np.zeros_like(x)], -1)
lasers = np.array([[[0.1, 0.2, 0.0]], [[-0.3, 0.0, 0.0]]])
sensor, laser = np.array([0.2, -0.1, 2.0]), np.array([0.3, 0.0, 2.0])
# Spot, x, y, bin; the image's rows run against y, because x, y and the view are right-handed so.
on_wall = counts[:, ::-1].transpose(0, 2, 1, 3)

folder = begin("y-tal")
(folder / "capture.json").unlink()
with h5py.File(folder / "a.hdf5", "w") as file:
    file["H"] = on_wall.transpose(3, 0, 1, 2)[:, :, None]
    file["sensor_grid_xyz"], file["laser_grid_xyz"] = wall, lasers
    file["sensor_xyz"], file["laser_xyz"] = sensor, laser
    file["delta_t"], file["t_start"] = 0.03, 3.5
    file["t_accounts_first_and_last_bounces"] = True

folder = begin("zaragoza")
(folder / "capture.json").unlink()
with h5py.File(folder / "a.hdf5", "w") as file:
    # Colours, bins, bounces, sensor x and y, laser x and y.
    data = on_wall.transpose(3, 1, 2, 0)[None, :, None, :, :, :, None]
    file["data"] = np.concatenate([data, np.zeros_like(data)], axis=2)
    file["cameraGridPositions"] = wall.transpose(2, 1, 0)
    file["laserGridPositions"] = lasers.transpose(2, 1, 0)
    file["cameraPosition"], file["laserPosition"] = sensor, laser
    file["deltaT"], file["t0"] = 0.03, 3.5

try:
    import ptufile
except ImportError:
    pass
else:
    folder = begin("ptu", gate={"t0_ps": T0_PS})
    description = json.loads((folder / "capture.json").read_text())
    # The files say the number of pixels.
    del description["pixels"]
    (folder / "capture.json").write_text(json.dumps(description))
    period = WIDTH_PS * 1e-12 * BINS
    for spot in range(SPOTS):
        ptufile.imwrite(
            folder / f"spot_{spot}.ptu",
            counts[spot].astype(np.uint8)[None, :, :, None],
            global_resolution=period,
            tcspc_resolution=WIDTH_PS * 1e-12,
            pixel_time=period * 200,
        )

print("\n".join(written))
