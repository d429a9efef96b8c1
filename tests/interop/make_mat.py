"""Writes a bounce-flash lidar collection as MATLAB does: captures of version 7.3 (HDF5), the scan of version 5.

usage: make_mat.py FOLDER COLUMNS ROWS BINS T0

The scene is a wall at z = 2 m; laser spot i lies at x = 0.1·i, y = -0.1·i (left, up, forward). `expected.npy` holds
the counts of the first capture as [row][column][bin], rows from the top and columns from the left.
"""

import pathlib
import sys

import h5py
import numpy as np
import scipy.io

C = 299_792_458.0
WIDTH = 8e-12


def main(folder, columns, rows, bins, t0):
    folder = pathlib.Path(folder)
    num_u, num_v, num_bins, t0 = int(columns), int(rows), int(bins), float(t0)
    # The scan starts at the left (x large) and at the bottom; u is the fast index.
    u = np.linspace(0.5, -0.5, num_u)
    v = np.linspace(-0.4, 0.4, num_v)
    x, y = np.meshgrid(u, v)
    d = np.stack([x, y, np.ones_like(x)], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    theta = np.arccos(d[..., 0])
    phi = np.arctan2(d[..., 1], d[..., 2])
    scan = {
        "num_u": float(num_u), "num_v": float(num_v), "thetaMap": theta.reshape(-1, 1), "phiMap": phi.reshape(-1, 1),
        "note": "text is passed over", "u_lims": np.array([-0.5, 0.5]),
    }
    scipy.io.savemat(folder / f"detector_scan_{num_u}x{num_v}.mat", scan, do_compression=True)
    laser = np.array([0.257, 0.0, 0.0])
    points = d * (2.0 / d[..., 2:])
    for i in [1, 2]:
        spot = np.array([0.1 * i, -0.1 * i, 2.0])
        path = np.linalg.norm(spot - laser) + np.linalg.norm(points - spot, axis=-1) + np.linalg.norm(points, axis=-1)
        # Bin k, counted from 1, stands for k·8 ps − t0.
        k = np.rint((path / C + t0) / WIDTH).astype(int)
        cube = np.zeros((num_u * num_v, num_bins))
        cube[np.arange(num_u * num_v), k.ravel() - 1] = 20
        nearest = np.argmin(np.linalg.norm(points - spot, axis=-1))
        cube[nearest, k.ravel()[nearest] - 1] = 3000
        with h5py.File(folder / f"spot_{i}.mat", "w", userblock_size=512) as f:
            # MATLAB tells the axes the other way round.
            data = f.create_dataset("dataCube", data=cube.T, chunks=(min(64, num_bins), num_u * num_v), compression="gzip")
            data.attrs["MATLAB_class"] = np.bytes_("double")
        with open(folder / f"spot_{i}.mat", "r+b") as f:
            f.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
        if i == 1:
            # Rows from the top: v falls. Columns from the left: x falls, as they stand.
            image = cube.reshape(num_v, num_u, num_bins)[::-1]
            np.save(folder.parent / "expected.npy", image.astype("<f4"))


main(*sys.argv[1:])
